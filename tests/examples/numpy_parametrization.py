"""The time parametrization in NumPy: the reference of ``time_parametrization.c``."""

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.planner.time_parametrization import (
    MAX_RATE_DECREASE,
    MAX_RATE_INCREASE,
    TimeParametrization,
    moves_of,
)
from cnpgen.planner.time_scaling import blocks_of_motions
from cnpgen.trajectory.spline_motion import Motion


class NumpyTimeParametrization(TimeParametrization):
    """``TimeParametrization`` in NumPy."""

    def parametrize(
        self, motion: Motion, obstacle_poses: Array
    ) -> tuple[Motion, NDArray[np.bool_]]:
        """See ``TimeParametrization``."""
        rate, violation = motion.rate.astype(np.float64), np.empty(len(motion))
        for block in blocks_of_motions(len(motion)):
            rate[block], violation[block] = self._parametrize_block(
                motion[block], obstacle_poses[block]
            )
        meets_limits = violation <= self.violation_tolerance
        return Motion(motion.path, rate, motion.degree), meets_limits

    def _parametrize_block(
        self, motion: Motion, obstacle_poses: Array
    ) -> tuple[Array, Array]:
        """Return the rates and the largest violations.

        Inf for motions whose control points moved twice.
        """
        rate, column = motion.rate.copy(), self.column(motion, obstacle_poses)
        # Coefficients depend on the path alone, so they stay valid while rates move.
        twice = self._fit_rates(rate, self.coefficients(column))
        new_column = self.column(
            Motion(motion.path, rate, motion.degree), obstacle_poses
        )
        # Both violations at the phases: the fit must not make a motion worse.
        before, after = (
            self.violation(states)[0].reshape(len(motion), -1).max(axis=1)
            for states in (column, new_column)
        )
        better = after <= np.maximum(before, self.violation_tolerance)
        violation = np.where(twice, np.inf, np.where(better, after, before))
        return np.where(better[:, None], rate, motion.rate), violation

    def _fit_rates(self, rate: Array, coefficients: list[Array]) -> NDArray[np.bool_]:
        """Fit the rates of N motions in place as time_parametrization.c does.

        Return which of them moved twice.
        """
        shaped = [
            coefficient.reshape(len(coefficient), len(rate), -1)
            for coefficient in coefficients
        ]
        table, movable = self.rate, slice(self.fixed, rate.shape[1] - self.fixed)
        increase = _sweep(rate, shaped, self.relaxed_bounds, table, self.fixed)
        # A control point that became much larger gives its neighbors room: move all
        # again.
        again = increase > self.min_increase
        some = rate[again]
        _sweep(
            some,
            [coefficient[:, again] for coefficient in shaped],
            self.relaxed_bounds,
            table,
            self.fixed,
        )
        rate[again] = some
        # Last, scale all movable points together: the direction is the rate itself.
        along = rate[:, movable] @ table[:, :, movable].swapaxes(1, 2)
        step = advance(shaped, self.relaxed_bounds, rate @ table.swapaxes(1, 2), along)
        rate[:, movable] *= (1 + step[:, None]) * (1 - self.margin)
        return again


def by_numpy(one: TimeParametrization) -> NumpyTimeParametrization:
    """Return the same time parametrization in NumPy."""
    values = {each.name: getattr(one, each.name) for each in fields(one)}
    return NumpyTimeParametrization(**values)


def _sweep(
    rate: Array,
    coefficients: list[Array],
    bounds: tuple[Array, Array],
    table: Array,
    fixed: int,
) -> Array:
    """Move the control points of N rates in their order, in place.

    Return their largest relative increases.
    """
    largest = np.zeros(len(rate))
    for point, fraction in zip(*moves_of(rate.shape[1], fixed), strict=True):
        # Direction of r if control point j is multiplied by 1 + x: x c_j B_j.
        along = rate[:, point, None] * table[:, None, :, point]
        x = advance(coefficients, bounds, rate @ table.swapaxes(1, 2), along)
        # Steps up are taken in part, so that the points after it can move, too; steps
        # back in full.
        x = np.where(x > 0, fraction * x, x)
        rate[:, point] *= 1 + x
        largest = np.fmax(largest, x)
    return largest


def advance(
    coefficients: list[Array], bounds: tuple[Array, Array], rates: Array, along: Array
) -> Array:
    """Return the largest steps of N rates within the bounds, or the required steps back if one is violated.

    Coefficients (constant, square, mixed and, with viscous friction, linear) have shape
    (m, N, K) each, bounds (m,) each, r with r' and their directions (2, N, K).
    """
    (constant, square, mixed, *linear), (r, r1), (b, b1) = coefficients, rates, along
    # On the ray r + x b each value is a quadratic g + first x + second x^2.
    value = constant + (square * r + mixed * r1) * r
    first = (2 * square * r + mixed * r1) * b + mixed * r * b1
    if linear:
        value, first = value + linear[0] * r, first + linear[0] * b
    second = (square * b + mixed * b1) * b
    low, high = (bound[:, None, None] for bound in bounds)
    # Both bounds as g <= margin: the lower one with its sign changed.
    margin = np.stack([high - value, value - low])
    first, second = np.stack([first, -first]), np.stack([second, -second])
    # Where neither term depends on x, a violation cannot be removed by a step.
    violated, depends = margin < 0, (first != 0) | (second != 0)
    # A violated bound is met by a step back: solve with x -> -x.
    distance = smallest(np.abs(margin), first, np.where(violated, -second, second))
    forwards = np.where(violated, np.inf, distance).min(axis=(0, 1, 3))
    back = np.where(violated & np.isfinite(distance), distance, 0.0).max(axis=(0, 1, 3))
    # A violation comes first: the largest required step back, else the largest step up.
    goes_back = (violated & depends).any(axis=(0, 1, 3))
    step: Array = np.where(
        goes_back,
        np.maximum(-back, MAX_RATE_DECREASE),
        np.minimum(forwards, MAX_RATE_INCREASE),
    )
    return step


def smallest(margin: Array, linear: Array, square: Array) -> Array:
    """Return the smallest x > 0 with ``square x^2 + linear x = margin``, elementwise.

    Infinite if there is none.
    """
    # 2 margin / (l + sqrt(l^2 + 4 q margin)) instead of (-l + sqrt(...)) / (2 q): it
    # needs no division by q and does not cancel.
    with np.errstate(all="ignore"):
        below = linear + np.sqrt(linear**2 + 4 * square * margin)
        x: Array = np.where(below > 0, 2 * margin / below, np.inf)
    return x
