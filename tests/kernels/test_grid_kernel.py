"""Kernels on grids of nodes and lanes, in float64 and float32, against NumPy's broadcasting and IEEE 754."""

import itertools
import math
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from cnpgen.kernels.compiled_kernel import CompiledGridKernel
from cnpgen.kernels.interpreted_kernel import (
    POINTS_PER_BLOCK,
    InterpretedGridKernel,
)
from cnpgen.kernels.kernel import GridKernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.lowering import lower
from cnpgen.kernels.tape import Axes, GridSpec, Loop, Tape, tape_from_function
from tests.conftest import needs_compiled_code
from tests.examples.casadi_kernels import MappedGridKernel
from tests.kernels.test_kernels import BINARY, REFERENCE, SPECIAL, UNARY
from tests.refusals import is_refused

Array = np.ndarray
BACKENDS = ["compiled", "numpy", "casadi"]
DTYPES = ["float64", "float32"]
AXES: tuple[Axes, ...] = ("point", "lane", "node", "fixed")
GRID = GridSpec(AXES, ("point", "lane"))


def kernel_of(
    function: ca.Function, grid: GridSpec, *, backend: str, dtype: str, folder: Path
) -> GridKernel:
    tape = tape_from_function(function, grid=grid, dtype=dtype)  # type: ignore[arg-type]
    if backend == "casadi":
        return MappedGridKernel(tape, function)
    return (
        InterpretedGridKernel(tape)
        if backend == "numpy"
        else CompiledGridKernel(tape, folder)
    )


@pytest.fixture(scope="module")
def mixed() -> ca.Function:
    """Build a function with arguments of every kind and a constant among the results."""
    point, lane, node, fixed = (ca.SX.sym(name, 2) for name in "abcd")
    first = ca.vertcat(
        ca.sin(point[0]) * lane[1] + node[0], ca.fmax(point[1], fixed[0]), 2.5
    )
    return ca.Function(
        "mixed",
        [point, lane, node, fixed],
        [first, node[1] * point[0] * fixed[1] - lane[0]],
    )


def arguments_of(nodes: int, lanes: int, dtype: str) -> list[Array]:
    random = np.random.default_rng(nodes + 7 * lanes)
    shapes = [(2, nodes, lanes), (2, lanes), (2, nodes), (2,)]
    return [random.normal(size=shape).astype(dtype) for shape in shapes]


def mixed_in_numpy(
    point: Array, lane: Array, node: Array, fixed: Array
) -> tuple[Array, Array]:
    first = np.sin(point[0]) * lane[1] + node[0][:, None]
    second = np.maximum(point[1], fixed[0])
    summed = (node[1][:, None] * point[0] * fixed[1] - lane[0]).sum(axis=0)
    return np.stack([first, second, np.full_like(first, 2.5)]), summed[None]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("nodes", "lanes"),
    [
        (1, 1),
        (3, 0),
        (0, 5),
        (2, 3),
        (5, 16),
        (7, 17),
        (4, 33),
        (3, POINTS_PER_BLOCK // 2),
        (2, POINTS_PER_BLOCK + 3),
    ],
)
def test_grids_of_any_size_are_evaluated_point_by_point_and_summed_over_nodes(
    mixed, cache_folder, backend, dtype, nodes, lanes
):
    kernel = kernel_of(mixed, GRID, backend=backend, dtype=dtype, folder=cache_folder)
    arguments = arguments_of(nodes, lanes, dtype)
    out = [np.full((3, nodes, lanes), np.nan, dtype), np.full((1, lanes), 10.0, dtype)]
    kernel(*arguments, out=out)
    points, sums = mixed_in_numpy(*arguments)
    tolerance = 1e-14 if dtype == "float64" else 1e-5
    np.testing.assert_allclose(out[0], points, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(out[1], 10 + sums, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_components_and_nodes_may_have_any_stride_and_arguments_are_not_changed(
    mixed, cache_folder, backend, dtype
):
    kernel = kernel_of(mixed, GRID, backend=backend, dtype=dtype, folder=cache_folder)
    store = np.random.default_rng(0).normal(size=(9, 6, 4, 40)).astype(dtype)
    point = store[::4, 5:0:-2, 1, 3:22][:2]  # (2, 3, 19): nodes backwards
    lane, node, fixed = (
        store[3, 2:4, 0, 5:24],
        store[2:4, 1:4, 2, 7],
        store[5, :6:3, 3, 9],
    )
    before = store.copy()
    results = np.zeros((4, 7, 25), dtype)
    out = [results[:3, 6:0:-2, 4:23], np.zeros((1, 19), dtype)]
    kernel(point, lane, node, fixed, out=out)
    np.testing.assert_array_equal(store, before)
    for found, expected in zip(
        out, mixed_in_numpy(point, lane, node, fixed), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert (results[3] == 0).all()
    assert (results[:, ::2, :4] == 0).all()


ARRAYS = (
    "argument 0",
    "argument 1",
    "argument 2",
    "argument 3",
    "result 0",
    "result 1",
)
MISFITS = [(what, how) for what in ARRAYS for how in ("type", "shape", "rows")]
MISFITS = [
    pair
    for pair in MISFITS
    if pair not in {("argument 2", "rows"), ("argument 3", "rows")}
]  # without lanes


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("what", "how"), MISFITS)
def test_arguments_and_results_of_a_wrong_shape_or_type_are_refused(
    mixed, cache_folder, backend, what, how
):
    kernel = kernel_of(
        mixed, GRID, backend=backend, dtype="float32", folder=cache_folder
    )
    arrays = [
        *arguments_of(3, 5, "float32"),
        np.zeros((3, 3, 5), np.float32),
        np.zeros((1, 5), np.float32),
    ]
    index = int(what[-1]) + (4 if what.startswith("result") else 0)
    change = {
        "type": lambda x: x.astype(np.float64),
        "shape": lambda x: np.concatenate([x, x]),
        "rows": lambda x: np.repeat(x, 2, axis=-1)[..., ::2],
    }
    arrays[index] = change[how](arrays[index])
    with is_refused(ValueError):
        kernel(*arrays[:4], out=arrays[4:])


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_missing_argument_is_refused(mixed, cache_folder, backend):
    kernel = kernel_of(
        mixed, GRID, backend=backend, dtype="float64", folder=cache_folder
    )
    with is_refused(ValueError):
        kernel(*arguments_of(2, 2, "float64")[:3], out=[np.zeros((3, 2, 2))])


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (
            GridSpec(("point",), ("point", "lane")),
            "must name 4 arguments and 2 results, got 1 and 2",
        ),
        (
            GridSpec(AXES, ("point", "node")),
            "results of a grid are per point or per lane",
        ),
    ],
)
def test_a_grid_that_does_not_match_the_function_is_refused(mixed, grid, message):
    with pytest.raises(ValueError, match=message):
        tape_from_function(mixed, grid=grid)


def test_a_tape_without_a_grid_makes_no_grid_kernel(mixed):
    with is_refused(ValueError):
        InterpretedGridKernel(tape_from_function(mixed))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("how", [{"grid": GRID}, {"loop": Loop(1e-3, 5)}, {}])
def test_tapes_are_restored_from_bytes_with_their_grid_and_type(mixed, dtype, how):
    tape = tape_from_function(mixed, dtype=dtype, **how)
    again = Tape.from_bytes(tape.to_bytes())
    assert (again.grid, again.loop, again.dtype) == (tape.grid, tape.loop, dtype)
    assert again.to_bytes() == tape.to_bytes()
    others = {
        tape_from_function(mixed).to_bytes(),
        tape_from_function(mixed, grid=GRID).to_bytes(),
    }
    assert (
        len({*others, tape_from_function(mixed, grid=GRID, dtype="float32").to_bytes()})
        == 3
    )


def summing(*, factor: float) -> ca.Function:
    """Build a function for the library."""
    x = ca.SX.sym("x")
    return ca.Function("summing", [x], [factor * x])


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_library_loads_grid_kernels_for_every_type(tmp_path, backend):
    library = KernelLibrary(backend, tmp_path, "problem")
    for dtype, factor in itertools.product(DTYPES, [2.0, 3.0]):
        kernel = library.load_grid(
            summing, GridSpec(("point",), ("lane",)), dtype=dtype, factor=factor
        )
        out = np.zeros((1, 4), dtype)
        kernel(np.ones((1, 5, 4), dtype), out=[out])
        assert (out == 5 * factor).all()


# --- numbers ----------------------------------------------------------------------------------------------------------


def ulps(found: Array, expected: Array) -> Array:
    """Return the distance in units in the last place of ``found`` from the more precise ``expected``."""
    with np.errstate(all="ignore"):
        rounded = expected.astype(found.dtype)
        same = (found == rounded) | (np.isnan(found) & np.isnan(rounded))
        return np.where(
            same, 0.0, np.abs(found - expected) / np.spacing(np.abs(rounded))
        )


@pytest.mark.parametrize(
    "backend", [pytest.param("compiled", marks=needs_compiled_code), "numpy"]
)
@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_operations_in_float32_follow_ieee_754(
    single_operations, single_operands, backend, name
):
    a, b = single_operands
    kernel = single_operations[backend]
    out = [np.zeros((1, 1, len(a)), np.float32) for _ in kernel.tape.outputs]
    kernel(a[None, None], b[None, None], out=out)
    found = out[[*UNARY, *BINARY].index(name)][0, 0]
    with np.errstate(all="ignore"):
        expected = REFERENCE[name](*([a] if name in UNARY else [a, b]))
        exact = (
            REFERENCE[name](a.astype(float))
            if name in ("SIN", "COS", "EXP")
            else expected
        )
    usable = np.abs(a) <= 256 if name in ("SIN", "COS") else np.full(len(a), True)
    allowed = (
        0.0 if exact is expected else 2.0 if backend == "compiled" else 4.0
    )  # NumPy's error
    wrong = np.flatnonzero((ulps(found, exact) > allowed) & usable)
    assert len(wrong) == 0, [(a[k], b[k], found[k], expected[k]) for k in wrong[:5]]


@pytest.fixture(scope="module")
def single_operations(cache_folder: Path) -> dict[str, GridKernel]:
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    function = ca.Function(
        "singles",
        [a, b],
        [f(a) for f in UNARY.values()] + [f(a, b) for f in BINARY.values()],
    )
    grid = GridSpec(("point", "point"), ("point",) * function.n_out())
    return {
        backend: kernel_of(
            function, grid, backend=backend, dtype="float32", folder=cache_folder
        )
        for backend in ["numpy", "compiled"]
    }


@pytest.fixture(scope="module")
def single_operands() -> Array:
    random = np.random.default_rng(0)
    special = np.array(list(itertools.product([*SPECIAL, 1e-40, 3e38], repeat=2))).T
    numbers = random.normal(size=(2, 2000)) * 10.0 ** random.uniform(-3, 4, (2, 2000))
    with np.errstate(all="ignore"):
        return np.concatenate([special, numbers], axis=1).astype(np.float32)


def near_zeros(limit: float, dtype: str) -> Array:
    """Return numbers up to a limit, and the ones next to multiples of pi/2."""
    random = np.random.default_rng(1)
    turns = (np.arange(-int(limit / 1.6), int(limit / 1.6)) * (np.pi / 2)).astype(dtype)
    sides = [np.nextafter(turns, np.array(side, dtype)) for side in (-np.inf, np.inf)]
    return np.concatenate(
        [random.uniform(-limit, limit, 40_000).astype(dtype), turns, *sides]
    )


def unary(name: str, dtype: str, folder: Path, x: Array) -> list[Array]:
    """Evaluate sine and cosine, or the exponential, compiled."""
    symbol = ca.SX.sym("x")
    results = [ca.exp(symbol)] if name == "exp" else [ca.sin(symbol), ca.cos(symbol)]
    grid = GridSpec(("point",), ("point",) * len(results))
    kernel = kernel_of(
        ca.Function(name, [symbol], results),
        grid,
        backend="compiled",
        dtype=dtype,
        folder=folder,
    )
    out = [np.zeros((1, 1, len(x)), dtype) for _ in results]
    kernel(x[None, None], out=out)
    return [result[0, 0] for result in out]


@pytest.mark.parametrize(
    ("limit", "allowed"), [(10.0, 2.0), (256.0, 2.0), (8192.0, 3.0)]
)
def test_sine_and_cosine_in_float32_are_within_ulps_also_next_to_their_zeros(
    cache_folder, limit, allowed
):
    x = near_zeros(limit, "float32")
    for found, exact in zip(
        unary("trig", "float32", cache_folder, x), (np.sin, np.cos), strict=True
    ):
        assert ulps(found, exact(x.astype(float))).max() <= allowed


@pytest.mark.parametrize(
    ("dtype", "overflow", "underflow"),
    [("float64", 709.78, -745.13), ("float32", 88.72, -103.97)],
)
def test_the_exponential_is_within_2_ulp_from_zero_to_infinity(
    cache_folder, dtype, overflow, underflow
):
    random = np.random.default_rng(2)
    edges = np.array([overflow, underflow])[:, None] + np.linspace(-1, 1, 2001)
    ends = [0.0, -0.0, math.inf, -math.inf, 1e30, -1e30, 1e-30, -1e-30]
    with np.errstate(all="ignore"):
        x = np.concatenate(
            [random.uniform(underflow, overflow, 60_000), edges.ravel(), ends]
        ).astype(dtype)
        exact = np.exp(x.astype(np.longdouble))
    (found,) = unary("exp", dtype, cache_folder, x)
    assert ulps(found, exact).max() <= 2
    assert np.isnan(
        unary("exp", dtype, cache_folder, np.full(3, np.nan, dtype))[0]
    ).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_minima_and_maxima_with_a_constant_ignore_a_nan(cache_folder, dtype):
    x, bound = ca.SX.sym("x"), ca.SX.sym("bound")
    clipped = ca.fmin(ca.fmax(x, bound), 2.0)
    function = ca.Function("clipped", [x, bound], [clipped, ca.fmax(x, -x)])
    grid = GridSpec(("point", "fixed"), ("point", "point"))
    tape = tape_from_function(function, grid=grid, dtype=dtype)
    operations = [step.operation for step in lower(tape)]
    assert operations.count("lesser") == operations.count("larger") == 1
    kernel = CompiledGridKernel(tape, cache_folder)
    values = np.array(
        [math.nan, -math.inf, math.inf, 0.0, -0.5, 1.0, 2.5, math.nan, 3.0], dtype
    )
    out = [np.zeros((1, 1, len(values)), dtype) for _ in range(2)]
    kernel(values[None, None], np.array([0.25], dtype), out=out)
    np.testing.assert_array_equal(
        out[0][0, 0], [0.25, 0.25, 2.0, 0.25, 0.25, 1.0, 2.0, 0.25, 2.0]
    )
    np.testing.assert_array_equal(out[1][0, 0], np.fmax(values, -values))
