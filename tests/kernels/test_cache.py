"""Where kernels are kept: the folder that the environment says, or one that goes away with its process."""

import logging
import os
import subprocess
import sys
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from cnpgen.cli.notices import notices
from cnpgen.errors import MachineError
from cnpgen.kernels.cache import default_cache_folder, writable_folder
from cnpgen.kernels.library import KernelLibrary, choose_backend
from tests.conftest import needs_compiler

FALLBACK = """
import os, sys, warnings
from pathlib import Path
from cnpgen.kernels.cache import writable_folder
warnings.simplefilter("ignore")
folder = writable_folder(Path(sys.argv[1]))
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
        assert writable_folder(tmp_path / "new") == tmp_path / "new"


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
