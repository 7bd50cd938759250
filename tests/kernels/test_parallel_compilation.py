"""Parallel compilation gives the same kernels as sequential compilation."""

import threading
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from cnpgen.errors import MachineError
from cnpgen.kernels import parallel_compilation
from cnpgen.kernels.compiled_kernel import CompiledKernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.parallel_compilation import PendingKernel
from cnpgen.kernels.tape import Tape
from tests.conftest import HANGING, needs_compiler

pytestmark = needs_compiler


def power(*, exponent: int):
    x = ca.SX.sym("x")
    return ca.Function("power", [x], [x**exponent])


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[Tape]:
    """Record the compiled tapes, in no order."""
    tapes: list[Tape] = []
    real = parallel_compilation.compile_tape

    def compile_tape(tape: Tape, folder: Path) -> Path:
        tapes.append(tape)
        return real(tape, folder)

    monkeypatch.setattr(parallel_compilation, "compile_tape", compile_tape)
    return tapes


def test_kernels_are_ready_after_the_block_and_correct(tmp_path, compiled):
    library = KernelLibrary("compiled", tmp_path, "test")
    with library.compile_in_parallel():
        kernels = {k: library.load(power, exponent=k) for k in (2, 3, 4)}
    assert len(compiled) == len(list((tmp_path / "lib").glob("power-*.so"))) == 3
    for k, kernel in kernels.items():
        np.testing.assert_allclose(
            kernel(np.array([[1.0, 2.0, 3.0]]))[0], [[1.0, 2.0**k, 3.0**k]], rtol=1e-15
        )


def test_an_early_call_waits_for_the_compilation(tmp_path):
    library = KernelLibrary("compiled", tmp_path, "test")
    with library.compile_in_parallel():
        (cube,) = library.load(power, exponent=3)(np.array([[2.0]]))
    assert cube == 8.0


def test_equal_tapes_are_compiled_once_and_cached_ones_not_at_all(tmp_path, compiled):
    library = KernelLibrary("compiled", tmp_path, "test")
    with library.compile_in_parallel():
        first, second = (library.load(power, exponent=2) for _ in range(2))
    assert len(compiled) == 1
    assert isinstance(first, PendingKernel)
    np.testing.assert_array_equal(first(np.ones((1, 3))), second(np.ones((1, 3))))
    with library.compile_in_parallel():
        assert isinstance(library.load(power, exponent=2), CompiledKernel)
    assert isinstance(library.load(power, exponent=3), CompiledKernel)
    assert len(compiled) == 1


def test_kernels_are_compiled_concurrently(tmp_path, monkeypatch):
    """Check with two compilers that wait for each other, which would never end sequentially."""
    meeting = threading.Barrier(2, timeout=HANGING)
    real = parallel_compilation.compile_tape

    def compile_tape(tape: Tape, folder: Path) -> Path:
        meeting.wait()
        return real(tape, folder)

    monkeypatch.setattr(parallel_compilation, "compile_tape", compile_tape)
    monkeypatch.setattr(parallel_compilation.os, "cpu_count", lambda: 2)
    library = KernelLibrary("compiled", tmp_path, "test")
    with library.compile_in_parallel():
        for k in (2, 3):
            library.load(power, exponent=k)


def test_a_failed_compilation_raises_at_the_end_of_the_block(tmp_path, monkeypatch):
    def fail(*_: object) -> Path:
        raise MachineError("cc failed")

    monkeypatch.setattr(parallel_compilation, "compile_tape", fail)
    library = KernelLibrary("compiled", tmp_path, "test")
    with pytest.raises(MachineError, match="cc failed"), library.compile_in_parallel():
        library.load(power, exponent=2)


def test_after_an_error_no_compiler_is_started(tmp_path, monkeypatch, compiled):
    monkeypatch.setattr(parallel_compilation.os, "cpu_count", lambda: 1)
    library = KernelLibrary("compiled", tmp_path, "test")

    def load_and_fail() -> None:
        for k in range(2, 12):
            library.load(power, exponent=k)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), library.compile_in_parallel():
        load_and_fail()
    assert len(compiled) < 10
    assert isinstance(library.load(power, exponent=12), CompiledKernel)
