"""Machine code by LLVM: equal bits at all levels, for all instruction sets and as compiled C; its cache."""

import ctypes
import itertools
import math
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from cnpgen.errors import MachineError
from cnpgen.kernels import code_cache, compiled_kernel, lowering, machine_code
from cnpgen.kernels.code_cache import tape_key
from cnpgen.kernels.compiled_kernel import CompiledGridKernel, CompiledKernel
from cnpgen.kernels.compiler import native_flags, require_compiler, run_compiler
from cnpgen.kernels.interpreted_kernel import InterpretedKernel
from cnpgen.kernels.llvm_module import module_text
from cnpgen.kernels.lowering import lower
from cnpgen.kernels.machine_code import (
    FINAL,
    FIRST,
    Processor,
    generate,
    load,
    this_processor,
)
from cnpgen.kernels.tape import CODES, GridSpec, Loop, Tape, tape_from_function
from tests.conftest import needs_compiler
from tests.kernels.c_reference import emit
from tests.kernels.test_kernels import BINARY, SPECIAL, UNARY, machine_flags
from tests.refusals import is_refused

Array = np.ndarray
SETS = {  # model of a processor with each width of vectors, and the flags it needs
    "x86-64": ("", {"sse2"}),
    "sandybridge": ("+avx", {"avx"}),
    "haswell": ("+avx,+avx2,+fma", {"avx2", "fma"}),
    "skylake-avx512": ("+avx,+avx2,+fma,+avx512f,+avx512dq,+avx512vl", {"avx512dq", "avx512vl"}),
}  # fmt: skip
LOOP = Loop(1e-9, 30)


def variants() -> Iterator[tuple[str, Processor, int]]:
    """Yield this processor at both levels, and those whose instructions it has."""
    here = this_processor()
    for level in (FIRST, FINAL):
        yield f"level {level}", here, level
    if platform.machine() == "x86_64":
        for name, (features, needed) in SETS.items():
            if needed <= machine_flags():
                yield name, Processor(here.triple, name, features), FINAL


def runner(tape: Tape, processor: Processor, level: int) -> Callable[..., list[Array]]:
    """Return a function that evaluates a tape without a grid."""
    code = load(generate(module_text(tape, processor.vector_bytes), level, processor))
    return _runner(tape, code.address("kernel"), code)


def _runner(tape: Tape, address: int, owner: object) -> Callable[..., list[Array]]:
    function = ctypes.CFUNCTYPE(None, ctypes.c_long, *[ctypes.c_void_p] * 3)(address)

    def run(*arguments: Array) -> list[Array]:
        assert owner is not None
        n = arguments[0].shape[1]
        out = [np.empty((width, n)) for width in tape.outputs]
        pointers = [(ctypes.c_void_p * len(x))(*(a.ctypes.data for a in x)) for x in (arguments, out)]  # fmt: skip
        strides = (ctypes.c_long * len(arguments))(*(a.strides[0] // 8 for a in arguments))  # fmt: skip
        function(n, pointers[0], strides, pointers[1])
        return out

    return run


def bits(arrays: list[Array]) -> list[Array]:
    """Return the bits of results; all nans are one."""
    return [np.where(np.isnan(a), np.nan, a).view(np.int64) for a in arrays]


def assert_equal_bits(found: list[Array], expected: list[Array], name: str) -> None:
    for one, other in zip(bits(found), bits(expected), strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)


def all_positions() -> ca.Function:
    """Build every operation on inputs, on a constant in either place, on one value twice, and on each other."""
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    first = [f(x) for f in UNARY.values() for x in (a, a * b, a + b)]
    second = [
        f(x, y)
        for f in BINARY.values()
        for x, y in ((a, b), (a, 0.7), (0.7, b), (a, a), (a * b, b), (a, a - b))
    ]
    sums = [a * b + b * b, a * b - 2.5 * a, b - a * b, a * b + a * b, (a * b) * (a * b + 1)]  # fmt: skip
    return ca.Function("positions", [a, b], [ca.vertcat(*first, *second, *sums)])


def iteration() -> ca.Function:
    """Build Newton's iteration for the cube root, with a product of parameters that is computed before it."""
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 2)
    target = p[0] * p[1] + p[1]
    change = (x[0] ** 3 - target) / (3 * x[0] ** 2)
    state = ca.vertcat(x[0] - change, x[1] * x[0] + ca.sin(p[0] * x[1]))
    return ca.Function("cube", [x, p], [state, ca.fabs(change)])


def random_program(seed: int, count: int) -> ca.Function:
    """Build a random program in which most operands are recent, as in real tapes."""
    random = np.random.default_rng(seed)
    x = ca.SX.sym("x", 9)
    values = [x[i] for i in range(9)]
    for _ in range(count):
        a, b = (values[-1 - int(random.exponential(6)) % len(values)] for _ in range(2))
        kind = random.integers(8)
        values.append(
            ca.sin(a) if kind == 0
            else ca.fmin(a, b) if kind == 1
            else a * b if kind < 5
            else a + b if kind < 7
            else a - b
        )  # fmt: skip
    results = values[9::4]
    return ca.Function("program", [x], [ca.vertcat(*results[::2]), ca.vertcat(*results[1::2])])  # fmt: skip


def positions_case() -> tuple[Tape, list[Array]]:
    special = np.array(list(itertools.product(SPECIAL, SPECIAL))).T
    numbers = np.random.default_rng(0).normal(size=(2, 500))
    both = np.concatenate([special, numbers], axis=1)
    return tape_from_function(all_positions()), [both[:1].copy(), both[1:].copy()]


def iteration_case() -> tuple[Tape, list[Array]]:
    random = np.random.default_rng(1)
    x, p = random.uniform(0.5, 2, (2, 203)), random.uniform(0.1, 3, (2, 203))
    p[:, 7::29] = math.nan  # these do not converge
    return tape_from_function(iteration(), LOOP), [x, p]


def program_case(count: int) -> tuple[Tape, list[Array]]:
    x = np.random.default_rng(2).uniform(-0.7, 0.7, (9, 77))
    return tape_from_function(random_program(3, count)), [x]


CASES = {
    "positions": positions_case,
    "iteration": iteration_case,
    "program": lambda: program_case(400),
    "long program": lambda: program_case(8000),
}


@pytest.mark.parametrize("case", CASES)
def test_lanes_levels_and_instruction_sets_give_equal_bits(case):
    tape, arguments = CASES[case]()
    expected: list[Array] = []
    for name, processor, level in variants():
        run = runner(tape, processor, level)
        found = run(*arguments)
        expected = expected or found
        assert_equal_bits(found, expected, name)
        for n in (1, 2, 3, 5, 13):  # fewer lanes than a vector has, and a rest
            part = run(*(np.ascontiguousarray(a[:, :n]) for a in arguments))
            assert_equal_bits(part, [result[:, :n] for result in expected], name)


@needs_compiler
@pytest.mark.skipif(
    "fma" not in machine_flags(), reason="C is contracted with FMA only"
)
@pytest.mark.parametrize(
    ("case", "level"), [("positions", "-O2"), ("iteration", "-O2"), ("program", "-O1")]
)
def test_compiled_c_of_a_tape_gives_the_same_bits(case, level, tmp_path, monkeypatch):
    """Compare with GCC, whose operations and contraction are those of published datasets."""
    if "clang" in require_compiler():
        pytest.skip("clang contracts other products")
    tape, arguments = CASES[case]()
    if level == "-O1":  # of long tapes, whose products are not contracted
        monkeypatch.setattr(lowering, "MAX_CONTRACTED", 0)
    source, built = tmp_path / "kernel.c", tmp_path / "kernel.so"
    source.write_text(emit(tape))
    flags = (level, "-ffp-contract=fast", *native_flags())
    run_compiler(require_compiler(), flags, source, built)
    library = ctypes.CDLL(str(built))
    address = ctypes.cast(library.kernel, ctypes.c_void_p).value
    assert address is not None
    found = runner(tape, this_processor(), FINAL)(*arguments)
    expected = _runner(tape, address, library)(*arguments)
    if case == "positions":  # C adds constants to 0, and contracts where it branches
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-14, atol=1e-300)
    else:
        assert_equal_bits(found, expected, case)


def test_numbers_are_those_of_numpy_up_to_contraction():
    tape, arguments = program_case(400)
    found = runner(tape, this_processor(), FINAL)(*arguments)
    for one, other in zip(found, InterpretedKernel(tape)(*arguments), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_grids_give_equal_bits_at_both_levels_and_for_all_lanes(dtype):
    a, b, c = (ca.SX.sym(name, 2) for name in "abc")
    function = ca.Function(
        "grid", [a, b, c], [ca.sin(a) * b + c[0] * a[1], ca.exp(a[0] * c[1]) * b[0]]
    )
    grid = GridSpec(("point", "lane", "node"), ("point", "lane"))
    tape = tape_from_function(function, grid=grid, dtype=dtype)
    random = np.random.default_rng(4)
    shapes = ((2, 5, 37), (2, 37), (2, 5))
    arguments = [random.normal(size=shape).astype(dtype) for shape in shapes]
    expected: list[Array] = []
    for name, processor, level in variants():
        code = load(generate(module_text(tape, processor.vector_bytes), level, processor))  # fmt: skip
        kernel = CompiledGridKernel.__new__(CompiledGridKernel)
        kernel.tape, kernel.grid = tape, grid
        kernel._function = compiled_kernel._GRID_FUNCTION(code.address("kernel"))
        out = [np.zeros((2, 5, 37), dtype), np.zeros((1, 37), dtype)]
        kernel(*arguments, out=out)
        expected = expected or out
        for one, other in zip(out, expected, strict=True):
            np.testing.assert_array_equal(one, other, err_msg=name)


def test_a_product_is_contracted_only_if_all_its_uses_are_sums():
    a, b, c = (ca.SX.sym(name) for name in "abc")

    def operations(value: ca.SX) -> list[str]:
        steps = lower(tape_from_function(ca.Function("f", [a, b, c], [value])))
        return sorted(step.operation for step in steps if step.operation in {"mul", "add", "sub", "fma"})  # fmt: skip

    assert operations(a * b + c) == operations(c - a * b) == ["fma"]
    assert operations(a * b + b * c) == ["fma", "mul"]
    product = a * b
    assert operations((product + c) * product) == ["add", "mul", "mul"]
    assert operations(ca.sqrt(product) + product) == ["add", "mul"]


# --- cache ---


def twice(name: str = "twice", factor: float = 2.0) -> Tape:
    x = ca.SX.sym("x")
    return tape_from_function(ca.Function(name, [x], [factor * x]))


@pytest.fixture
def fresh(monkeypatch) -> None:
    """Forget the code of this process."""
    forget(monkeypatch)


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(code_cache, "_loaded", {})
    monkeypatch.setattr(compiled_kernel, "_first", {})


@pytest.fixture
def generated(monkeypatch) -> list[int]:
    """Record the levels of all generated code."""
    levels: list[int] = []

    def record(text: str, level: int) -> bytes:
        levels.append(level)
        return generate(text, level)

    monkeypatch.setattr(code_cache, "generate", record)
    return levels


def evaluate(tape: Tape, folder: Path) -> float:
    return float(CompiledKernel(tape, folder)(np.full((1, 1), 3.0))[0].item())


def test_kernels_that_differ_in_their_name_only_are_generated_once(
    fresh, generated, tmp_path
):
    assert evaluate(twice("one"), tmp_path) == 6.0
    count = len(generated)
    assert evaluate(twice("another"), tmp_path) == 6.0
    assert len(generated) == count
    assert evaluate(twice(factor=2.5), tmp_path) == 7.5
    assert len(generated) == count + 1


def test_the_key_depends_on_the_content_the_processor_and_the_generator(monkeypatch):
    keys = {tape_key(twice()), tape_key(twice(factor=2.5))}
    for name, value in (
        ("this_processor", lambda: Processor("x86_64", "another", "+sse2")),
        ("generator_version", lambda: "llvmlite 99"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(machine_code, name, value)
            machine_code.generator_digest.cache_clear()
            keys.add(tape_key(twice()))
    machine_code.generator_digest.cache_clear()
    assert len(keys) == 4


@pytest.mark.parametrize("damage", ["empty", "cut off", "flipped", "garbage"])
def test_damaged_code_is_generated_again(
    fresh, generated, monkeypatch, tmp_path, damage
):
    assert evaluate(twice(), tmp_path) == 6.0
    path = tmp_path / "lib" / f"{tape_key(twice())}.o"
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 255
    path.write_bytes(
        {"empty": b"", "cut off": whole[:-1], "flipped": bytes(flipped), "garbage": bytes(range(256)) * 9}[damage]
    )  # fmt: skip
    forget(monkeypatch)
    count = len(generated)
    assert evaluate(twice(), tmp_path) == 6.0
    assert len(generated) == count + 1
    assert path.read_bytes() == whole
    forget(monkeypatch)
    assert evaluate(twice(), tmp_path) == 6.0
    assert len(generated) == count + 1


def test_a_full_disk_keeps_code_in_memory(fresh, monkeypatch, tmp_path):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    assert evaluate(twice(), tmp_path) == 6.0
    assert list((tmp_path / "lib").iterdir()) == []


USE = """
import sys
from pathlib import Path
from tests.kernels.test_machine_code import evaluate, twice
print([evaluate(twice(factor=2.0 + k), Path(sys.argv[1])) for k in range(20)])
"""


@pytest.mark.slow
def test_processes_at_once_share_a_cache(tmp_path):
    command = [sys.executable, "-c", USE, str(tmp_path)]
    folder = Path(__file__).parents[2]
    processes = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder)
        for _ in range(2)
    ]
    expected = f"{[3.0 * (2 + k) for k in range(20)]}\n"
    assert [process.communicate()[0] for process in processes] == [expected] * 2
    assert len(list((tmp_path / "lib").iterdir())) == 21  # and the caller of kernels


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_uses_and_generates_kernels(fresh, tmp_path):
    kernel = CompiledKernel(twice(), tmp_path)
    child = os.fork()
    if child == 0:
        right = kernel(np.ones((1, 1)))[0].item() == 2.0
        os._exit(0 if right and evaluate(twice(factor=7.0), tmp_path) == 21.0 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_ir_that_llvm_refuses_is_a_machine_error():
    with is_refused(MachineError):
        generate("define nonsense", FINAL)


def test_all_operations_are_used_in_all_positions():
    names = {name for name in CODES if name not in {"CONST", "INPUT", "OUTPUT"}}
    codes = set(tape_from_function(all_positions()).operation.tolist())
    assert {CODES[name] for name in names} <= codes
