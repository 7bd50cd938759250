"""The cache folder of kernels: the choice of the folder, temporary folders, permissions and read-only caches."""

import logging
import os
import stat
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from cnpgen.cli.main import notices
from cnpgen.errors import MachineError
from cnpgen.kernels import code_cache
from cnpgen.kernels.code_cache import tape_key
from cnpgen.kernels.library import KernelLibrary, choose_backend
from cnpgen.store.files.cache_folder import (
    default_cache_folder,
    make_private_folder,
    trust_problem,
    untrusted_files,
    usable_cache_folder,
)
from tests.conftest import some
from tests.refusals import is_refused

posix = pytest.mark.skipif(
    not hasattr(os, "geteuid"), reason="files have no owners here"
)
BUILT: list[str] = []  # names of functions that were built

FALLBACK = """
import os, sys, warnings
from pathlib import Path
from cnpgen.store.files.cache_folder import usable_cache_folder
warnings.simplefilter("ignore")
folder = usable_cache_folder(Path(sys.argv[1]))
child = os.fork()
if child == 0:
    sys.exit()
os.waitpid(child, 0)
print(folder, folder.is_dir())
"""


@pytest.fixture
def unwritable(tmp_path: Path) -> Path:
    """Return a folder that cannot be created, not even by root."""
    (tmp_path / "file").write_text("not a folder")
    return tmp_path / "file" / "cache"


def doubling():
    BUILT.append("doubling")
    x = ca.SX.sym("x")
    return ca.Function("doubling", [x], [2 * x])


def tripling():
    x = ca.SX.sym("x")
    return ca.Function("tripling", [x], [3 * x])


def test_the_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("CNPGEN_CACHE", "/a/b")
    assert default_cache_folder() == Path("/a/b")
    monkeypatch.delenv("CNPGEN_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/x")
    assert default_cache_folder() == Path("/x/cnpgen")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_cache_folder() == tmp_path / ".cache" / "cnpgen"


def test_without_a_home_folder_the_error_names_the_variable(monkeypatch):
    for name in ("CNPGEN_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    with is_refused(MachineError):
        choose_backend()


def test_a_writable_folder_is_used_without_a_warning(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert usable_cache_folder(tmp_path / "new") == tmp_path / "new"


def test_a_file_at_the_path_of_the_folder_causes_a_warning(unwritable):
    with pytest.warns(
        RuntimeWarning,
        match=rf"cannot write the kernel cache {unwritable.parent} \(Not a directory\)",
    ):
        assert usable_cache_folder(unwritable.parent).is_dir()


def test_kernels_are_compiled_in_a_temporary_folder_after_one_warning(
    unwritable, monkeypatch, fresh_compiler
):
    monkeypatch.setenv("CNPGEN_CACHE", str(unwritable))
    with pytest.warns(RuntimeWarning) as caught:
        backend, folder = choose_backend()
    (warning,) = caught
    assert f"cannot write the kernel cache {unwritable} (Not a directory)" in str(
        warning.message
    )
    assert "set CNPGEN_CACHE" in str(warning.message)
    assert backend == "compiled"
    (result,) = KernelLibrary(backend, folder, "test").load(doubling)(np.ones((1, 3)))
    np.testing.assert_array_equal(result, 2.0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_temporary_folder_is_removed_only_by_the_process_that_created_it(unwritable):
    command = [sys.executable, "-c", FALLBACK, str(unwritable)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    folder, was_there = done.stdout.rsplit(maxsplit=1)
    assert was_there == "True"
    assert not Path(folder).exists()


def test_generation_is_announced_once_and_only_if_it_happens(tmp_path, capsys):
    library = KernelLibrary("compiled", tmp_path, "test")
    with notices():
        library.load(doubling)
        library.load(tripling)
    assert (
        capsys.readouterr().err
        == "cnpgen: generating kernels, once per problem and machine\n"
    )
    with notices():
        library.load(doubling)
    assert capsys.readouterr().err == ""


def test_notices_are_printed_once_each_and_not_in_quiet_mode(capsys):
    logger = logging.getLogger("cnpgen.some.module")
    with notices():
        for text in ("first", "second", "first"):
            logger.info(text)
    assert capsys.readouterr() == ("", "cnpgen: first\ncnpgen: second\n")
    with notices("WARNING"):
        logger.info("first")
    logger.info("first")
    assert capsys.readouterr() == ("", "")


# --- permissions ------------------------------------------------------------------------------------------------------


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def give_away(monkeypatch) -> Callable[[Path], None]:
    """Return a function that makes a path appear to belong to another user."""

    def give(path: Path) -> None:
        if os.geteuid() == 0:
            os.chown(path, 4321, -1, follow_symlinks=False)
        else:
            monkeypatch.setattr(os, "geteuid", lambda: 4321)

    return give


@posix
@pytest.mark.parametrize("umask", [0o000, 0o077, 0o277])
def test_a_new_cache_is_private_for_any_umask(tmp_path, umask):
    before = os.umask(umask)
    try:
        folder = usable_cache_folder(tmp_path / "a" / "b")
        KernelLibrary("numpy", folder, "test").load(doubling)
    finally:
        os.umask(before)
    assert folder == tmp_path / "a" / "b"
    assert {mode(path) for path in (folder.parent, folder, folder / "tape")} == {0o700}
    (tape,) = (folder / "tape").iterdir()
    assert not mode(tape) & 0o022
    assert not trust_problem(folder)
    assert not untrusted_files(folder)


@posix
def test_libraries_are_not_writable_for_others_under_a_permissive_umask(tmp_path):
    before = os.umask(0)
    try:
        KernelLibrary("compiled", tmp_path / "new", "test").load(doubling)
    finally:
        os.umask(before)
    libraries = list((tmp_path / "new" / "lib").iterdir())
    assert [path.suffix for path in libraries] == [
        ".o",
        ".o",
    ]  # the kernel and its caller
    assert not any(mode(library) & 0o022 for library in libraries)


def refused(folder: Path, why: str) -> None:
    """Check that the folder is refused with the reason and that nothing is written to it."""
    before = sorted(folder.rglob("*"))
    with pytest.warns(
        RuntimeWarning,
        match=f"the kernel cache .* is not used, as .*{why}.*set CNPGEN_CACHE",
    ):
        assert usable_cache_folder(folder) != folder
    with pytest.raises(MachineError, match=why):
        KernelLibrary("numpy", folder, "test").load(doubling)
    assert sorted(folder.rglob("*")) == before


@posix
def test_a_cache_that_is_writable_for_others_is_refused(tmp_path):
    folder = tmp_path / "above" / "cache"
    make_private_folder(folder / "lib")
    for path in (folder, folder.parent, folder / "lib"):
        for bits in (0o770, 0o702, 0o1777):
            path.chmod(bits)
            if bits == 0o1777 and path == folder.parent:
                assert not trust_problem(
                    folder
                )  # as in /tmp: only owners rename their entries
            else:
                refused(folder, f"others may write to {path}")
        path.chmod(0o700)
    assert not trust_problem(folder)


@posix
@pytest.mark.parametrize("name", ["cache", "cache/tape", "."])
def test_a_cache_that_belongs_to_another_user_is_refused(tmp_path, give_away, name):
    folder = tmp_path / "cache"
    make_private_folder(folder / "tape")
    give_away(tmp_path / name)
    refused(folder, "belongs to another user")


@posix
def test_links_to_the_cache_are_followed_and_links_inside_it_are_refused(tmp_path):
    there, folder = tmp_path / "scratch" / "there", tmp_path / "cache"
    make_private_folder(there)
    folder.symlink_to(there)
    assert usable_cache_folder(folder) == folder
    there.parent.chmod(0o777)
    refused(folder, f"others may write to {there.parent}")
    there.parent.chmod(0o700)
    (tmp_path / "planted").mkdir(0o700)
    (there / "lib").symlink_to(tmp_path / "planted")
    refused(folder, "lib is a symbolic link")


@posix
@pytest.mark.parametrize(
    "how", some(["open to others", "of another user", "a link"], 1, "slow")
)
@pytest.mark.parametrize("kind", ["lib", "tape"])
def test_an_untrusted_file_is_ignored_and_replaced(
    tmp_path, give_away, monkeypatch, kind, how
):
    folder = tmp_path / "cache"
    library = KernelLibrary("compiled", folder, "test")
    key = tape_key(library.load(doubling).tape)
    (path,) = (folder / kind).glob({"lib": f"{key}.o", "tape": "doubling-*"}[kind])
    planted, inode = path.read_bytes(), path.stat().st_ino
    if how == "open to others":
        path.chmod(0o666)
    elif os.geteuid() and how == "of another user":
        pytest.skip("only root can give a single file away")
    elif how == "of another user":
        give_away(path)
    else:
        path.rename(tmp_path / "elsewhere")
        path.symlink_to(tmp_path / "elsewhere")
    assert untrusted_files(folder) == [path]
    BUILT.clear()
    monkeypatch.setattr(code_cache, "_loaded", {})  # as in another process
    library.load(doubling)
    assert len(BUILT) == (kind == "tape")
    assert not path.is_symlink()
    assert path.read_bytes() == planted
    assert path.stat().st_ino != inode
    assert untrusted_files(folder) == []


def test_a_file_that_disappears_while_the_cache_is_checked_causes_no_error(
    tmp_path, monkeypatch
):
    (tmp_path / "tape").mkdir()
    (tmp_path / "tape" / ".unfinished.tmp").write_text("")
    seen = Path.is_symlink

    def moved(path: Path) -> bool:
        found = seen(path)
        path.unlink()
        return found

    monkeypatch.setattr(Path, "is_symlink", moved)
    assert untrusted_files(tmp_path) == []


READ_ONLY = """
import logging, os, sys, warnings
from pathlib import Path
from cnpgen.store.files import cache_folder
from cnpgen.kernels.library import KernelLibrary
from tests.store.test_cache_folder import BUILT, doubling, tripling
warnings.simplefilter("error")
logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
def refuse(**_):
    raise PermissionError(13, "Permission denied")
cache_folder.tempfile.TemporaryFile = refuse  # root can write everywhere
folder = cache_folder.usable_cache_folder(Path(sys.argv[1]))
assert folder != Path(sys.argv[1])
KernelLibrary("compiled", folder, "test").load(doubling)
assert not BUILT
KernelLibrary("compiled", folder, "test").load(tripling)
assert len(list((folder / "lib").iterdir())) == 1  # not the caller of kernels
"""


@pytest.mark.slow
def test_a_read_only_cache_is_read_and_missing_kernels_are_generated_temporarily(
    tmp_path,
):
    warm = tmp_path / "warm"
    KernelLibrary("compiled", warm, "test").load(doubling)
    before = sorted(warm.rglob("*"))
    done = subprocess.run(
        [sys.executable, "-c", READ_ONLY, str(warm)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (
        done.stdout
        == f"generating kernels for this run only: the cache {warm} lacks them and is not writable\n"
    )
    assert sorted(warm.rglob("*")) == before
