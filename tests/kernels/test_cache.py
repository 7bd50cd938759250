"""Where kernels are kept: the folder that the environment says, or one that goes away with its process."""

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

from cnpgen.cli.notices import notices
from cnpgen.errors import MachineError
from cnpgen.kernels.cache import default_cache_folder, distrusted, distrusted_files, make_private, usable_folder
from cnpgen.kernels.library import KernelLibrary, choose_backend
from tests.conftest import needs_compiler, some

posix = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="files have no owners here")
BUILT: list[str] = []  # what was built and not found in a cache

FALLBACK = """
import os, sys, warnings
from pathlib import Path
from cnpgen.kernels.cache import usable_folder
warnings.simplefilter("ignore")
folder = usable_folder(Path(sys.argv[1]))
child = os.fork()
if child == 0:
    sys.exit()
os.waitpid(child, 0)
print(folder, folder.is_dir())
"""


@pytest.fixture
def unwritable(tmp_path: Path) -> Path:
    """A folder that cannot be made, whoever tries."""
    (tmp_path / "file").write_text("not a folder")
    return tmp_path / "file" / "cache"


def doubling():
    BUILT.append("doubling")
    x = ca.SX.sym("x")
    return ca.Function("doubling", [x], [2 * x])


def tripling():
    x = ca.SX.sym("x")
    return ca.Function("tripling", [x], [3 * x])


def test_the_cache_is_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("CNPGEN_CACHE", "/a/b")
    assert default_cache_folder() == Path("/a/b")
    monkeypatch.delenv("CNPGEN_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/x")
    assert default_cache_folder() == Path("/x/cnpgen")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_cache_folder() == tmp_path / ".cache" / "cnpgen"


def test_a_user_without_home_folder_is_told_what_to_set(monkeypatch):
    for name in ("CNPGEN_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    with pytest.raises(MachineError, match="CNPGEN_CACHE"):
        choose_backend()


def test_a_folder_that_can_be_written_is_taken_without_a_word(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert usable_folder(tmp_path / "new") == tmp_path / "new"


def test_a_file_in_the_place_of_the_folder_is_said_to_be_none(unwritable):
    with pytest.warns(RuntimeWarning, match=rf"cannot write the kernel cache {unwritable.parent} \(Not a directory\)"):
        assert usable_folder(unwritable.parent).is_dir()


@needs_compiler
def test_kernels_are_compiled_in_a_temporary_folder_after_one_warning(unwritable, monkeypatch, fresh_compiler):
    monkeypatch.setenv("CNPGEN_CACHE", str(unwritable))
    with pytest.warns(RuntimeWarning) as caught:
        backend, folder = choose_backend()
    (warning,) = caught
    assert f"cannot write the kernel cache {unwritable} (Not a directory)" in str(warning.message)
    assert "set CNPGEN_CACHE" in str(warning.message)
    assert backend == "compiled"
    (result,) = KernelLibrary(backend, folder, "test").load(doubling)(np.ones((1, 3)))
    np.testing.assert_array_equal(result, 2.0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_temporary_folder_is_removed_by_the_process_that_made_it_and_by_no_other(unwritable):
    command = [sys.executable, "-c", FALLBACK, str(unwritable)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    folder, was_there = done.stdout.split()
    assert was_there == "True"
    assert not Path(folder).exists()


@needs_compiler
def test_compiling_is_announced_once_and_only_where_it_happens(tmp_path, capsys):
    library = KernelLibrary("compiled", tmp_path, "test")
    with notices():
        library.load(doubling)
        library.load(tripling)
    assert capsys.readouterr().err == "cnpgen: compiling kernels, once per problem and machine\n"
    with notices():
        library.load(doubling)
    assert capsys.readouterr().err == ""


def test_notices_are_printed_once_each_and_not_where_quiet_is_asked_for(capsys):
    logger = logging.getLogger("cnpgen.some.module")
    with notices():
        for text in ("first", "second", "first"):
            logger.info(text)
    assert capsys.readouterr() == ("", "cnpgen: first\ncnpgen: second\n")
    with notices(quiet=True):
        logger.info("first")
    logger.info("first")
    assert capsys.readouterr() == ("", "")


# --- nobody else may change it ----------------------------------------------------------------------------------------


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def give_away(monkeypatch) -> Callable[[Path], None]:
    """Let a path belong to somebody else, whoever runs the tests."""

    def give(path: Path) -> None:
        if os.geteuid() == 0:
            os.chown(path, 4321, -1, follow_symlinks=False)
        else:
            monkeypatch.setattr(os, "geteuid", lambda: 4321)

    return give


@posix
@pytest.mark.parametrize("umask", [0o000, 0o077, 0o277])
def test_a_new_cache_is_for_its_user_alone_whatever_the_umask_is(tmp_path, umask):
    before = os.umask(umask)
    try:
        folder = usable_folder(tmp_path / "a" / "b")
        KernelLibrary("numpy", folder, "test").load(doubling)
    finally:
        os.umask(before)
    assert folder == tmp_path / "a" / "b"
    assert {mode(path) for path in (folder.parent, folder, folder / "tape")} == {0o700}
    (tape,) = (folder / "tape").iterdir()
    assert not mode(tape) & 0o022
    assert not distrusted(folder)
    assert not distrusted_files(folder)


@needs_compiler
@posix
def test_libraries_that_a_careless_umask_would_open_are_closed(tmp_path):
    before = os.umask(0)
    try:
        KernelLibrary("compiled", tmp_path / "new", "test").load(doubling)
    finally:
        os.umask(before)
    libraries = list((tmp_path / "new" / "lib").iterdir())
    assert {path.name.partition("-")[0] for path in libraries} == {"call", "doubling"}
    assert not any(mode(library) & 0o022 for library in libraries)


def refused(folder: Path, why: str) -> None:
    """The folder is refused by whoever would use it, with the reason, and nothing is put into it."""
    before = sorted(folder.rglob("*"))
    with pytest.warns(RuntimeWarning, match=f"the kernel cache .* is not used, as .*{why}.*set CNPGEN_CACHE"):
        assert usable_folder(folder) != folder
    with pytest.raises(MachineError, match=why):
        KernelLibrary("numpy", folder, "test").load(doubling)
    assert sorted(folder.rglob("*")) == before


@posix
def test_a_cache_that_others_may_write_to_is_refused(tmp_path):
    folder = tmp_path / "above" / "cache"
    make_private(folder / "lib")
    for path in (folder, folder.parent, folder / "lib"):
        for bits in (0o770, 0o702, 0o1777):
            path.chmod(bits)
            if bits == 0o1777 and path == folder.parent:
                assert not distrusted(folder)  # as in /tmp: nobody moves what is another's
            else:
                refused(folder, f"others may write to {path}")
        path.chmod(0o700)
    assert not distrusted(folder)


@posix
@pytest.mark.parametrize("name", ["cache", "cache/tape", "."])
def test_a_cache_that_belongs_to_another_user_is_refused(tmp_path, give_away, name):
    folder = tmp_path / "cache"
    make_private(folder / "tape")
    give_away(tmp_path / name)
    refused(folder, "belongs to another user")


@posix
def test_links_are_followed_to_where_they_lead_and_not_at_all_inside(tmp_path):
    there, folder = tmp_path / "scratch" / "there", tmp_path / "cache"
    make_private(there)
    folder.symlink_to(there)
    assert usable_folder(folder) == folder
    there.parent.chmod(0o777)
    refused(folder, f"others may write to {there.parent}")
    there.parent.chmod(0o700)
    (tmp_path / "planted").mkdir(0o700)
    (there / "lib").symlink_to(tmp_path / "planted")
    refused(folder, "lib is a symbolic link")


@needs_compiler
@posix
@pytest.mark.parametrize("how", some(["open to others", "of another user", "a link"], 1, "slow"))
@pytest.mark.parametrize("kind", ["lib", "tape"])
def test_a_planted_file_is_as_if_it_were_not_there_and_is_replaced(tmp_path, give_away, kind, how):
    folder = tmp_path / "cache"
    library = KernelLibrary("compiled", folder, "test")
    library.load(doubling)
    (path,) = (folder / kind).glob("doubling-*")
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
    assert distrusted_files(folder) == [path]
    BUILT.clear()
    library.load(doubling)
    assert len(BUILT) == (kind == "tape")
    assert not path.is_symlink()
    assert path.read_bytes() == planted
    assert path.stat().st_ino != inode
    assert distrusted_files(folder) == []


def test_a_file_that_is_moved_to_its_place_while_the_cache_is_looked_through_is_nobodys(tmp_path, monkeypatch):
    (tmp_path / "tape").mkdir()
    (tmp_path / "tape" / ".unfinished.tmp").write_text("")
    seen = Path.is_symlink

    def moved(path: Path) -> bool:
        found = seen(path)
        path.unlink()
        return found

    monkeypatch.setattr(Path, "is_symlink", moved)
    assert distrusted_files(tmp_path) == []


READ_ONLY = """
import logging, os, sys, warnings
from pathlib import Path
from cnpgen.kernels import cache
from cnpgen.kernels.library import KernelLibrary
from tests.kernels.test_cache import BUILT, doubling, tripling
warnings.simplefilter("error")
logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
def refuse(**_):
    raise PermissionError(13, "Permission denied")
cache.tempfile.TemporaryFile = refuse  # root may write everywhere
folder = cache.usable_folder(Path(sys.argv[1]))
assert folder != Path(sys.argv[1])
KernelLibrary("compiled", folder, "test").load(doubling)
assert not BUILT
KernelLibrary("compiled", folder, "test").load(tripling)
assert len(list((folder / "lib").iterdir())) == 1
"""


@pytest.mark.slow
@needs_compiler
def test_a_cache_that_can_only_be_read_is_read_and_what_it_lacks_is_compiled_for_the_run(tmp_path):
    warm = tmp_path / "warm"
    KernelLibrary("compiled", warm, "test").load(doubling)
    before = sorted(warm.rglob("*"))
    done = subprocess.run([sys.executable, "-c", READ_ONLY, str(warm)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"compiling kernels for this run only: the cache {warm} lacks them and cannot be written\n"
    assert sorted(warm.rglob("*")) == before
