"""Check of the machine: what works, what is missing, and remedies."""

import ctypes
import dataclasses
import importlib
import json
import os
import re
import sys
import tomllib
import types
from pathlib import Path

import pytest

from cnpgen.cli.doctor_command import machine_text
from cnpgen.kernels import c_library
from cnpgen.kernels.c_library import compile_source, this_variants
from cnpgen.kernels.compiler import find_compiler
from cnpgen.machine import threads
from cnpgen.validate import machine
from cnpgen.validate.machine import check_machine, vector_instructions
from tests.conftest import needs_compiler
from tests.examples.installed import installed_kind


@pytest.fixture
def fresh_compiler():
    find_compiler.cache_clear()
    yield
    find_compiler.cache_clear()


def test_this_machine_has_no_problems():
    report = check_machine()
    assert report.ok, report.problems
    assert report.libraries["pin"][0].isdigit()
    assert report.backend in {"compiled", "numpy"}
    assert 1 <= report.cores <= report.cores_present
    assert report.hdf5[0].isdigit()
    assert report.free_bytes > 0
    assert "13 datasets" in report.recipes


@pytest.mark.parametrize(
    ("group", "note"),
    [
        ("cnpgen.exportes", "did you mean 'cnpgen.exporters'"),
        (
            "cnpgen.exporters",
            "exporter 'odd' of odd (no_such_module:X) cannot be imported",
        ),
    ],
)
def test_plugins_are_listed_and_those_without_use_are_noted(
    tmp_path, monkeypatch, group, note
):
    assert check_machine().plugins == ()
    with installed_kind(tmp_path, "odd", "no_such_module:X", monkeypatch, group=group):
        report = check_machine()
    assert report.ok
    assert report.plugins == (f"odd ({group}) of odd",)
    (text,) = (each for each in report.notes if "'odd'" in each)
    assert note in text


def test_every_dependency_is_checked():
    declared = tomllib.loads(
        (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    )["project"]
    assert sorted(
        machine.PROJECTS.get(name, name) for name in machine.REQUIRED_MODULES
    ) == sorted(re.split("[<>=]", item)[0] for item in declared["dependencies"])


def test_the_report_is_frozen_and_converts_to_json():
    report = check_machine()
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.backend = ""
    content = json.loads(json.dumps(report.to_dict()))
    assert content["ok"] is True
    assert content["libraries"]["numpy"]


def test_the_other_project_called_pinocchio_is_recognized(monkeypatch):
    monkeypatch.setitem(sys.modules, "pinocchio", types.ModuleType("pinocchio"))
    report = check_machine()
    assert not report.ok
    (problem,) = report.problems
    assert "another project of that name" in problem
    assert "pip uninstall pinocchio" in problem
    assert problem.endswith("--force-reinstall pin'")


def _import_failing(monkeypatch, broken, error):
    original = importlib.import_module

    def fail(name, *rest):
        if name == broken:
            raise error
        return original(name, *rest)

    monkeypatch.setattr(machine.importlib, "import_module", fail)


def test_a_missing_library_is_named_with_its_project(monkeypatch):
    _import_failing(
        monkeypatch,
        "pinocchio",
        ModuleNotFoundError("No module named 'pinocchio'", name="pinocchio"),
    )
    report = check_machine()
    assert report.libraries["pin"] == "missing"
    assert report.problems[0].startswith("pin is not installed: run '")


@pytest.mark.parametrize(
    "error",
    [
        ImportError("libboost.so.1:\n cannot open"),
        ModuleNotFoundError("No module named 'eigenpy'", name="eigenpy"),
        RuntimeError("compiled for another NumPy"),
    ],
)
def test_a_broken_library_is_one_line_with_a_remedy(monkeypatch, error):
    _import_failing(monkeypatch, "coal", error)
    report = check_machine()
    assert report.libraries["coal"] == "broken"
    assert "\n" not in report.problems[0]
    assert "--force-reinstall coal" in report.problems[0]


def test_a_deleted_working_directory_is_a_note(monkeypatch, tmp_path):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    report = check_machine()
    assert report.ok
    assert report.free_bytes == 0
    assert any(
        note.startswith("the working directory cannot be read (No such file")
        for note in report.notes
    )


def test_a_missing_plotting_library_is_only_a_note(monkeypatch):
    _import_failing(
        monkeypatch,
        "matplotlib",
        ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib"),
    )
    report = check_machine()
    assert report.ok
    assert any("--plot" in note for note in report.notes)


@pytest.mark.parametrize("built", [False, True])
def test_without_a_compiler_kernels_are_generated(
    monkeypatch, fresh_compiler, tmp_path, built
):
    monkeypatch.setenv("CC", "no-such-compiler")
    monkeypatch.setattr(c_library, "BUILT_FOLDER", tmp_path)
    if built:  # files that look like the libraries of the package
        names = c_library.built_file_name
        monkeypatch.setattr(
            c_library, "find_built", lambda p: tmp_path / names(p, this_variants()[0])
        )
    report = check_machine()
    assert report.ok
    assert report.backend == "compiled"
    assert report.generator.startswith("llvmlite ")
    assert report.compiler == ""
    assert report.environment["CC"] == "no-such-compiler"
    assert any("no C compiler" in note for note in report.notes) is not built
    assert ("compiled with the package" in report.handwritten) is built


@needs_compiler
def test_the_compiler_of_a_package_is_used_if_there_is_no_other(
    monkeypatch, tmp_path, fresh_compiler
):
    """Replace the compiler of ziglang by a module that runs the one of this machine."""
    (tmp_path / "ziglang").mkdir()
    call = f"subprocess.call([{find_compiler()!r}, *sys.argv[2:]], env={{'PATH': {os.environ['PATH']!r}}})"
    program = f"import subprocess, sys\nsys.exit({call})\n"
    (tmp_path / "ziglang" / "__main__.py").write_text(program, encoding="utf-8")
    (tmp_path / "ziglang" / "__init__.py").touch()
    find_compiler.cache_clear()
    for variable, value in (
        ("PATH", "/none"),
        ("PYTHONPATH", str(tmp_path)),
        ("CNPGEN_CACHE", str(tmp_path / "cache")),
    ):
        monkeypatch.setenv(variable, value)
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    report = check_machine()
    assert report.compiler.startswith(sys.executable)
    source = tmp_path / "one.c"
    source.write_text("int one(void) { return 1; }")
    assert ctypes.CDLL(str(compile_source([source], tmp_path / "cache"))).one() == 1


@pytest.mark.extended
def test_the_compiler_of_ziglang_compiles_without_a_home_folder(
    monkeypatch, tmp_path, fresh_compiler
):
    pytest.importorskip("ziglang")
    monkeypatch.delenv("CC", raising=False)
    for variable, value in (
        ("PATH", ""),
        ("HOME", "/dev/null/none"),
        ("CNPGEN_CACHE", str(tmp_path / "cache")),
    ):
        monkeypatch.setenv(variable, value)
    report = check_machine()
    assert "ziglang" in report.compiler
    source = tmp_path / "one.c"
    source.write_text("int one(void) { return 1; }")
    assert ctypes.CDLL(str(compile_source([source], tmp_path / "cache"))).one() == 1
    assert list((tmp_path / "cache" / "ziglang").iterdir())


def test_an_unwritable_cache_is_a_note_and_nothing_is_left_behind(
    monkeypatch, tmp_path
):
    (tmp_path / "file").write_text("")
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    report = check_machine()
    assert report.ok
    assert not report.cache_writable
    assert not report.cache_used
    assert any("CNPGEN_CACHE" in note for note in report.notes)
    assert list((tmp_path / "tmp").iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="files have no owners here")
def test_a_cache_or_a_kernel_that_others_may_write_to_is_a_note(monkeypatch, tmp_path):
    (tmp_path / "cache" / "lib").mkdir(0o700, parents=True)
    (tmp_path / "cache").chmod(0o777)
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path / "cache"))
    report = check_machine()
    assert not report.cache_used
    assert any(
        f"others may write to {tmp_path / 'cache'}" in note for note in report.notes
    )
    assert f"{tmp_path / 'cache'} (not used)" in " ".join(machine_text(report).split())
    (tmp_path / "cache").chmod(0o700)
    (planted := tmp_path / "cache" / "lib" / "ik-123.so").write_bytes(b"")
    planted.chmod(0o666)
    report = check_machine()
    assert report.cache_used
    assert any(
        "are not used (1)" in note and str(planted) in note for note in report.notes
    )


def test_a_container_with_fewer_cores_is_a_note(monkeypatch):
    monkeypatch.setattr(
        machine.os, "sched_getaffinity", lambda _pid: set(range(64)), raising=False
    )
    report = check_machine()
    assert report.cores < 64
    assert any(
        note.startswith("this container may use") and re.search(r" workers?$", note)
        for note in report.notes
    )


def test_recipes_that_do_not_load_are_a_problem(monkeypatch, tmp_path):
    monkeypatch.setattr("cnpgen.schema.catalogue.recipes_root", lambda: tmp_path)
    report = check_machine()
    assert not report.ok
    assert "no recipes" in report.problems[0]


def test_little_free_disk_is_a_note(monkeypatch):
    monkeypatch.setattr(machine, "MIN_DISK_BYTES", 10**30)
    assert any("MB are free" in note for note in check_machine().notes)


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        ("sse2 avx avx2 avx512f", "avx512"),
        ("sse2 avx avx2", "avx2"),
        ("sse2", "sse2"),
        ("none", "unknown"),
    ],
)
def test_vector_instructions_are_read_from_cpuinfo(monkeypatch, flags, name):
    monkeypatch.setattr(machine.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(
        machine.Path,
        "read_text",
        lambda *_, **__: f"processor : 0\nflags\t\t: fpu {flags}\n",
    )
    assert vector_instructions() == name


def test_arm_has_neon(monkeypatch):
    monkeypatch.setattr(machine.platform, "machine", lambda: "arm64")
    assert vector_instructions() == "neon"


def test_variables_that_the_user_did_not_set_are_not_reported(monkeypatch):
    for name in threads.VARIABLES:
        monkeypatch.setenv(name, "")  # restored after the test, set or not
        monkeypatch.delenv(name)
    monkeypatch.setenv("MKL_NUM_THREADS", "1")
    monkeypatch.setattr(threads, "_preferred", {})
    threads.prefer_one_thread()
    assert all(os.environ[name] == "1" for name in threads.VARIABLES)
    assert set(threads.VARIABLES) & check_machine().environment.keys() == {
        "MKL_NUM_THREADS"
    }
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    assert check_machine().environment["OMP_NUM_THREADS"] == "4"
