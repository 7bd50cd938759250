"""Fit the rates after the network to the limits: as large as allowed, and smaller if limits are violated.

The path stays. So do the two control points of the rate at either end that determine
velocities and accelerations there; at rest they have no effect, and move. On a fixed
path a bounded value is ``g = constant + square r^2 + mixed r r'`` with coefficients
that depend on the phase alone: squares of velocities, accelerations and torques, as in
time-optimal path parametrization (Bobrow, Dubowsky and Gibson, 1985). The viscous
friction of drives adds ``linear r``, and dry friction a constant, since its direction
along a path is that of p'. So it is a
quadratic of each control point of the rate, or of a factor of them all, and the largest
step up to the first bound follows in closed form. Every second control point takes a
fraction of its step, one after the other, then those between them a larger fraction;
finally all of them are scaled together. From rest to rest the control points move twice
if one of them has become much larger, and motions keep a margin of the limits between
the phases.
"""

import ctypes
from ctypes import c_double, c_long, c_void_p
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.kernels.compiled_kernel import address_of, aligned_array
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.expressions import (
    coefficient_bounds,
    speed_bounds,
    speed_coefficients,
)
from cnpgen.planner.time_scaling import PhaseGrid, make_phase_grid
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.unchecked import unchecked
from cnpgen.trajectory.spline_motion import Motion

SOURCE = Path(__file__).with_name("time_parametrization.c")
# Between phases; the 80 phases fill vectors of any width.
PARAMETRIZATION_INTERVALS = 79
# From rest to rest, where RATE_MARGIN covers excesses between the phases.
INTERVALS_AT_REST = 63
FIXED_RATE_POINTS = 2  # at either end of motions that are not at rest there
# Relative decrease of the rates from rest to rest, for excesses between the phases.
RATE_MARGIN = 3e-3
# Of the step to the first bound: of every second control point, then of those between.
STEP_FRACTIONS = 0.65, 0.9
# Of a control point in one step, relative.
MAX_RATE_INCREASE, MAX_RATE_DECREASE = 1.0, -0.3
BOUND_ROUNDING = 1e-9  # fraction of a limit by which boundary conditions may exceed it
# Of a control point in a sweep from rest to rest, after which all move again.
MIN_INCREASE_TO_REPEAT = 0.4
MAX_VECTOR_WIDTH = 8  # float64 values


class _TimeParametrization(ctypes.Structure):
    """``parametrization`` of time_parametrization.c."""

    _fields_ = (
        *((name, c_long) for name in ("joints", "pose_width", "path_points", "points")),
        ("linear", c_long),
        *((name, c_long) for name in ("phases", "rows", "first", "last", "moves")),
        *(
            (name, c_void_p)
            for name in ("path", "rate", "lower", "upper", "path_span", "span")
        ),
        *(
            (name, c_void_p)
            for name in ("order", "step_fractions", "coefficients", "violation")
        ),
        *(
            (name, c_double)
            for name in (
                "max_increase",
                "max_decrease",
                "margin",
                "min_increase",
                "tolerance",
            )
        ),
    )


@dataclass(frozen=True)
class TimeParametrization(PhaseGrid):
    """Time parametrization of one problem's motions; made by ``make_time_parametrization``.

    Attributes:
        coefficients: Kernel of ``expressions.speed_coefficients``.
        lower: Lower bounds of its rows, shape (m,).
        upper: Upper bounds of its rows, shape (m,).
        joints: Number of joints.
        fixed: Number of control points of the rate at either end that stay; 0 from rest
            to rest.
        margin: Relative decrease of the rates after the last step.
        min_increase: Largest increase of a control point in a sweep above which all
            control points move again.
        library: Library of time_parametrization.c.
    """

    coefficients: Kernel
    lower: Array
    upper: Array
    joints: int
    fixed: int
    margin: float
    min_increase: float
    library: ctypes.CDLL

    def parametrize(
        self, motion: Motion, obstacle_poses: Array
    ) -> tuple[Motion, NDArray[np.bool_]]:
        """Fit the rates of N motions to the limits; their paths and boundary conditions stay.

        A motion stays as it is if its largest violation would grow, because its bounded
        values are not such quadratics. For the same reason motions may be slower than
        necessary.

        The mask of motions that meet the limits, shape (N,), is False also for motions
        whose control points moved twice: they exceed the limits more between the
        phases.
        """
        rate = np.array(motion.rate, np.float64, order="C")
        violation = np.empty(len(motion))
        self._fit(motion.path, obstacle_poses, rate, violation)
        fitted = unchecked(Motion, motion.path, rate, motion.degree)
        return fitted, violation <= self.violation_tolerance

    @cached_property
    def relaxed_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds, relaxed by rounding errors."""
        # Boundary conditions may be on a limit, up to rounding.
        return self.lower - BOUND_ROUNDING * np.abs(
            self.lower
        ), self.upper + BOUND_ROUNDING * np.abs(self.upper)

    @cached_property
    def violation_tolerance(self) -> float:
        """Tolerance of the violation [SI units of the largest bound]."""
        bounds = np.abs(np.concatenate([self.lower, self.upper]))
        # Ten times the rounding by which the bounds are relaxed.
        return 10 * BOUND_ROUNDING * float(bounds[np.isfinite(bounds)].max(initial=0.0))

    @cached_property
    def _c_arguments(self) -> tuple[_TimeParametrization, list[NDArray[Any]]]:
        """Arguments of time_parametrization.c for the problem, and the arrays that they point to."""
        lower, upper, order, fractions = (
            *self.relaxed_bounds,
            *moves_of(self.rate.shape[2], self.fixed),
        )
        tables, spans = [[of(self.path), of(self.rate)] for of in (_by_point, _span_of)]
        arrays = [*tables, lower, upper, *spans, order, fractions]
        (phases, path_points), points = self.path.shape[1:], self.rate.shape[2]
        counts = (
            self.joints,
            # Widths of the column of ``speed_coefficients``: p, p', p'', r and r' come
            # before poses.
            self.coefficients.tape.inputs[0] - 3 * self.joints - 2,
            path_points,
            points,
            len(self.coefficients.tape.outputs) - 3,
        )
        moves = phases, len(lower), self.fixed, points - self.fixed, len(order)
        addresses = (
            *map(address_of, arrays),
            self.coefficients.address,
            self.violation.address,
        )
        bounds = (
            MAX_RATE_INCREASE,
            MAX_RATE_DECREASE,
            self.margin,
            self.min_increase,
            self.violation_tolerance,
        )
        return _TimeParametrization(*counts, *moves, *addresses, *bounds), arrays

    def _fit(
        self, path: Array, obstacle_poses: Array, rate: Array, violation: Array
    ) -> None:
        """Fit rates in place, and write their largest violations; inf where control points moved twice."""
        rows = (
            self.coefficients.tape.inputs[0]
            + len(self.coefficients.tape.outputs) * len(self.lower)
            + 3
        )
        phases = self.path.shape[1]
        # One buffer for all motions: the C code allocates nothing.
        memory = np.empty(
            MAX_VECTOR_WIDTH * (1 + len(self.lower)) + rows * phases + rate.shape[1]
        )
        inputs = [
            np.ascontiguousarray(array, np.float64) if array.size else None
            for array in (path, obstacle_poses)
        ]
        addresses = (
            None if array is None else address_of(array)
            for array in (*inputs, rate, violation, memory)
        )
        self.library.parametrize_rates(
            ctypes.byref(self._c_arguments[0]), len(rate), *addresses
        )


def make_time_parametrization(
    problem: Problem, robot: Robot, kernels: KernelLibrary, *, at_rest: bool = False
) -> TimeParametrization:
    """Load the time parametrization of one problem; ``at_rest`` is whether motions begin and end at rest.

    A problem that bounds the jerk or the power of motors, which are no quadratics of
    the rate, raises UsageError.
    """
    if problem.path_orders > 3:
        raise UsageError(
            f"plans of {problem.name!r} cannot be time-parametrized: it bounds the jerk"
        )
    bounds = speed_bounds(robot, problem)
    # Powers are cubic in the rate; the coefficients describe squares.
    if bounds.power.any():
        raise UsageError(
            f"plans of {problem.name!r} cannot be time-parametrized: it bounds the power of its motors"
        )
    intervals = INTERVALS_AT_REST if at_rest else PARAMETRIZATION_INTERVALS
    library = kernels.load_source(SOURCE)
    speeds = make_phase_grid(problem, kernels, intervals)
    function = library.parametrize_rates
    function.argtypes, function.restype = (c_void_p, c_long, *[c_void_p] * 5), None
    rows = (
        kernels.load(speed_coefficients),
        *coefficient_bounds(bounds),
    )
    moves = (
        (0, RATE_MARGIN, MIN_INCREASE_TO_REPEAT)
        if at_rest
        else (FIXED_RATE_POINTS, 0.0, np.inf)
    )
    return TimeParametrization(
        speeds.violation, speeds.path, speeds.rate, *rows, robot.n, *moves, library
    )


def _span_of(table: Array) -> NDArray[np.int64]:
    """Return first and last phase, in whole vectors, at which each control point has an effect, shape (points, 2)."""
    # Basis functions are local: only these phases change if the point moves.
    nonzero = (table != 0).any(axis=0)
    # First phase with an effect, and the one after the last; both are widened to whole
    # vectors.
    first, last = nonzero.argmax(axis=0), len(nonzero) - nonzero[::-1].argmax(axis=0)
    return np.stack(
        [first - first % MAX_VECTOR_WIDTH, last + -last % MAX_VECTOR_WIDTH], axis=1
    ).astype(np.int64)


def _by_point(table: Array) -> Array:
    """Return a basis in the layout of time_parametrization.c, shape (orders, points, K), aligned to vectors."""
    aligned = aligned_array(table.size)
    aligned.reshape(table.swapaxes(1, 2).shape)[:] = table.swapaxes(1, 2)
    return aligned


def moves_of(points: int, fixed: int) -> tuple[NDArray[np.int64], Array]:
    """Return the order in which control points of the rate move, and the fractions of their steps."""
    # Outer control points belong to the boundary conditions unless the motion is at
    # rest there.
    movable = np.arange(fixed, points - fixed)
    # Neighbors overlap most, so they move in different halves of a sweep.
    first, second = movable[1::2], movable[::2]
    return np.concatenate([first, second]), np.repeat(
        STEP_FRACTIONS, [len(first), len(second)]
    )
