"""Evaluations of a motion and subproblems of its steps in compiled code: ``step.c`` and ``active_set.c``."""

import ctypes
from collections.abc import Sequence
from ctypes import c_double, c_int, c_long, c_void_p
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray, Array, Mask
from cnpgen.kernels.compiled_kernel import CACHE_LINE_DOUBLES, address_of, aligned_array
from cnpgen.kernels.library import KernelLibrary
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.grid import Bases
from cnpgen.refine.solver.qp_subproblem import (
    ELASTIC_CURVATURE_ROOT,
    ELASTIC_GRADIENT,
    MAX_SPEED_DISTANCE,
    MAX_WORKING_SET_CHANGES,
    MIN_MULTIPLIER,
    QP_TOLERANCE,
    THINNING,
    ResidualSelection,
    Step,
)
from cnpgen.refine.solver.transcription import Transcription
from cnpgen.trajectory.spline import end_derivatives

SOURCES = [Path(__file__).with_name(name) for name in ("active_set.c", "step.c")]
MAX_LANES, ROWS_PER_BLOCK, TILE_POINTS = 8, 32, 8  # upper bounds of W, B and TILE in C


class _Bases(ctypes.Structure):
    """``bases`` of step.c."""

    _fields_ = (
        *((name, c_long) for name in ("orders", "points")),
        *(
            (name, c_void_p)
            for name in ("path", "rate", "path_at", "rate_at", "path_from", "rate_from")
        ),
    )


class _Polyhedron(ctypes.Structure):
    """``polyhedron`` of active_set.c."""

    _fields_ = (
        *((name, c_long) for name in ("dim", "stride", "count")),
        *(
            (name, c_void_p)
            for name in (
                "rows",
                "low",
                "high",
                "norm",
                "scratch",
                "active",
                "leading_zeros",
            )
        ),
    )


class _Motion(ctypes.Structure):
    """``motion`` of step.c."""

    _fields_ = (
        *(
            (name, c_long)
            for name in ("n", "path", "rate", "support", "fixed", "nx", "stride", "m")
        ),
        *(
            (name, c_long)
            for name in (
                "n_time_nodes",
                "n_cost_residuals",
                "n_cost_groups",
                "thinning",
            )
        ),
        *((name, _Bases) for name in ("grid", "cost_bases")),
        *((name, c_void_p) for name in ("values", "jacobian", "cost_residuals")),
        *(
            (name, c_void_p)
            for name in (
                "start_q",
                "start_dq",
                "start_ddq",
                "goal_q",
                "goal_dq",
                "goal_ddq",
            )
        ),
        *(
            (name, c_void_p)
            for name in (
                "obstacle_poses",
                "time_basis",
                "time_weights",
                "cost_weights",
                "cost_groups",
            )
        ),
        *(
            (name, c_void_p)
            for name in ("smoothing", "lower", "upper", "nonsmooth", "accelerated")
        ),
        *((name, c_void_p) for name in ("control", "rates", "derivative", "w")),
        *(
            (name, c_void_p)
            for name in ("gradient", "hessian", "factor", "scratch", "index", "initial")
        ),
        ("program", _Polyhedron),
        *(
            (name, c_double)
            for name in ("eta", "beta", "rate_eta", "violation", "gain", "remaining")
        ),
        *((name, c_long * 6) for name in ("point", "variable")),
        *((name, c_long) for name in ("n_derivatives", "n_selected")),
    )


def load_step_library(kernels: KernelLibrary) -> ctypes.CDLL:
    """Return the library of step.c.

    Raises:
        MachineError: It is missing.
    """
    library = kernels.load_source(*SOURCES)
    library.evaluate.argtypes = (c_void_p,) * 3
    library.evaluate.restype = c_double
    build = (*(c_void_p,) * 3, *(c_double,) * 4, *(c_void_p,) * 3)
    library.build_subproblem.restype = None
    library.build_subproblem.argtypes = build
    solve = (
        *(c_void_p,) * 3,
        c_double,
        c_double,
        c_int,
        c_void_p,
        c_double,
        c_double,
        c_int,
        c_void_p,
        c_void_p,
    )
    library.solve_subproblem.argtypes = solve
    return library


class CompiledBackend:
    """Evaluations and subproblems of a motion within its bounds."""

    def __init__(self, motion: Transcription, bounds: Bounds) -> None:
        library = motion.kernels.step_library
        self._evaluate = library.evaluate
        self._build = library.build_subproblem
        self._solve = library.solve_subproblem
        # Keeps the memory of step.c alive.
        self._arrays: list[Any] = []
        self._points = len(motion.grid.s)
        self._m = motion.kernels.values.tape.outputs[0]
        self._nx = motion.nx
        self._motion = self._describe(motion, bounds)
        self._address = ctypes.addressof(self._motion)
        self._activate = motion.activate

    def value(self, x: Array) -> tuple[float, Array, float]:
        """Evaluate the regularized objective, residuals (K, m) and their largest violation."""
        g = np.empty((self._m, self._points))
        self._activate()
        cost = self._evaluate(self._address, address_of(x), address_of(g))
        return cost, g.T, self._motion.violation

    def subproblem(
        self,
        x: Array,
        g: Array,
        selection: ResidualSelection,
        *,
        proximal: float,
        penalty: float,
    ) -> "CompiledSubproblem":
        """Build the subproblem at x with residuals g.

        It is valid until the next one is built.
        """
        selected = np.zeros((self._m, self._points), bool)
        missed = np.ascontiguousarray(selection.missed.T)
        # The C code has residuals as rows and grid points as columns, (m, K).
        before = (
            None
            if selection.multipliers is None
            else np.ascontiguousarray(selection.multipliers.T)
        )
        self._motion.violation = selection.violation
        self._activate()
        self._build(
            self._address,
            address_of(x),
            address_of(g.T),
            proximal,
            selection.max_distance,
            MAX_SPEED_DISTANCE,
            selection.max_log_rate_change,
            address_of(missed),
            None if before is None else address_of(before),
            address_of(selected),
        )
        gradient = penalty * selection.violation + ELASTIC_GRADIENT
        return CompiledSubproblem(self, g, selected.T, gradient)

    def solve(
        self,
        subproblem: "CompiledSubproblem",
        box: Array,
        warm: Array | None,
        *,
        relax: bool,
    ) -> Step | None:
        """Solve the program of the last subproblem; return None without a solution."""
        dx = np.empty(self._nx)
        multipliers = np.zeros((self._m, self._points))
        before = None if warm is None else np.ascontiguousarray(warm.T)
        warm_start = None if before is None else address_of(before), MIN_MULTIPLIER
        limits = (QP_TOLERANCE, MAX_WORKING_SET_CHANGES)
        results = (address_of(dx), address_of(multipliers))
        cost = subproblem.elastic_gradient, ELASTIC_CURVATURE_ROOT
        inputs = address_of(subproblem.g.T), address_of(box)
        if not self._solve(
            self._address, *inputs, *cost, relax, *warm_start, *limits, *results
        ):
            return None
        state = self._motion
        return (
            Step(dx, state.remaining, multipliers.T, state.gain)
            if np.isfinite(dx).all()
            else None
        )

    def _describe(self, motion: Transcription, bounds: Bounds) -> _Motion:
        # Rows of matrices are padded to whole vectors.
        spec = motion.spec
        stride = motion.nx + 2 + -(motion.nx + 2) % MAX_LANES
        path = end_derivatives(spec.path_control_points, spec.degree)
        rate = end_derivatives(spec.rate_control_points, spec.degree)
        return _Motion(
            n=motion.n,
            path=spec.path_control_points,
            rate=spec.rate_control_points,
            support=motion.grid.bases.support,
            fixed=3 + motion.interior,
            nx=motion.nx,
            stride=stride,
            m=self._m,
            thinning=THINNING,
            eta=path.eta,
            beta=path.beta,
            rate_eta=rate.eta,
            program=self._program(stride),
            **self._constants(motion, bounds),
            **self._work_arrays(motion, stride),
        )

    def _constants(self, motion: Transcription, bounds: Bounds) -> dict[str, Any]:
        """Return the arrays and kernels that no step changes."""
        grid = motion.grid
        kernels = motion.kernels
        groups = np.empty((0, 3))
        if kernels.cost_term is not None:
            groups = kernels.cost_term.groups(kernels.cost_counts)
        arrays = {
            **vars(motion.boundary),
            "obstacle_poses": motion.poses_along,
            "time_basis": grid.time_basis,
            "time_weights": grid.time_weights,
            "cost_weights": grid.cost_weights,
            "cost_groups": groups,
            "smoothing": motion.smoothing,
            "lower": bounds.lower.T,
            "upper": bounds.upper.T,
            "nonsmooth": bounds.nonsmooth.T,
            "accelerated": bounds.accelerated,
        }
        # The boundary's parameters are no field of the C structure.
        del arrays["parameters"]
        fields: dict[str, Any] = {
            name: None if array is None else self._keep(array)
            for name, array in arrays.items()
        }
        if (cost := kernels.cost_residuals) is not None:
            fields |= {
                "cost_residuals": cost.address,
                "n_cost_residuals": cost.tape.outputs[0],
            }
        return {
            **fields,
            "grid": self._bases(grid.bases),
            "cost_bases": self._bases(grid.cost_bases),
            "values": kernels.values.address,
            "jacobian": kernels.jacobian.address,
            "n_time_nodes": len(grid.time_weights),
            "n_cost_groups": len(groups),
        }

    def _work_arrays(self, motion: Transcription, stride: int) -> dict[str, int]:
        """Allocate the work arrays with the sizes of step.c."""
        spec = motion.spec
        n = motion.n
        nx = motion.nx
        size = self._m * self._points
        width = motion.kernels.values.tape.inputs[0]
        nodes = len(motion.grid.cost_weights)
        count = (
            0
            if motion.kernels.cost_residuals is None
            else motion.kernels.cost_residuals.tape.outputs[0]
        )
        cost_term = nodes * ((4 * n + 3) * (count + 1) + (2 + stride) * count) + stride
        duration = (
            len(motion.grid.time_weights) * (spec.rate_control_points + MAX_LANES)
            + stride
        )
        subproblem = size + (width + 1) * self._m * TILE_POINTS + stride
        sizes = {
            "control": spec.path_control_points * n,
            "rates": spec.rate_control_points,
            "derivative": 6 * (n + MAX_LANES),
            "w": width * self._points,
            "gradient": nx,
            "hessian": nx * stride + ROWS_PER_BLOCK,
            "factor": nx * stride,
            "scratch": max(subproblem, cost_term, duration) + ROWS_PER_BLOCK,
            "index": size,
            "initial": size,
        }
        return dict(zip(sizes, self._allocate(list(sizes.values())), strict=True))

    def _program(self, stride: int) -> _Polyhedron:
        dim = self._nx + 1
        rows = dim + self._m * self._points + ROWS_PER_BLOCK
        scratch = (2 * dim + ROWS_PER_BLOCK) * stride + 8 * (stride + ROWS_PER_BLOCK)
        # An upper bound: blocks have 8 rows or more.
        blocks = rows
        # In the order of _Polyhedron.
        sizes = rows * dim, rows, rows, rows, scratch, dim, blocks
        return _Polyhedron(dim, stride, 0, *self._allocate(sizes))

    def _allocate(self, sizes: Sequence[int]) -> list[int]:
        """Return the addresses of arrays of so many numbers, aligned to cache lines."""
        # Sizes are rounded up to cache lines, so that every array begins at one.
        lines = [size + -size % CACHE_LINE_DOUBLES for size in sizes]
        array = aligned_array(sum(lines))
        self._arrays.append(array)
        begin = address_of(array)
        return [
            begin + array.itemsize * before for before in accumulate(lines, initial=0)
        ][:-1]

    def _bases(self, bases: Bases) -> _Bases:
        orders, points, _ = bases.path.shape
        arrays = (
            *bases.phases_last,
            bases.path_at,
            bases.rate_at,
            *bases.first_support,
        )
        return _Bases(orders, points, *map(self._keep, arrays))

    def _keep(self, array: AnyArray) -> int:
        array = np.ascontiguousarray(array)
        self._arrays.append(array)
        return address_of(array)


@dataclass(frozen=True)
class CompiledSubproblem:
    """Quadratic model of the objective and linear model of the selected residuals at an iterate with residuals g."""

    backend: CompiledBackend
    g: Array
    selected: Mask  # residuals in the programs, shape (K, m)
    elastic_gradient: float  # of the elastic variable's cost

    def solve(
        self, box: Array, *, warm: Array | None = None, relax: bool = False
    ) -> Step | None:
        """Return the best step within the box of largest changes, shape (nx,), or None without a solution.

        ``warm`` are the multipliers of the residuals in the initial working set, shape
        (K, m). With ``relax`` satisfied residuals may be violated, too, up to the
        remaining largest violation.
        """
        return self.backend.solve(self, box, warm, relax=relax)
