"""Tapes and the three backends that run them, against each other, NumPy and plain Python."""

import itertools
import math
import subprocess
import sys
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from cnpgen.errors import MachineError, UsageError
from cnpgen.kernels import compiled_kernel
from cnpgen.kernels import library as library_module
from cnpgen.kernels.compiled_kernel import CompiledKernel
from cnpgen.kernels.interpreted_kernel import (
    POINTS_PER_BLOCK,
    InterpretedKernel,
)
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary, choose_backend
from cnpgen.kernels.tape import CODES, NAMES, Loop, Tape, tape_from_function
from tests.conftest import Prepare, needs_compiled_code, some
from tests.examples.casadi_kernels import MappedKernel
from tests.refusals import is_refused

Array = np.ndarray

UNARY: dict[str, Callable[[ca.SX], ca.SX]] = {
    "NEG": lambda x: -x,
    "SQ": lambda x: x * x,
    "TWICE": lambda x: x + x,
    "INV": lambda x: 1 / x,
    "SQRT": ca.sqrt,
    "FABS": ca.fabs,
    "SIGN": ca.sign,
    "NOT": ca.logic_not,
    "EXP": ca.exp,
    "SIN": ca.sin,
    "COS": ca.cos,
}
BINARY: dict[str, Callable[[ca.SX, ca.SX], ca.SX]] = {
    "ADD": lambda a, b: a + b,
    "SUB": lambda a, b: a - b,
    "MUL": lambda a, b: a * b,
    "DIV": lambda a, b: a / b,
    "FMIN": ca.fmin,
    "FMAX": ca.fmax,
    "LT": lambda a, b: a < b,
    "LE": lambda a, b: a <= b,
    "EQ": lambda a, b: a == b,
    "NE": lambda a, b: a != b,
    "AND": ca.logic_and,
    "OR": ca.logic_or,
    "IF_ELSE_ZERO": lambda a, b: ca.if_else(a, b, 0),
}
# The operations according to IEEE 754 and C: fmin and fmax ignore a nan, a nan is true.
REFERENCE: dict[str, Callable[..., Array]] = {
    "NEG": np.negative, "SQ": np.square, "TWICE": lambda x: 2 * x, "INV": np.reciprocal, "SQRT": np.sqrt,
    "FABS": np.abs, "SIGN": np.sign, "NOT": lambda x: 1.0 * (x == 0), "EXP": np.exp, "SIN": np.sin, "COS": np.cos,
    "ADD": np.add, "SUB": np.subtract, "MUL": np.multiply, "DIV": np.divide, "FMIN": np.fmin, "FMAX": np.fmax,
    "LT": lambda a, b: 1.0 * (a < b), "LE": lambda a, b: 1.0 * (a <= b), "EQ": lambda a, b: 1.0 * (a == b),
    "NE": lambda a, b: 1.0 * (a != b), "AND": lambda a, b: 1.0 * ((a != 0) & (b != 0)),
    "OR": lambda a, b: 1.0 * ((a != 0) | (b != 0)), "IF_ELSE_ZERO": lambda a, b: np.where(a != 0, b, 0.0),
}  # fmt: skip
SPECIAL = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    2.5,
    -2.5,
    math.inf,
    -math.inf,
    math.nan,
    1e-3,
    -7.25,
    9e4,
    1e-310,
    5e-324,
]
BACKENDS = ["compiled", "numpy", "casadi"]


def ulps(found: Array, expected: Array) -> Array:
    """Return the distance in units in the last place of ``expected``; 0 for two nans or two equal infinities."""
    with np.errstate(invalid="ignore"):
        same = (found == expected) | (np.isnan(found) & np.isnan(expected))
        return np.where(
            same, 0.0, np.abs(found - expected) / np.spacing(np.abs(expected))
        )


def kernel_of(
    function: ca.Function, backend: str, folder: Path, loop: Loop | None = None
) -> Kernel:
    tape = tape_from_function(function, loop)
    if backend == "casadi":
        return MappedKernel(tape, function)
    return (
        InterpretedKernel(tape) if backend == "numpy" else CompiledKernel(tape, folder)
    )


@pytest.fixture(scope="module")
def operations() -> ca.Function:
    """Build a function with every operation of a tape, applied to the same two numbers."""
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    return ca.Function(
        "operations",
        [a, b],
        [f(a) for f in UNARY.values()] + [f(a, b) for f in BINARY.values()],
    )


@pytest.fixture(scope="module")
def operands() -> Array:
    random = np.random.default_rng(0)
    special = np.array(list(itertools.product(SPECIAL, SPECIAL))).T
    numbers = random.normal(size=(2, 2000)) * 10.0 ** random.uniform(-3, 4, (2, 2000))
    ties = np.repeat(random.normal(size=(1, 50)), 2, axis=0)
    return np.concatenate([special, numbers, ties, -ties], axis=1)


@pytest.fixture(scope="module")
def evaluated(
    operations: ca.Function, operands: Array, cache_folder: Path
) -> dict[str, dict[str, Array]]:
    """Backend -> operation -> results."""
    backends = ["numpy", "casadi", "compiled"]
    kernels = {
        backend: kernel_of(operations, backend, cache_folder) for backend in backends
    }
    names = [*UNARY, *BINARY]
    return {
        backend: dict(
            zip(
                names,
                [row[0] for row in kernel(operands[:1], operands[1:])],
                strict=True,
            )
        )
        for backend, kernel in kernels.items()
    }


def test_all_operations_of_a_tape_are_tested(operations):
    used = {NAMES[code] for code in tape_from_function(operations).operation}
    assert used | {"CONST"} == set(NAMES)
    assert REFERENCE.keys() == UNARY.keys() | BINARY.keys()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_operations_follow_ieee_754_on_random_and_special_numbers(
    evaluated, operands, backend, name
):
    with np.errstate(all="ignore"):
        expected = REFERENCE[name](*operands[: 1 if name in UNARY else 2])
    allowed = 2.0 if name in ("SIN", "COS", "EXP") else 0.0
    wrong = np.flatnonzero(ulps(evaluated[backend][name], expected) > allowed)
    assert len(wrong) == 0, [
        (*operands[:, k], evaluated[backend][name][k], expected[k]) for k in wrong[:5]
    ]


@pytest.mark.parametrize("backend", BACKENDS)
def test_sine_and_cosine_are_within_2_ulp_up_to_1e5_also_next_to_their_zeros(
    cache_folder, backend
):
    random = np.random.default_rng(1)
    turns = np.arange(-70_000, 70_000, 7) * (np.pi / 2)
    neighbors = np.concatenate(
        [np.nextafter(turns, side) for side in (-np.inf, np.inf)]
    )
    angles = np.concatenate(
        [
            random.uniform(-10, 10, 20_000),
            random.uniform(-1e5, 1e5, 20_000),
            turns,
            neighbors,
            1e5 - np.arange(100.0),
        ]
    )
    x = ca.SX.sym("x")
    kernel = kernel_of(
        ca.Function("sincos", [x], [ca.sin(x), ca.cos(x)]), backend, cache_folder
    )
    sine, cosine = kernel(angles[None])
    assert ulps(sine[0], np.sin(angles)).max() <= 2
    assert ulps(cosine[0], np.cos(angles)).max() <= 2


@pytest.fixture(scope="module")
def mixed() -> ca.Function:
    """Build a function with two arguments and two results, constants among them."""
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
    first = ca.vertcat(
        ca.sin(x[0]) * p[1], x[1] / (1 + p[0] ** 2), 2.5, ca.fmax(x[2], p[0])
    )
    return ca.Function(
        "mixed",
        [x, p],
        [first, ca.if_else(x[0] < p[0], x[1] - x[2], ca.sqrt(x[0] ** 2))],
    )


def mixed_in_numpy(x: Array, p: Array) -> list[Array]:
    first = [
        np.sin(x[0]) * p[1],
        x[1] / (1 + p[0] ** 2),
        np.full(x.shape[1], 2.5),
        np.maximum(x[2], p[0]),
    ]
    return [np.array(first), np.where(x[0] < p[0], x[1] - x[2], np.abs(x[0]))[None]]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("n", [0, 1, 2, 3, 5, 7, 8, 9, POINTS_PER_BLOCK + 1])
def test_batches_of_any_size_are_evaluated_lane_by_lane(
    mixed, cache_folder, backend, n
):
    kernel = kernel_of(mixed, backend, cache_folder)
    random = np.random.default_rng(n)
    x, p = random.normal(size=(3, n)), random.normal(size=(2, n))
    found, expected = kernel(x, p), mixed_in_numpy(x, p)
    for result, meant in zip(found, expected, strict=True):
        assert result.shape == meant.shape
        np.testing.assert_allclose(result, meant, rtol=1e-15)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_bits_of_a_lane_do_not_depend_on_its_batch(mixed, cache_folder, backend):
    kernel = kernel_of(mixed, backend, cache_folder)
    random = np.random.default_rng(2)
    x, p = random.normal(size=(3, 29)), random.normal(size=(2, 29))
    whole = kernel(x, p)
    for first, n in [(0, 1), (3, 2), (28, 1), (5, 7), (9, 17)]:
        part = kernel(x[:, first : first + n].copy(), p[:, first : first + n].copy())
        for one, other in zip(part, whole, strict=True):
            np.testing.assert_array_equal(one, other[:, first : first + n])


@pytest.mark.parametrize("backend", BACKENDS)
def test_rows_of_arguments_may_have_any_stride(mixed, cache_folder, backend):
    kernel = kernel_of(mixed, backend, cache_folder)
    store = np.random.default_rng(3).normal(size=(12, 60))
    every_other, backwards = store[1:7:2, 11:30], store[5:3:-1, 2:21]
    one_row = np.broadcast_to(store[7, :19], (2, 19))
    for x, p in [(every_other, backwards), (every_other, one_row)]:
        for result, meant in zip(kernel(x, p), mixed_in_numpy(x, p), strict=True):
            np.testing.assert_allclose(result, meant, rtol=1e-15)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param((np.zeros((3, 4)),), id="one missing"),
        pytest.param((np.zeros((2, 4)), np.zeros((2, 4))), id="wrong width"),
        pytest.param(
            (np.zeros((3, 4)), np.zeros((2, 5))), id="different numbers of lanes"
        ),
        pytest.param((np.zeros((3, 4), np.float32), np.zeros((2, 4))), id="float32"),
        pytest.param((np.zeros((3, 4), ">f8"), np.zeros((2, 4))), id="big endian"),
        pytest.param((np.zeros((4, 3)).T, np.zeros((2, 4))), id="rows not contiguous"),
        pytest.param((np.zeros(12), np.zeros((2, 4))), id="one dimension"),
    ],
)
def test_arguments_of_a_wrong_shape_or_type_are_refused(
    mixed, cache_folder, backend, arguments
):
    with is_refused(ValueError):
        kernel_of(mixed, backend, cache_folder)(*arguments)


def test_arguments_may_be_read_only_or_unaligned(mixed, cache_folder):
    whole = np.random.default_rng(3).normal(size=(5, 9))
    stored = np.frombuffer(b"\0" + whole.tobytes(), "f8", offset=1).reshape(5, 9)
    assert not stored.flags.aligned
    assert not stored.flags.writeable
    kernel = kernel_of(mixed, "compiled", cache_folder)
    for found, expected in zip(
        kernel(stored[:3], stored[3:]), kernel(whole[:3], whole[3:]), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_objects_other_than_arrays_are_refused_by_compiled_kernels(mixed, cache_folder):
    array = np.zeros((3, 4))
    alike = SimpleNamespace(
        shape=array.shape, dtype=array.dtype, strides=array.strides, size=array.size
    )
    with is_refused(ValueError):
        kernel_of(mixed, "compiled", cache_folder)(alike, np.zeros((2, 4)))


def test_threads_that_share_a_compiled_kernel_get_their_own_results(
    mixed, cache_folder
):
    kernel = kernel_of(mixed, "compiled", cache_folder)
    x, p = np.random.default_rng(9).normal(size=(2, 3, 400_000))
    expected = kernel(x, p[:2])
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: kernel(x, p[:2]), range(16)):
            np.testing.assert_array_equal(found[0], expected[0])


@pytest.mark.parametrize("backend", BACKENDS)
def test_arguments_are_not_changed(mixed, cache_folder, backend):
    x, p = np.random.default_rng(4).normal(size=(2, 3, 9))
    before = x.copy(), p[:2].copy()
    kernel_of(mixed, backend, cache_folder)(x, p[:2])
    np.testing.assert_array_equal(x, before[0])
    np.testing.assert_array_equal(p[:2], before[1])


# --- loops ------------------------------------------------------------------------------------------------------------

ROOT = Loop(tolerance=1e-3, limit=12)


@pytest.fixture(scope="module")
def root() -> ca.Function:
    """Build Heron's iteration for the square root of p; the second state counts the steps."""
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    error = ca.fabs(x[0] * x[0] - p)
    return ca.Function(
        "heron", [x, p], [ca.vertcat(0.5 * (x[0] + p / x[0]), x[1] + 1), error]
    )


def heron(x: float, p: float) -> tuple[float, float, float]:
    """Compute one lane in plain Python."""
    error, count = math.nan, 0
    while count < ROOT.limit:
        error = abs(x * x - p)
        x, count = 0.5 * (x + p / x), count + 1
        if error < ROOT.tolerance:
            break
    return x, float(count), error


def root_lanes(n: int) -> tuple[Array, Array]:
    random = np.random.default_rng(5)
    p = 10.0 ** random.uniform(-1, 4, n)
    p[2::11], p[5::11] = -1.0, math.nan  # these never converge
    x = random.uniform(0.5, 2.0, n) * np.sqrt(np.abs(np.nan_to_num(p, nan=1.0)))
    return np.stack([x, np.zeros(n)]), p[None]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_loop_iterates_each_lane_to_convergence_plus_one_step(
    root, cache_folder, backend
):
    x, p = root_lanes(100)
    state, error = kernel_of(root, backend, cache_folder, ROOT)(x, p)
    expected = np.array(
        [heron(*lane) for lane in zip(x[0].tolist(), p[0].tolist(), strict=True)]
    ).T
    np.testing.assert_array_equal(state[1], expected[1])
    assert len(set(expected[1])) > 3
    np.testing.assert_allclose(state[0], expected[0], rtol=1e-12)
    np.testing.assert_allclose(error[0], expected[2], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_lane_that_does_not_converge_stops_at_the_limit_with_its_error(
    root, cache_folder, backend
):
    state, error = kernel_of(root, backend, cache_folder, ROOT)(*root_lanes(30))
    lost = np.flatnonzero(~(error[0] < ROOT.tolerance))
    assert set(lost) == {k for k in range(30) if k % 11 in (2, 5)}
    np.testing.assert_array_equal(state[1, lost], ROOT.limit)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("n", [0, 1, 3, 8, 9, 61])
def test_lanes_of_a_loop_do_not_depend_on_their_neighbors(
    root, cache_folder, backend, n
):
    kernel = kernel_of(root, backend, cache_folder, ROOT)
    x, p = root_lanes(61)
    whole = kernel(x, p)
    order = np.random.default_rng(6).permutation(61)[:n]
    shuffled = kernel(x[:, order].copy(), p[:, order].copy())
    for one, other in zip(shuffled, whole, strict=True):
        np.testing.assert_array_equal(one, other[:, order])


@pytest.mark.parametrize(
    "backend", [pytest.param("compiled", marks=needs_compiled_code), "numpy"]
)
@pytest.mark.parametrize("kind", ["inverse kinematics", "hitting configuration"])
def test_solvers_give_the_same_bits_in_any_order_of_lanes(
    prepare: Prepare, backend, kind
):
    from cnpgen.pipelines.stages import hitting_newton, ik

    kernels, robot = (
        prepare("airhockey-replan", backend).context.kernels,
        prepare("airhockey-replan").context.robot,
    )
    random = np.random.default_rng(7)
    q = random.uniform(
        [-0.6, 0.5, -0.7, -0.7, -0.4, 0.4], [0.6, 1.4, 0.7, -0.4, 0.4, 1.9], (203, 6)
    ).T.copy()
    p = random.uniform([0.6, -0.45, 0.16], [1.3, 0.45, 0.16], (203, 3)).T.copy()
    angle = random.uniform(-np.pi, np.pi, 203)
    if kind == "inverse kinematics":
        kernel = kernels.load(
            ik.ik_step,
            Loop(ik.IK_TOLERANCE, ik.MAX_IK_STEPS),
            vertical=False,
            max_step=0.4,
        )
        arguments = [q, p]
    else:
        loop = Loop(
            hitting_newton.NEWTON_TOLERANCE_RAD, hitting_newton.MAX_NEWTON_STEPS
        )
        kernel = kernels.load(hitting_newton.newton_step, loop)
        arguments = [
            q,
            p,
            np.stack([np.cos(angle), np.sin(angle)]),
            np.repeat(robot.home[:, None], 203, axis=1),
        ]
    whole = kernel(*arguments)
    for order in (
        random.permutation(203),
        np.arange(202, -1, -1),
        random.permutation(203)[:77],
    ):
        again = kernel(*(np.ascontiguousarray(x[:, order]) for x in arguments))
        for one, other in zip(again, whole, strict=True):
            np.testing.assert_array_equal(one, other[:, order])


# --- tapes ------------------------------------------------------------------------------------------------------------


def test_tapes_are_restored_from_bytes(mixed, root):
    for tape in (tape_from_function(mixed), tape_from_function(root, ROOT)):
        again = Tape.from_bytes(tape.to_bytes())
        assert (again.name, again.inputs, again.outputs, again.loop) == (
            tape.name,
            tape.inputs,
            tape.outputs,
            tape.loop,
        )
        for name in ("operation", "a", "b", "constant"):
            np.testing.assert_array_equal(getattr(again, name), getattr(tape, name))
            assert getattr(again, name).dtype == getattr(tape, name).dtype
        assert again.to_bytes() == tape.to_bytes()
        assert len(again) == len(tape.operation)


def test_a_function_that_is_built_twice_gives_the_same_bytes(prepare):
    from cnpgen.pipelines.stages.ik import ik_step

    robot = prepare("heavy-object").context.robot
    first, second = (
        tape_from_function(ik_step(robot, vertical=True, max_step=0.8)).to_bytes()
        for _ in range(2)
    )
    assert first == second


def test_a_tape_with_any_damaged_byte_raises(root):
    data = tape_from_function(root, ROOT).to_bytes()
    for position in range(0, len(data), 37):
        flipped = bytearray(data)
        flipped[position] ^= 0x10
        with pytest.raises(ValueError, match="damaged"):
            Tape.from_bytes(bytes(flipped))
        with pytest.raises(ValueError, match="damaged"):
            Tape.from_bytes(data[:position])
    with pytest.raises(ValueError, match="damaged"):
        Tape.from_bytes(data + b"\0")


def test_unsupported_operations_are_refused():
    x = ca.SX.sym("x")
    with is_refused(ValueError):
        tape_from_function(ca.Function("tangent", [x], [ca.tan(x)]))


def test_sparse_arguments_and_results_are_refused():
    x = ca.SX.sym("x", ca.Sparsity.lower(2))
    with is_refused(ValueError):
        tape_from_function(ca.Function("lower", [x], [x[0, 0]]))
    y = ca.SX.sym("y", 2)
    with is_refused(ValueError):
        tape_from_function(ca.Function("diagonal", [y], [ca.diag(y)]))


@pytest.mark.parametrize("backend", BACKENDS)
def test_constants_may_be_infinite_or_nan(cache_folder, backend):
    x = ca.SX.sym("x")
    constants = [math.inf, -math.inf, math.nan, 0.1, -1e300, 5e-324]
    kernel = kernel_of(
        ca.Function("constants", [x], [ca.vertcat(*constants), x]),
        backend,
        cache_folder,
    )
    found, _ = kernel(np.zeros((1, 5)))
    np.testing.assert_array_equal(
        found, np.repeat(np.array(constants)[:, None], 5, axis=1)
    )


def machine_flags() -> set[str]:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    return set(next((line for line in lines if line.startswith("flags")), "").split())


# --- cache ------------------------------------------------------------------------------------------------------------

BUILT: list[str] = []


def doubling(*, factor: float = 2.0) -> ca.Function:
    """Build a function and record the call."""
    BUILT.append("doubling")
    x = ca.SX.sym("x")
    return ca.Function("doubling", [x], [factor * x])


def library_in(
    folder: Path, backend: str = "compiled", identity: str = "problem"
) -> KernelLibrary:
    return KernelLibrary(backend, folder, identity)  # type: ignore[arg-type]


def test_a_tape_is_built_once_per_builder_loop_parameters_and_problem(tmp_path):
    BUILT.clear()
    for _ in range(3):
        library_in(tmp_path, "numpy").load(doubling)
    assert len(BUILT) == 1
    library_in(tmp_path, "numpy").load(doubling, factor=3.0)
    library_in(tmp_path, "numpy").load(doubling, Loop(1e-3, 4))
    library_in(tmp_path, "numpy", identity="another problem").load(doubling)
    assert len(BUILT) == 4


def test_any_change_in_the_package_of_a_plug_in_changes_its_kernels(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "__init__.py").write_text("")
    (tmp_path / "mine" / "kernels.py").write_text(
        "import casadi as ca\nfrom mine.helper import FACTOR\n"
        "def scaled():\n    x = ca.SX.sym('x')\n    return ca.Function('scaled', [x], [FACTOR * x])\n"
    )
    use = (
        "from pathlib import Path; import numpy as np; from mine.kernels import scaled;"
        "from cnpgen.kernels.library import KernelLibrary;"
        "print(KernelLibrary('numpy', Path('cache'), 'problem').load(scaled)(np.ones((1, 1)))[0].item())"
    )
    for factor in ("2.0", "3.0"):
        (tmp_path / "mine" / "helper.py").write_text(f"FACTOR = {factor}")
        command = [sys.executable, "-B", "-c", use]
        done = subprocess.run(
            command, capture_output=True, text=True, check=True, cwd=tmp_path
        )
        assert done.stdout.strip() == factor


def test_a_changed_limit_of_a_problem_changes_its_kernels(prepare: Prepare):
    pipeline = prepare("airhockey-hit").pipeline
    problem = pipeline.problem
    slower = replace(problem, limits=replace(problem.limits, velocity_scale=0.1))
    block = prepare(replace(pipeline, problem=slower), "numpy").block(
        1, "train", 0, stop=50
    )
    limit = prepare("airhockey-hit").context.robot.rated_velocity * 0.1
    assert np.all(np.abs(block.columns["goal_dq"]) <= limit[:, None] * (1 + 1e-12))


@pytest.mark.parametrize("damage", ["cut off", "empty", "flipped"])
def test_a_damaged_cached_tape_is_built_again(tmp_path, damage):
    library_in(tmp_path, "numpy").load(doubling)
    (path,) = (tmp_path / "tape").iterdir()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(
        {"cut off": data[: len(data) // 2], "empty": b"", "flipped": data}[damage]
    )
    BUILT.clear()
    (result,) = library_in(tmp_path, "numpy").load(doubling)(np.ones((1, 3)))
    np.testing.assert_array_equal(result, 2.0)
    assert len(BUILT) == 1
    library_in(tmp_path, "numpy").load(doubling)
    assert len(BUILT) == 1


def repository() -> Path:
    return Path(__file__).parents[2]


WARM_START = """
import sys
from cnpgen.kernels.library import choose_backend
from cnpgen.pipelines.pipeline import load_pipeline

from cnpgen.pipelines.prepared import PreparedPipeline
backend, folder = choose_backend(sys.argv[1])
for name in ("airhockey-hit", "airhockey-replan", "heavy-object"):
    PreparedPipeline(load_pipeline(name), backend=backend, cache_folder=folder).block(0, "train", 0, stop=9)
print("casadi" in sys.modules)
"""


@pytest.mark.parametrize(
    "backend",
    some(["compiled", "numpy"], 1, "slow"),
)
def test_a_warm_start_does_not_import_casadi(prepare: Prepare, backend):
    for name in ("airhockey-hit", "airhockey-replan", "heavy-object"):
        prepare(name, backend)
    command = [sys.executable, "-c", WARM_START, backend]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, cwd=repository()
    )
    assert done.stdout == "False\n"


def test_kernels_of_a_pipeline_restored_from_a_plan_are_those_of_its_files(
    prepare: Prepare, tmp_path, monkeypatch
):
    from cnpgen.make.recipe import load_dataset_recipe, restore_dataset_recipe
    from cnpgen.problems.problem import resolved

    recipe = load_dataset_recipe("airhockey-hit")
    prepare("airhockey-hit")
    restored = restore_dataset_recipe(
        resolved(recipe), recipe.pipeline.problem.urdf_path.read_text(), tmp_path
    )
    monkeypatch.setattr(
        library_module, "tape_from_function", lambda *_: pytest.fail("built again")
    )
    prepare(restored.pipeline)


# --- choosing a backend -----------------------------------------------------------------------------------------------


@pytest.fixture
def own_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fresh_compiler: None
) -> Path:
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def chosen_with_warnings(wanted: str | None = None) -> tuple[str, Path, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        backend, folder = choose_backend(wanted)
    assert all(warning.category is RuntimeWarning for warning in caught)
    return backend, folder, [str(warning.message) for warning in caught]


def test_the_compiled_backend_is_chosen_without_a_warning(own_cache):
    assert chosen_with_warnings() == ("compiled", own_cache, [])
    assert chosen_with_warnings("compiled") == ("compiled", own_cache, [])


@pytest.fixture
def broken_llvm(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise MachineError("LLVM cannot be loaded (no such library)")

    monkeypatch.setattr(compiled_kernel, "find_final", fail)


def test_without_llvm_numpy_runs_after_one_warning(own_cache, broken_llvm):
    backend, _, (text,) = chosen_with_warnings()
    assert backend == "numpy"
    assert "LLVM cannot be loaded" in text
    assert "running on the NumPy backend" in text


def test_without_llvm_the_compiled_backend_is_a_machine_error(own_cache, broken_llvm):
    with is_refused(MachineError):
        choose_backend("compiled")


def test_a_generator_of_wrong_code_is_detected(own_cache, monkeypatch):
    monkeypatch.setattr(
        library_module, "CompiledKernel", lambda _tape, _folder: lambda x: [x]
    )
    with is_refused(MachineError):
        choose_backend("compiled")


def test_a_tape_that_cannot_be_cached_is_still_used(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    (result,) = library_in(tmp_path / "file", "numpy").load(doubling)(np.ones((1, 3)))
    np.testing.assert_array_equal(result, 2.0)


def test_a_full_disk_leaves_no_partial_tape(tmp_path, monkeypatch):
    def full(*_arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    (result,) = library_in(tmp_path, "numpy").load(doubling)(np.ones((1, 3)))
    np.testing.assert_array_equal(result, 2.0)
    assert list((tmp_path / "tape").iterdir()) == []


def test_a_cached_tape_has_the_read_permissions_of_the_umask(tmp_path):
    """Check a cache that a group shares: stored files do not have the private mode of temporary files."""
    library_in(tmp_path, "numpy").load(doubling)
    (path,) = (tmp_path / "tape").iterdir()
    (tmp_path / "plain").touch()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_unknown_backends_are_refused(own_cache):
    with is_refused(UsageError, argument="backend"):
        choose_backend("cuda")


@pytest.mark.parametrize("wanted", ["compiled", "numpy"])
def test_backends_need_no_compiler(own_cache, monkeypatch, wanted):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    assert chosen_with_warnings(wanted) == (wanted, own_cache, [])


def test_the_selftest_tape_equals_that_of_casadi():
    x = ca.SX.sym("x")
    tape = tape_from_function(ca.Function("twice", [x], [x + x]))
    assert tape.operation.tolist() == [CODES["INPUT"], CODES["TWICE"], CODES["OUTPUT"]]
