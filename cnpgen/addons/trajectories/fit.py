"""Fit of a motion to a time-sampled trajectory, so that plans of any planner can be evaluated and refined.

A trajectory q(t) corresponds to many motions: any r(s) > 0 is possible, with the path
p(s) = q(t(s)). They differ in how well a spline of few control points fits that path.
Phase proportional to time is exact for polynomials, but spends control points where the
robot rests. Phase proportional to arc length does the opposite, and is impossible at
rest, where r would be zero. Therefore a few mixtures of both are tried. The best one is
improved by least squares over log r, with the path eliminated (variable projection,
Golub and Pereyra 1973). The path is fitted at the phases that r assigns to the samples,
so that no r causes a drift in time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from cnpgen.addons.trajectories.samples import (
    checked_samples,
    resampled,
    sampled_boundary,
)
from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import numbers
from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.spline import basis, chebyshev, clamped_knots
from cnpgen.trajectory.spline_motion import Motion, scaled_to_duration
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

ARC_LENGTH_FRACTIONS = (0.0, 0.3, 0.6, 0.9)  # of the arc length in the phase
MIN_FIT_ERROR_RAD = 1e-6  # smaller errors count as equal, and the simplest r is chosen
MAX_RATE_FIT_SAMPLES = 2000  # in the optimization of r
MAX_LOG_RATE_CHANGE = 4.0  # in the optimization of r
# Weights of p''' and of second differences of log r; positions: rad.
PATH_SMOOTHNESS = 1e-8
RATE_SMOOTHNESS = 3e-5


@checked_arguments
def fit_motion(
    t: ArrayLike,
    q: ArrayLike,
    dq: ArrayLike | None = None,
    *,
    spec: TrajectorySpec,
    boundary: Boundary | None = None,
) -> Motion:
    """Fit a motion to samples of one trajectory; ``largest_error`` returns the error of the fit.

    Args:
        t: Times of the samples [s], shape (K,), increasing; the motion starts at the
            first one.
        q: Joint positions [rad], shape (K, n).
        dq: Joint velocities [rad/s], shape (K, n): with them, samples are connected by
            cubics.
        spec: Degree and numbers of control points.
        boundary: Boundary conditions of the motion, met exactly; ``sampled_boundary``
            by default.

    Returns:
        One motion of duration ``t[-1] - t[0]``.

    Raises:
        UsageError: A shape is wrong, the times do not increase, or a value is not
            finite.
    """
    times, positions, velocities = checked_samples(t, q, dq)
    if boundary is None:
        boundary = sampled_boundary(times, positions, velocities)
    boundary = _checked_boundary(boundary, positions.shape[1])
    fit = _Fit(
        *resampled(times - times[0], positions, velocities),
        times[-1] - times[0],
        spec,
        boundary,
    )
    rates = [fit.mixed_rate(mixture) for mixture in ARC_LENGTH_FRACTIONS]
    errors = [fit.error(rate) for rate in rates]
    # Of rates that fit equally well, the first: phase proportional to time.
    rate = rates[int(np.argmin(np.maximum(errors, MIN_FIT_ERROR_RAD)))]
    # More samples than control points, or the fit has no unique minimum.
    if min(errors) > MIN_FIT_ERROR_RAD and len(fit.t) > spec.path_control_points:
        step = -(-len(fit.t) // MAX_RATE_FIT_SAMPLES)
        thinned = replace(fit, t=fit.t[::step], q=fit.q[::step])
        # The optimum of fewer samples may be worse on all of them.
        rate = min(rate, thinned.improved_rate(rate), key=fit.error)
    return Motion(fit.path(rate).control[None], rate, spec.degree)


@checked_arguments
def largest_error(motion: Motion, t: ArrayLike, q: ArrayLike) -> float:
    """Compute the maximum distance of one motion from samples over all joints and samples [rad].

    Args:
        motion: One motion; it starts at the first sample.
        t: Times of the samples [s], shape (K,).
        q: Joint positions [rad], shape (K, n).
    """
    times, positions, _ = checked_samples(t, q, None)
    return float(
        np.abs(
            motion.at(motion.phase_at(times[None] - times[0])).q[0] - positions
        ).max()
    )


def _checked_boundary(boundary: Boundary, n: int) -> Boundary:
    """Return the boundary conditions of one motion as arrays; check their shapes."""
    arrays = {
        name: numbers("boundary", row) for name, row in boundary.conditions().items()
    }
    for name, row in arrays.items():
        if row.shape != (1, n):
            raise UsageError(
                f"the boundary's {name} must have shape (1, {n}), got {row.shape}",
                concerns="boundary",
            )
        if not np.isfinite(row).all():
            raise UsageError(
                f"the boundary's {name} must be finite, got {row[0]}",
                concerns="boundary",
            )
    return Boundary(**arrays)


@dataclass(frozen=True)
class _Path:
    """The least-squares fit of the path for a fixed r: control points (C, n) and residuals (K + smoothing rows, n)."""

    s: Array  # phases of the samples
    rows: Array  # matrix of the fit for all control points
    control: Array
    residual: Array


@dataclass(frozen=True)
class _Fit:
    """The fitting problem: K samples of a trajectory from t = 0.

    Rates are control points of shape (N, R).
    """

    t: Array
    q: Array
    duration: float
    spec: TrajectorySpec
    boundary: Boundary

    @property
    def free(self) -> slice:
        """The interior path control points."""
        return slice(3, self.spec.path_control_points - self.boundary.fixed_at_goal)

    def mixed_rate(self, mixture: float) -> Array:
        """Choose r so that the phase is a mixture of arc length and time, shape (1, R).

        Every control point is the mean of ds/dt around its Greville abscissa, so all
        are positive.
        """
        time = self.t / self.duration
        length = np.append(
            0.0, np.cumsum(np.linalg.norm(np.diff(self.q, axis=0), axis=1))
        )
        s = time + mixture * (length / length[-1] - time) if length[-1] > 0 else time
        # Mean rate around each Greville abscissa: (change of phase) / (time that
        # passes).
        points = self.spec.rate_control_points
        degree = self.spec.degree
        greville = sliding_window_view(
            clamped_knots(points, degree)[1:-1], degree
        ).mean(axis=1)
        half = 0.5 / (points - degree)
        low = np.clip(greville - half, 0, 1)
        high = np.clip(greville + half, 0, 1)
        passed = np.interp(high, s, self.t) - np.interp(low, s, self.t)
        return self._timed(((high - low) / passed)[None])

    def improved_rate(self, rate: Array) -> Array:
        """Minimize the squared errors over log r, starting from a rate of shape (1, R)."""
        from scipy.optimize import least_squares

        # log r keeps rates positive without constraints.
        first = np.log(rate[0])
        bounds = first - MAX_LOG_RATE_CHANGE, first + MAX_LOG_RATE_CHANGE
        solution = least_squares(
            self._residual, first, self._jacobian, bounds, ftol=1e-4, max_nfev=40
        )
        return self._timed(np.exp(solution.x)[None])

    def error(self, rate: Array) -> float:
        """Compute the maximum error at the samples [rad]."""
        return float(np.abs(self.path(rate).residual[: len(self.t)]).max())

    def path(self, rate: Array) -> _Path:
        """Fit the path for a rate of shape (1, R)."""
        points = self.spec.path_control_points
        degree = self.spec.degree
        # Phases of the samples follow from r: t(s) is its integral of 1 / r.
        s = self._motion(rate).phase_at(self.t[None])[0]
        smoothing = (
            PATH_SMOOTHNESS * np.sqrt(len(s)) * _third_derivative(points, degree)
        )
        rows = np.concatenate([basis(s, points, degree), smoothing])
        # Smoothing rows have the target 0: they decide where samples do not.
        target = np.concatenate([self.q, np.zeros((len(smoothing), self.q.shape[1]))])
        control = self._fixed(rate)[0]
        control[self.free] = np.linalg.lstsq(
            rows[:, self.free], target - rows @ control, rcond=None
        )[0]
        return _Path(s, rows, control, rows @ control - target)

    def _timed(self, rates: Array) -> Array:
        """Scale rates to the duration of the trajectory."""
        return scaled_to_duration(rates, self.duration, self.spec)

    def _motion(self, rates: Array) -> Motion:
        return Motion(
            np.zeros((len(rates), self.spec.path_control_points, 1)),
            rates,
            self.spec.degree,
        )

    def _fixed(self, rates: Array) -> Array:
        """Compute the boundary control points, with interior ones of zero, shape (N, C, n)."""
        interior = np.zeros((len(rates), self.free.stop - 3, self.q.shape[1]))
        return assemble(
            self.boundary[np.zeros(len(rates), int)], interior, rates, self.spec
        )

    def _residual(self, log_rate: Array) -> Array:
        """Compute the residuals of the best path, followed by those of the smoothness of r."""
        residual = self.path(self._timed(np.exp(log_rate)[None])).residual
        return np.concatenate(
            [
                residual.ravel(),
                _second_difference(len(self.t), len(log_rate)) @ log_rate,
            ]
        )

    def _jacobian(self, log_rate: Array) -> Array:
        """Differentiate the residuals without the derivative of the projection (Kaufman 1975)."""
        step = 1e-6
        rate = self._timed(np.exp(log_rate)[None])
        # One forward difference of log r per control point, all motions in one batch.
        others = self._timed(rate * np.exp(step * np.eye(len(log_rate))))
        path = self.path(rate)
        speed = self._motion(rate).at(path.s).rate[0]
        # A changed r moves the phase of each sample: ds = -r dt at equal times.
        # Of s at equal times, shape (R, K).
        shift = (self.t - self._motion(others).time_at(path.s)) * speed / step
        dp = (
            basis(path.s, self.spec.path_control_points, self.spec.degree, 1)
            @ path.control
        )
        changes = np.einsum(
            "kc,rcn->knr", path.rows, (self._fixed(others) - self._fixed(rate)) / step
        )
        changes[: len(self.t)] += dp[:, :, None] * shift.T[:, None]
        # Variable projection: without the part that a new path would remove (Kaufman
        # 1975).
        onto, _ = np.linalg.qr(path.rows[:, self.free])
        changes -= np.tensordot(onto, np.tensordot(onto, changes, (0, 0)), 1)
        return np.concatenate(
            [
                changes.reshape(-1, len(log_rate)),
                _second_difference(len(self.t), len(log_rate)),
            ]
        )


@cache
def _third_derivative(points: int, degree: int) -> Array:
    """Return rows of norm 1 that penalize p''': they select the smoothest path if the samples do not determine it."""
    rows = basis(chebyshev(4 * points), points, degree, 3)
    return rows / np.linalg.norm(rows, 2)


@cache
def _second_difference(samples: int, points: int) -> Array:
    """Return rows that penalize second differences of log r, where r and p are not determined separately."""
    return np.asarray(
        np.diff(np.eye(points), 2, axis=0) * (RATE_SMOOTHNESS * np.sqrt(samples))
    )
