"""Scale motions from rest to rest uniformly in time until the limits hold; the path stays the same.

At ``r / k`` velocities are 1/k and accelerations 1/k^2 of their values at r. A bounded
value g(q, dq, ddq) is then ``g0 + b / k + c / k^2``, exactly so for velocities,
accelerations and torques with friction of a fixed direction. Values of g at k = 1, at k = 2 and at rest determine b and c,
and the smallest k at which all g are within their bounds follows in closed form. Values
that depend on the jerk are ``g0 + d / k^3``. A power of a motor is ``b / k + c / k^2 +
d / k^3``; a further value, at k = 4, determines it.
"""

from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.expressions import (
    SpeedBounds,
    has_friction,
    speed_bounds,
    speed_residuals,
    speed_violation,
)
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.spline import basis_tables, chebyshev
from cnpgen.trajectory.spline_motion import Motion, time_derivatives

MAX_TIME_SCALE = 3.0  # motions that need more are not usable plans
POWER_BISECTIONS = 40  # of a time scale
SCALING_INTERVALS = 128  # between phases
# Relative; limits may be exceeded by about this between two phases.
TIME_SCALE_MARGIN = 2e-4
MOTIONS_PER_BLOCK = 64  # small enough for arrays to stay in the CPU cache


def blocks_of_motions(count: int, size: int = MOTIONS_PER_BLOCK) -> list[slice]:
    """Split motions into blocks of ``size``."""
    return [slice(first, first + size) for first in range(0, count, size)]


@dataclass(frozen=True)
class PhaseGrid:
    """Grid of K phases, for time scaling and time parametrization; made by ``make_phase_grid``.

    Attributes:
        violation: Kernel of ``expressions.speed_violation``.
        path: Basis of p and its derivatives at the phases, shape (orders, K, C).
        rate: Basis of r and its derivatives at the phases, shape (orders - 1, K, R).
    """

    violation: Kernel
    path: Array
    rate: Array

    def column(self, motion: Motion, obstacle_poses: Array) -> Array:
        """Return path, rate, their derivatives and obstacle poses at all phases of N motions, shape (width, N K)."""
        (orders, phases, points), (count, _, n) = self.path.shape, motion.path.shape
        # Rows of the column: derivatives of the path, then those of the rate, then
        # poses.
        first, last = orders * n, orders * n + orders - 1
        # All phases of one motion are next to each other, so one product evaluates
        # them.
        out = np.empty((last + obstacle_poses.shape[1], count * phases))
        path = motion.path.transpose(2, 0, 1).reshape(n * count, points)
        np.matmul(
            path,
            self.path.swapaxes(1, 2),
            out=out[:first].reshape(orders, n * count, phases),
        )
        np.matmul(
            motion.rate,
            self.rate.swapaxes(1, 2),
            out=out[first:last].reshape(orders - 1, count, phases),
        )
        out[last:].reshape(-1, count, phases)[:] = obstacle_poses.T[..., None]
        return out


def make_phase_grid(
    problem: Problem, kernels: KernelLibrary, intervals: int
) -> PhaseGrid:
    """Make the grid of one problem, with K - 1 intervals between its phases."""
    tables = basis_tables(problem.trajectory, chebyshev(intervals), problem.path_orders)
    return PhaseGrid(kernels.load(speed_violation), *map(np.stack, tables))


@dataclass(frozen=True)
class TimeScaling(PhaseGrid):
    """Uniform time scaling of a problem's motions, by the kernel of ``expressions.speed_residuals`` and its bounds.

    With ``has_friction`` the kernel takes velocities that determine the direction of friction.
    """

    residuals: Kernel
    bounds: SpeedBounds
    has_friction: bool = False

    def factor(self, motion: Motion, obstacle_poses: Array) -> Array:
        """Return the smallest time scale, at least 1, at which each of N motions from rest to rest meets its limits.

        Violations that do not depend on time are ignored, such as a torque exceeded by
        gravity alone. Obstacle poses have shape (N, width), the scales (N,).
        """
        factor, phases = np.ones(len(motion)), self.path.shape[1]
        # Of phases with a violation: few.
        columns, motions = [], []
        for block in blocks_of_motions(len(motion)):
            column = self.column(motion[block], obstacle_poses[block])
            (violation,) = self.violation(column)
            # Most phases meet their limits: only the others are measured at other
            # speeds.
            violating = np.flatnonzero(violation[0] > 0)
            if len(violating):
                columns.append(column.take(violating, axis=1))
                motions.append(block.start + violating // phases)
        if not motions:
            return factor
        np.maximum.at(
            factor,
            np.concatenate(motions),
            self._required_scale(np.concatenate(columns, axis=1)),
        )
        return np.where(
            factor > 1,
            np.minimum(factor * (1 + TIME_SCALE_MARGIN), MAX_TIME_SCALE),
            1.0,
        )

    def _required_scale(self, column: Array) -> Array:
        """Return the smallest time scales of L columns, shape (L,)."""
        n, orders = self.residuals.tape.inputs[0], len(self.path)
        p, p1, p2, *third = column[: orders * n].reshape(orders, n, -1)
        (r, r1, *second), obstacle_poses = (
            column[orders * n :][: orders - 1],
            column[orders * n + orders - 1 :],
        )
        _, *moving = time_derivatives([p, p1, p2, *third], [r, r1, *second])
        # A scaled motion has the direction of friction of the given one, at rest, too.
        friction = [moving[0]] if self.has_friction else []

        def values(k: float) -> Array:
            scaled = (term / k**order for order, term in enumerate(moving, 1))
            return np.array(self.residuals(p, *scaled, obstacle_poses, *friction)[0])

        # Three values determine static + b / k + c / k^2; a cubic part needs a fourth.
        fast, slow, static = map(values, (1.0, 2.0, np.inf))
        slowest = values(4.0) if self.bounds.power.any() else static
        needed = np.ones(fast.shape[1])
        # Upper bounds as they are, lower bounds with all signs changed.
        for sign, bounds in ((1.0, self.bounds.upper), (-1.0, self.bounds.lower)):
            row, phase = np.nonzero(sign * fast > sign * bounds[:, None])  # few
            at_rest = static[row, phase]
            margin, change, half = (
                sign * (x - at_rest)
                for x in (bounds[row], fast[row, phase], slow[row, phase])
            )
            # c, from g(1) = static + b + c and g(2) = static + b / 2 + c / 4
            quadratic = 2 * (change - 2 * half)
            scale = _smallest_scale(margin, change - quadratic, quadratic)
            cubic = self.bounds.cubic[row]
            scale[cubic] = _smallest_scale_cubic(margin[cubic], change[cubic])
            if (power := self.bounds.power[row]).any():
                quarter = sign * slowest[row, phase][power]
                scale[power] = _smallest_scale_of_powers(
                    margin[power], change[power], half[power], quarter
                )
            np.maximum.at(needed, phase, scale)
        return needed


def make_time_scaling(
    problem: Problem, robot: Robot, kernels: KernelLibrary
) -> TimeScaling:
    """Load the time scaling of one problem."""
    speeds = make_phase_grid(problem, kernels, SCALING_INTERVALS)
    residuals = kernels.load(speed_residuals)
    return TimeScaling(
        speeds.violation,
        speeds.path,
        speeds.rate,
        residuals,
        speed_bounds(robot, problem),
        has_friction(robot),
    )


def _smallest_scale(margin: Array, linear: Array, quadratic: Array) -> Array:
    """Return the smallest k >= 1 with ``linear / k + quadratic / k^2 <= margin``.

    1 if there is no margin at rest.
    """
    with np.errstate(all="ignore"):
        root = np.sqrt(np.maximum(linear**2 + 4 * quadratic * margin, 0.0))
        # Of margin k^2 - linear k - quadratic = 0.
        k = (linear + root) / (2 * margin)
    # Without a positive margin at rest no scale helps.
    violated = (linear + quadratic > margin) & (margin > 0) & np.isfinite(k)
    return np.where(violated, np.maximum(k, 1.0), 1.0)


def _smallest_scale_of_powers(
    margin: Array, fast: Array, slow: Array, slowest: Array
) -> Array:
    """Return k >= 1 with ``a / k + b / k^2 + d / k^3 = margin > 0`` from values at k = 1, 2 and 4, where 1 is too fast."""
    # fast = a + b + d, slow = a / 2 + b / 4 + d / 8. With slowest = a / 4 + b / 16 + d
    # / 64 they determine a, b and d.
    a = (64 * slowest - 24 * slow + 2 * fast) / 6
    b = 8 * slow - fast - 3 * a
    d = fast - a - b
    low, high = np.full(len(fast), 1 / MAX_TIME_SCALE), np.ones(len(fast))  # of 1 / k
    for _ in range(POWER_BISECTIONS):
        x = (low + high) / 2
        # x = 1 / k: the polynomial exceeds the margin at x = 1, and bisection keeps the
        # side within it.
        within = ((d * x + b) * x + a) * x <= margin
        low, high = np.where(within, x, low), np.where(within, high, x)
    return np.asarray(1 / low)


def _smallest_scale_cubic(margin: Array, change: Array) -> Array:
    """Return the smallest k >= 1 with ``change / k^3 <= margin``.

    1 if there is no margin at rest.
    """
    with np.errstate(all="ignore"):
        k = np.cbrt(change / margin)
    return np.where((change > margin) & (margin > 0) & np.isfinite(k), k, 1.0)
