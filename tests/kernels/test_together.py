"""Kernels that are compiled side by side are those that are compiled one by one."""

import threading
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from cnpgen.errors import MachineError
from cnpgen.kernels import together
from cnpgen.kernels.compiled import CompiledKernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.tape import Tape
from cnpgen.kernels.together import PendingKernel
from tests.conftest import HANGING, needs_compiler

pytestmark = needs_compiler


def power(*, exponent: int):
    x = ca.SX.sym("x")
    return ca.Function("power", [x], [x**exponent])


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[Tape]:
    """The tapes that are given to the compiler, in no order."""
    tapes: list[Tape] = []
    real = together.compile_tape

    def compile_tape(tape: Tape, folder: Path) -> Path:
        tapes.append(tape)
        return real(tape, folder)

    monkeypatch.setattr(together, "compile_tape", compile_tape)
    return tapes


def test_kernels_are_ready_after_the_block_and_compute_what_they_should(tmp_path, compiled):
    library = KernelLibrary("compiled", tmp_path, "test")
    with library.compiling_together():
        kernels = {k: library.load(power, exponent=k) for k in (2, 3, 4)}
    assert len(compiled) == len(list((tmp_path / "lib").glob("power-*.so"))) == 3
    for k, kernel in kernels.items():
        np.testing.assert_allclose(kernel(np.array([[1.0, 2.0, 3.0]]))[0], [[1.0, 2.0**k, 3.0**k]], rtol=1e-15)


def test_a_kernel_that_is_called_early_is_waited_for(tmp_path):
    library = KernelLibrary("compiled", tmp_path, "test")
    with library.compiling_together():
        (cube,) = library.load(power, exponent=3)(np.array([[2.0]]))
    assert cube == 8.0


def test_equal_tapes_are_compiled_once_and_cached_ones_not_at_all(tmp_path, compiled):
    library = KernelLibrary("compiled", tmp_path, "test")
    with library.compiling_together():
        first, second = (library.load(power, exponent=2) for _ in range(2))
    assert len(compiled) == 1
    assert isinstance(first, PendingKernel)
    np.testing.assert_array_equal(first(np.ones((1, 3))), second(np.ones((1, 3))))
    with library.compiling_together():
        assert isinstance(library.load(power, exponent=2), CompiledKernel)
    assert isinstance(library.load(power, exponent=3), CompiledKernel)
    assert len(compiled) == 1


def test_they_are_compiled_at_the_same_time(tmp_path, monkeypatch):
    """Two compilers that wait for each other: one by one they would wait for ever."""
    meeting = threading.Barrier(2, timeout=HANGING)
    real = together.compile_tape

    def compile_tape(tape: Tape, folder: Path) -> Path:
        meeting.wait()
        return real(tape, folder)

    monkeypatch.setattr(together, "compile_tape", compile_tape)
    monkeypatch.setattr(together.os, "cpu_count", lambda: 2)
    library = KernelLibrary("compiled", tmp_path, "test")
    with library.compiling_together():
        for k in (2, 3):
            library.load(power, exponent=k)


def test_a_compiler_that_fails_is_told_at_the_end_of_the_block(tmp_path, monkeypatch):
    def fail(*_: object) -> Path:
        raise MachineError("cc failed")

    monkeypatch.setattr(together, "compile_tape", fail)
    library = KernelLibrary("compiled", tmp_path, "test")
    with pytest.raises(MachineError, match="cc failed"), library.compiling_together():
        library.load(power, exponent=2)


def test_after_an_error_no_compiler_is_started(tmp_path, monkeypatch, compiled):
    monkeypatch.setattr(together.os, "cpu_count", lambda: 1)
    library = KernelLibrary("compiled", tmp_path, "test")

    def load_and_fail() -> None:
        for k in range(2, 12):
            library.load(power, exponent=k)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), library.compiling_together():
        load_and_fail()
    assert len(compiled) < 10
    assert isinstance(library.load(power, exponent=12), CompiledKernel)
