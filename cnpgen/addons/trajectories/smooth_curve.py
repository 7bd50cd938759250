"""The smooth curve through samples of positions and velocities, with accelerations within limits at both ends.

Between samples that resolve the motion, the accelerations are those of a polynomial of
degree 9 through the positions and velocities of five samples. At its ends, a motion may
change its acceleration faster than the samples resolve. The accelerations of the first
and the last spans are therefore piecewise linear: the smoothest ones that lead through
the samples within the limits. Their positions and velocities are exactly those of the
samples.
"""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np

from cnpgen.addons.trajectories.curve_family import CurveFamily
from cnpgen.addons.trajectories.interpolate import family_of_data
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.errors import UsageError

NEIGHBORS = 5  # samples whose positions and velocities determine an acceleration
FEW_NEIGHBORS = 3  # of a second, less accurate estimate
END_SPANS = 3  # at each end, with piecewise linear accelerations
# Of the first spans, as shares of their lengths: fine ones where the acceleration
# changes fastest.
_PARTS = (
    (0, 0.02, 0.05, 0.1, 0.17, 0.25, 0.35, 0.5, 0.65, 0.8),
    (0, 0.1, 0.25, 0.4, 0.55, 0.7, 0.85),
    (0, 0.25, 0.5, 0.75),
)
# Weight of a change of jerk at an end, relative to one after the first span.
MIN_SMOOTHNESS = 0.1
REGULARIZATION = 1e-10  # of the curvature of a quadratic program
END_PROGRAM_TOLERANCE = 1e-10
DAQP_EQUALITY = 5
MIN_STEP_S = 1e-12  # between samples
# Between knots in a span: rounding of positions changes jerks by eps / step^3.
MIN_KNOT_STEP_S = 3e-5


@dataclass(frozen=True, eq=False)
class AccelerationLimits:
    """Largest accelerations [rad/s^2] and jerks [rad/s^3] of a curve at its ends, shape (n,) each; inf for no limit."""

    acceleration: Array
    jerk: Array


def smooth_curve(
    trajectory: Trajectory, limits: AccelerationLimits
) -> CurveFamily | None:
    """Return the smooth curve through samples; None if no such curve meets the limits at the ends.

    Given accelerations are those of the curve at the samples.
    """
    t, q, dq, ddq = trajectory.t, trajectory.q, trajectory.dq, trajectory.ddq
    if dq is None or len(t) < 2 * END_SPANS + 2:
        return None
    inner, jerks = (
        estimated_derivative(trajectory, order, NEIGHBORS) for order in (2, 3)
    )
    samples = [t, q, dq, inner if ddq is None else ddq, jerks]
    # The end is the start of the reversed motion.
    first, last = (
        _end(
            *(values[: END_SPANS + 1] for values in each),
            limits=limits,
            given=ddq is not None,
        )
        for each in (samples, _reversed(samples, t[-1]))
    )
    if first is None or last is None:
        return None
    between = slice(END_SPANS + 1, len(t) - END_SPANS - 1)
    parts = [
        np.concatenate([start, values[between], end])
        for start, values, end in zip(
            first, samples, _reversed(last, t[-1]), strict=False
        )
    ]
    # Knots closer than the rounding of times would enclose a span without length.
    kept = np.diff(parts[0], prepend=-1.0) > MIN_STEP_S
    return family_of_data(parts[0][kept], [values[kept] for values in parts[1:]])


def _reversed(samples: Sequence[Array], duration: float) -> list[Array]:
    """Return times, positions and derivatives in the order of reversed time, t' = T - t."""
    t, *values = (each[::-1] for each in samples)
    # A reversed time changes the sign of the odd derivatives, velocity and jerk.
    return [duration - t, *((-1) ** order * each for order, each in enumerate(values))]


def estimated_derivative(trajectory: Trajectory, order: int, neighbors: int) -> Array:
    """Estimate a derivative at samples with velocities from some of their neighbors, shape (K, n)."""
    t = trajectory.t
    q = trajectory.q
    dq = trajectory.dq
    if dq is None:
        raise UsageError("an estimate of derivatives needs samples with velocities")
    size = min(neighbors, len(t))
    count = len(t)
    # The window of a sample is centered on it, and shifted inward near both ends.
    first = np.clip(np.arange(count) - size // 2, 0, count - size)
    window = first[:, None] + np.arange(size)
    # Phases x = (t - t_k) / scale in [-1, 1] keep the powers of x near one.
    scale = t[window[:, -1]] - t[window[:, 0]]
    x = (t[window] - t[:, None]) / scale[:, None]
    powers = np.arange(2 * size)
    # The polynomial sum_i c_i x^i meets q and dq at all samples of the window
    # (Hermite).
    values = x[:, :, None] ** powers
    derivatives = powers * x[:, :, None] ** np.maximum(powers - 1, 0)
    # A constant has no derivatives: differences from the own position lose fewer
    # digits.
    data = np.concatenate(
        [q[window] - q[:, None], dq[window] * scale[:, None, None]], axis=1
    )
    # At x = 0 the derivative is order! c_order. The weights w solve A^T w = wanted, so
    # w times the data is this derivative.
    wanted = np.zeros((count, 2 * size, 1))
    wanted[:, order] = factorial(order)
    weights = np.linalg.solve(
        np.concatenate([values, derivatives], axis=1).swapaxes(1, 2), wanted
    )[..., 0]
    # Phases are shares of the scale, so derivatives by time need a factor scale^-order.
    return np.asarray(np.einsum("kw,kwn->kn", weights, data) / scale[:, None] ** order)


def _end(
    t: Array,
    q: Array,
    dq: Array,
    ddq: Array,
    jerk: Array,
    *,
    limits: AccelerationLimits,
    given: bool,
) -> tuple[Array, Array, Array, Array] | None:
    """Return times, positions, velocities and accelerations at the knots of the first spans, or None."""
    knots = np.concatenate(
        [*(_knots(t[k], t[k + 1], _PARTS[k]) for k in range(END_SPANS)), t[-1:]]
    )
    program = _EndProgram.at(t, knots, given=given)
    columns = []
    for joint in range(q.shape[1]):
        bounds = float(limits.acceleration[joint]), float(limits.jerk[joint])
        column = program.solve(
            q[:, joint], dq[:, joint], ddq[:, joint], float(jerk[-1, joint]), bounds
        )
        if column is None:
            return None
        columns.append(column)
    # Linear accelerations over a step d change dq by d (a_k + a_k+1) / 2. They change q
    # by d dq + d^2 (a_k / 3 + a_k+1 / 6).
    accelerations = np.stack(columns, axis=1)
    step = np.diff(knots)[:, None]
    velocities = dq[0] + _sums(step * (accelerations[1:] + accelerations[:-1]) / 2)
    moves = velocities[:-1] * step + step**2 * (
        accelerations[:-1] / 3 + accelerations[1:] / 6
    )
    return knots, q[0] + _sums(moves), velocities, accelerations


def _knots(start: float, end: float, parts: tuple[float, ...]) -> Array:
    """Return knots at shares of a span, without those that are too close for the rounding of jerks."""
    found = [start]
    for part in parts[1:]:
        knot = start + (end - start) * part
        if knot - found[-1] >= MIN_KNOT_STEP_S and end - knot >= MIN_KNOT_STEP_S:
            found.append(knot)
    return np.array(found)


def _sums(steps: Array) -> Array:
    """Return cumulative sums that begin with 0, shape (K, n) -> (K + 1, n)."""
    return np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])


@dataclass(frozen=True, eq=False)
class _EndProgram:
    """Quadratic program of the accelerations at N knots of one joint."""

    curvature: Array  # Hessian of the cost, shape (N, N)
    # Gradient of the cost per unit of the jerk at the last knot, shape (N,).
    gradient: Array
    # Rows for the changes of velocity and position in every span, and for known
    # accelerations.
    equalities: Array
    jerks: Array  # rows for the jerks between knots, shape (N - 1, N)
    h: Array  # lengths of the spans [s]
    # Whether the accelerations at all samples are known, not only the last one.
    given: bool

    @classmethod
    def at(cls, t: Array, knots: Array, *, given: bool) -> "_EndProgram":
        """Return the program for samples at times t and knots between them, both ascending from 0."""
        steps, size, h = np.diff(knots), len(knots), np.diff(t)
        # The small shift finds the knot of a sample in spite of rounding.
        at_samples = np.searchsorted(knots, t - MIN_STEP_S)
        velocity, position = np.zeros((len(h), size)), np.zeros((len(h), size))
        for span in range(len(h)):
            for k in range(at_samples[span], at_samples[span + 1]):
                # A linear acceleration over a step d changes dq by d (a_k + a_k+1) / 2.
                # With r from knot k to the end of the span, q changes by
                # d r (a_k + a_k+1) / 2 - d^2 (a_k / 6 + a_k+1 / 3).
                rest = t[span + 1] - knots[k]
                velocity[span, k : k + 2] += steps[k] / 2
                position[span, k : k + 2] += steps[k] * np.array(
                    [rest / 2 - steps[k] / 6, rest / 2 - steps[k] / 3]
                )
        known = np.eye(size)[at_samples if given else at_samples[-1:]]
        jerks = np.diff(np.eye(size), axis=0) / steps[:, None]
        # And the difference from the given jerk.
        changes = np.concatenate([np.diff(jerks, axis=0), jerks[-1:]])
        width = np.append((steps[1:] + steps[:-1]) / 2, steps[-1])
        # Squares of changes of jerk divided by their widths sum to an integral. Their
        # weight grows with the time from the end, so the acceleration may change
        # fastest there.
        weight = (MIN_SMOOTHNESS + knots[1:] / h[0]) ** 2 * np.sqrt(h[0] ** 3 / width)
        weighted = changes * weight[:, None]
        curvature, gradient = weighted.T @ weighted, weight[-1] * weighted[-1]
        # A constant acceleration has no cost: only the regularization makes the Hessian
        # positive definite.
        scale = float(np.abs(curvature).max())
        return cls(
            curvature / scale + REGULARIZATION * np.eye(size),
            gradient / scale,
            # Rows have the unit of accelerations, whatever the spacing of samples.
            np.concatenate([velocity / h[:, None], position / h[:, None] ** 2, known]),
            jerks,
            h,
            given,
        )

    def solve(
        self, q: Array, dq: Array, ddq: Array, jerk: float, bounds: tuple[float, float]
    ) -> Array | None:
        """Return the accelerations of one joint at the knots, shape (N,).

        None if there are none within both bounds.
        """
        import daqp

        # What the accelerations of a span must add to the motion at constant dq.
        moved = (q[1:] - q[:-1] - dq[:-1] * self.h) / self.h**2
        known = ddq if self.given else ddq[-1:]
        target = np.concatenate([np.diff(dq) / self.h, moved, known])
        # DAQP takes 1e30 as infinity.
        size, (largest, steepest) = (
            len(self.curvature),
            (min(bound, 1e30) for bound in bounds),
        )
        rows = self.equalities
        # The first N bounds of DAQP are those of the variables; rows follow.
        high = [np.full(size, largest), target]
        low = [np.full(size, -largest), target]
        if np.isfinite(bounds[1]):
            rows = np.concatenate([rows, self.jerks])
            high.append(np.full(size - 1, steepest))
            low.append(np.full(size - 1, -steepest))
        sense = np.zeros(size + len(rows), ctypes.c_int)
        sense[size : size + len(target)] = DAQP_EQUALITY
        solution: tuple[Any, ...] = daqp.solve(
            self.curvature,
            -jerk * self.gradient,
            np.ascontiguousarray(rows),
            np.concatenate(high),
            np.concatenate(low),
            sense,
            primal_tol=END_PROGRAM_TOLERANCE,
        )
        # An exit flag of 1 is an optimum within the tolerance.
        return np.array(solution[0]) if solution[2] == 1 else None
