"""Handwritten C: its compilation, its cache, and compilers that do not work."""

import ctypes
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from cnpgen.errors import MachineError
from cnpgen.kernels import c_library, compiler
from cnpgen.kernels.c_library import (
    compile_source,
    library_file_stem,
    load_library,
    source_text,
)
from cnpgen.kernels.compiler import find_compiler
from cnpgen.store.files.cache_folder import exclusive_lock, make_private_folder
from tests.conftest import HANGING, needs_compiler
from tests.machine.test_workers import alive
from tests.refusals import is_refused

BROKEN = {
    "fails": ("CC", "/bin/false", "/bin/false does not run"),
    "makes nothing": ("CC", "/bin/true", "/bin/true failed with exit code 0"),
    "does not exist": ("CC", "/nowhere/cc", "no C compiler found"),
    "does not exist, with options": (
        "CC",
        "/nowhere/cc -O2",
        "no C compiler found: CC is '/nowhere/cc -O2'",
    ),
    "is not quoted right": ("CC", "cc '-O2", "no C compiler found: CC is"),
    "is not installed": ("PATH", "", "no C compiler found"),
}


@pytest.fixture
def source(tmp_path: Path, fresh_compiler: None) -> Path:
    (tmp_path / "answer.c").write_text("int answer(void) { return 42; }\n")
    return tmp_path / "answer.c"


@pytest.fixture
def compiled(monkeypatch) -> list[Path]:
    """Record the files that the compiler is called for."""
    sources: list[Path] = []
    real = c_library.run_compiler

    def run(compiler: str, flags: tuple[str, ...], source: Path, built: Path) -> None:
        sources.append(source)
        real(compiler, flags, source, built)

    monkeypatch.setattr(c_library, "run_compiler", run)
    return sources


@needs_compiler
def test_a_library_is_compiled_once_for_many_concurrent_processes(
    source, tmp_path, compiled
):
    with ThreadPoolExecutor(3) as pool:
        paths = set(pool.map(lambda _: compile_source([source], tmp_path), range(3)))
    assert len(paths) == len(compiled) == 1
    (path,) = paths
    assert [file.name for file in (tmp_path / "lib").iterdir()] == [path.name]
    assert ctypes.CDLL(str(path)).answer() == 42


@needs_compiler
@pytest.mark.parametrize("kept", [0, 100, -1])
def test_a_damaged_library_is_compiled_again(source, tmp_path, compiled, kept):
    path = compile_source([source], tmp_path)
    whole = path.read_bytes()
    path.unlink()
    path.write_bytes(whole[:kept])
    again = compile_source([source], tmp_path)
    assert len(compiled) == 2
    assert again.read_bytes() == whole


@needs_compiler
def test_the_wait_for_a_stopped_compilation_ends_at_the_time_limit(
    source, tmp_path, monkeypatch
):
    stem = library_file_stem("answer", source_text([source]), find_compiler() or "")
    lock = tmp_path / "lib" / f".{stem}.lock"
    make_private_folder(lock.parent)
    monkeypatch.setattr("cnpgen.store.files.cache_folder.MAX_LOCK_WAIT_S", 0.1)
    with exclusive_lock(lock):
        began = time.monotonic()
        assert compile_source([source], tmp_path).exists()
        assert time.monotonic() - began >= 0.1


@needs_compiler
def test_the_source_and_options_are_part_of_the_name_of_a_library():
    stems = {
        library_file_stem("one", text, (find_compiler() or "") + options)
        for text in ("", "int x;")
        for options in ("", " -O3", " -O3 -g")
    }
    assert len(stems) == 6


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_compiler_is_an_error(source, tmp_path, monkeypatch, what):
    name, value, text = BROKEN[what]
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv(name, value)
    monkeypatch.setattr(compiler, "find_spec", lambda _: None)  # no ziglang
    with pytest.raises(MachineError, match=text):
        compile_source([source], tmp_path)
    with is_refused(MachineError):
        load_library((source,), tmp_path)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_a_compilation_that_hangs_is_announced_and_killed(
    source, tmp_path, monkeypatch, caplog
):
    hanging = tmp_path / "cc"
    version = 'if [ "$1" = --version ]; then echo fake 1.0; exit; fi'
    hanging.write_text(
        f"#!/bin/sh\n{version}\nsleep 1000 &\necho $! > {tmp_path}/child\nwait\n"
    )
    hanging.chmod(0o755)
    monkeypatch.setenv("CC", str(hanging))
    monkeypatch.setattr(compiler, "MIN_COMPILE_LIMIT_S", 1.0)
    monkeypatch.setattr(compiler, "LIMIT_S_PER_BYTE", 0.0)
    monkeypatch.setattr(compiler, "NOTICE_AFTER_S", 0.3)
    with (
        caplog.at_level("INFO"),
        is_refused(MachineError),
    ):
        compile_source([source], tmp_path)
    assert any("has taken 0.3 s for answer.c" in text for text in caplog.messages)
    child, deadline = int((tmp_path / "child").read_text()), time.monotonic() + HANGING
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not alive(child)


@needs_compiler
@pytest.mark.parametrize("command", ["'{cc}' -g", "{cc} -DNAME='two words'", "{cc}"])
def test_cc_may_be_a_path_with_spaces_and_options(
    source, monkeypatch, tmp_path, command
):
    """Check wrappers such as ccache: CC="ccache gcc"."""
    spaces = "'{cc}'" in command or command == "{cc}"
    path = tmp_path / ("my compilers" if spaces else "bin") / "cc"
    path.parent.mkdir()
    path.write_text(
        f'#!/bin/sh\nprintf "%s|" "$@" >> "{tmp_path}/seen"\nexec {find_compiler()} "$@"\n'
    )
    path.chmod(0o755)
    compiler.find_compiler.cache_clear()
    monkeypatch.setenv("CC", command.format(cc=path))
    assert compile_source([source], tmp_path).exists()
    seen = (tmp_path / "seen").read_text()
    options = {"'{cc}' -g": "-g|", "{cc} -DNAME='two words'": "-DNAME=two words|"}
    assert options.get(command, "--version|") in seen
    assert "-shared|" in seen


PLAN = """
import sys
from cnpgen.cli.main import main
sys.exit(main(["make-dataset", "airhockey-hit", "--n", "30", "-o", sys.argv[1], "--workers", "1"]))
"""


@pytest.mark.slow
def test_a_dataset_is_made_without_a_compiler(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "/nowhere/cc")
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path / "cache"))
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PLAN, str(tmp_path / "out")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
