"""First code at once, final code from a detached process, and its replacement while a kernel is in use."""

import subprocess
import sys
import time
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from cnpgen.kernels import code_cache, compiled_kernel, optimizer
from cnpgen.kernels.code_cache import find_final, request_final, tape_key
from cnpgen.kernels.compiled_kernel import CompiledKernel
from cnpgen.kernels.machine_code import FINAL, FIRST, generate
from cnpgen.kernels.optimizer import Replacer, fulfil, optimizer_lock
from cnpgen.kernels.tape import Tape, tape_from_function
from tests.conftest import HANGING
from tests.kernels.test_machine_code import random_program

ARGUMENT = np.random.default_rng(0).uniform(-0.7, 0.7, (9, 21))


def long_tape(seed: int = 5) -> Tape:
    """Build a tape that is too long for final code at once."""
    tape = tape_from_function(random_program(seed, 5000))
    assert len(tape) > code_cache.MAX_DIRECT
    return tape


@pytest.fixture
def replacer(monkeypatch) -> Replacer:
    """Use a replacer of the test's own, and no code of earlier tests."""
    own = Replacer()
    monkeypatch.setattr(compiled_kernel, "replacer", own)
    forget(monkeypatch)
    return own


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(code_cache, "_loaded", {})
    monkeypatch.setattr(compiled_kernel, "_first", {})


@pytest.fixture
def generated(monkeypatch) -> list[int]:
    """Record the levels of all code that this process generates."""
    levels: list[int] = []

    def record(text: str, level: int) -> bytes:
        levels.append(level)
        return generate(text, level)

    monkeypatch.setattr(code_cache, "generate", record)
    return levels


@pytest.fixture
def no_process(monkeypatch) -> None:
    """Let no detached process start."""
    monkeypatch.setattr(Replacer, "_start_process", lambda *_: True)


def assert_equal(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_detached_process_optimizes_and_the_kernel_in_use_is_replaced(
    replacer,
    generated,
    tmp_path,
):
    kernel = CompiledKernel(long_tape(), tmp_path)
    address, first = kernel.address, kernel(ARGUMENT)
    assert FIRST in generated
    assert replacer.wait(HANGING)
    assert kernel.address == address  # other C code has it
    assert_equal(kernel(ARGUMENT), first)
    (key,) = [path.stem for path in (tmp_path / "lib").glob("*.o") if path.stem == tape_key(long_tape())]  # fmt: skip
    assert not list((tmp_path / "lib").glob("*.tape"))
    (code,) = compiled_kernel._first.values()
    target = optimizer.ctypes.c_void_p.from_address(code.address("target")).value
    assert target == find_final(key, tmp_path).address("kernel")


def test_a_request_that_was_left_behind_is_fulfilled_by_the_next_command(
    replacer, no_process, tmp_path, monkeypatch
):
    kernel = CompiledKernel(long_tape(), tmp_path)
    first = kernel(ARGUMENT)
    (request,) = (tmp_path / "lib").glob("*.tape")
    monkeypatch.undo()
    own = Replacer()
    monkeypatch.setattr(compiled_kernel, "replacer", own)
    forget(monkeypatch)
    again = CompiledKernel(long_tape(), tmp_path)
    assert own.wait(HANGING)
    deadline = time.monotonic() + HANGING
    while request.exists() and time.monotonic() < deadline:
        time.sleep(0.01)  # it is removed after the code is there
    assert not request.exists()
    assert_equal(again(ARGUMENT), first)


def test_the_next_command_uses_final_code_only(
    replacer,
    no_process,
    generated,
    tmp_path,
    monkeypatch,
):
    CompiledKernel(long_tape(), tmp_path)
    (request,) = (tmp_path / "lib").glob("*.tape")
    fulfil(request, tmp_path)
    forget(monkeypatch)
    generated.clear()
    CompiledKernel(long_tape(), tmp_path)
    assert generated == []


@pytest.mark.parametrize("content", [b"", b"no tape at all", None])
def test_a_damaged_request_is_removed(tmp_path, content):
    tape = long_tape()
    request = request_final(tape_key(tape), tape, tmp_path)
    assert request is not None
    request.write_bytes(request.read_bytes()[:-1] if content is None else content)
    fulfil(request, tmp_path)
    assert list((tmp_path / "lib").iterdir()) == []


def test_a_request_of_another_version_is_removed(tmp_path):
    request = request_final("0" * 32, long_tape(), tmp_path)
    assert request is not None
    fulfil(request, tmp_path)
    assert list((tmp_path / "lib").iterdir()) == []


def test_without_a_place_for_requests_the_first_code_stays(
    replacer,
    generated,
    tmp_path,
    monkeypatch,
):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    kernel = CompiledKernel(long_tape(), tmp_path)
    kernel(ARGUMENT)
    assert replacer.wait(0)
    assert sorted(generated) == [FIRST, FINAL]  # the kernel and its caller


def test_a_process_that_always_fails_is_not_started_again_and_again(
    replacer, tmp_path, monkeypatch
):
    monkeypatch.setattr(optimizer, "START", "raise SystemExit(1)")
    kernel = CompiledKernel(long_tape(), tmp_path)
    first = kernel(ARGUMENT)
    replacer._thread.join(HANGING)
    assert len(replacer._processes) == optimizer.MAX_STARTS
    assert_equal(kernel(ARGUMENT), first)


def test_one_process_per_cache_works_on_requests(tmp_path):
    tape = long_tape()
    request = request_final(tape_key(tape), tape, tmp_path)
    assert request is not None
    command = [sys.executable, "-c", optimizer.START, str(tmp_path), *sys.path]
    with optimizer_lock(tmp_path / "lib") as free:
        assert free
        subprocess.run(command, check=True, timeout=HANGING)
        assert request.exists()
    subprocess.run(command, check=True, timeout=HANGING)
    assert not request.exists()
    assert find_final(tape_key(tape), tmp_path) is not None


SHORT = """
import sys
from pathlib import Path
from cnpgen.kernels.compiled_kernel import CompiledKernel
from tests.kernels.test_optimizer import ARGUMENT, long_tape
CompiledKernel(long_tape(), Path(sys.argv[1]))(ARGUMENT)
"""


def test_optimization_goes_on_when_the_command_has_ended(tmp_path):
    command = [sys.executable, "-c", SHORT, str(tmp_path)]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[2])
    final = tmp_path / "lib" / f"{tape_key(long_tape())}.o"
    deadline = time.monotonic() + HANGING
    while not final.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert final.exists()


def test_equal_kernels_share_their_first_code(replacer, no_process, tmp_path):
    one, other = (CompiledKernel(long_tape(), tmp_path) for _ in range(2))
    assert one.address == other.address
    x = ca.SX.sym("x", 9)
    named = ca.Function("named", [x], list(random_program(5, 5000)(x)))
    assert CompiledKernel(tape_from_function(named), tmp_path).address == one.address
