"""Time-sampled trajectories of other planners: checks, resampling, and estimation of their boundary conditions."""

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.schema.arguments import numbers
from cnpgen.trajectory.boundary import Boundary

# Of times, positions and velocities in SI units; powers of larger ones overflow.
MAX_SAMPLE = 1e9
# Of trajectories; derivatives of shorter ones overflow.
MIN_SAMPLED_DURATION_S = 1e-9
# Fewer samples are resampled from the cubic through positions and velocities.
MIN_DENSE_SAMPLES = 400
# Samples at each end for estimating velocity and acceleration.
WINDOWS = (
    5,
    8,
    12,
    18,
    27,
    40,
    60,
    90,
    135,
    200,
)
# Of the mean speed: smaller velocities are 0; accelerations: ten times, per duration.
MAX_REST_SPEED_RATIO = 2e-3


def checked_samples(
    t: ArrayLike, q: ArrayLike, dq: ArrayLike | None
) -> tuple[Array, Array, Array | None]:
    """Return times (K,) [s], positions and velocities (K, n) of one trajectory as arrays of float64.

    Raises:
        UsageError: A shape is wrong, the times do not increase, or a value is not
            finite.
    """
    times = numbers("t", t)
    positions = numbers("q", q)
    velocities = None if dq is None else numbers("dq", dq)
    if (
        times.ndim != 1
        or positions.ndim != 2
        or len(positions) != len(times)
        or not positions.shape[1]
    ):
        raise UsageError(
            f"must have shape (K,) and q shape (K, n), got {times.shape} and {positions.shape}",
            argument="t",
        )
    if velocities is not None and velocities.shape != positions.shape:
        raise UsageError(
            f"must have the shape of q, {positions.shape}, got {velocities.shape}",
            argument="dq",
        )
    if len(times) < 2:
        raise UsageError(
            f"a trajectory needs at least 2 samples, got {len(times)}", concerns="t"
        )
    for name, values in (("t", times), ("q", positions), ("dq", velocities)):
        if values is not None:
            _check_values(name, values)
    _check_times(times)
    return times, positions, velocities


def _check_values(name: str, values: Array) -> None:
    """Raise UsageError if a value is not finite, or so large that products overflow."""
    if not np.isfinite(values).all():
        index = int(np.argmin(np.isfinite(values).reshape(len(values), -1).all(axis=1)))
        raise UsageError(
            f"must be finite, got {values[index]} in sample {index}", argument=name
        )
    if np.abs(values).max() > MAX_SAMPLE:
        raise UsageError(
            f"must be at most {MAX_SAMPLE:g}, got {np.abs(values).max():g}",
            argument=name,
        )


def _check_times(times: Array) -> None:
    """Raise UsageError if times do not increase, or last too short for derivatives."""
    # A decreasing time is reported as such, not as a short duration.
    if not (
        times[-1] - times[0] >= MIN_SAMPLED_DURATION_S or np.any(np.diff(times) <= 0)
    ):
        raise UsageError(
            f"must last at least {MIN_SAMPLED_DURATION_S:g} s, got {times[-1] - times[0]:g} s",
            argument="t",
        )
    if np.any(np.diff(times) <= 0):
        index = int(np.argmin(np.diff(times) > 0))
        raise UsageError(
            f"must increase, got {times[index]} s in sample {index}, then {times[index + 1]} s",
            argument="t",
        )


def resampled(t: Array, q: Array, dq: Array | None) -> tuple[Array, Array]:
    """Return times and positions, resampled by cubic Hermite interpolation if they are sparse and have velocities."""
    if dq is None or len(t) >= MIN_DENSE_SAMPLES:
        return t, q
    from scipy.interpolate import CubicHermiteSpline

    # At least ``MIN_DENSE_SAMPLES`` in all, the same number in every interval.
    between = np.linspace(0, 1, -(-MIN_DENSE_SAMPLES // (len(t) - 1)), endpoint=False)
    finer = np.append(t[:-1, None] + np.diff(t)[:, None] * between, t[-1])
    return finer, CubicHermiteSpline(t, q, dq)(finer)


def sampled_boundary(
    t: ArrayLike, q: ArrayLike, dq: ArrayLike | None = None
) -> Boundary:
    """Estimate the boundary conditions of one trajectory from its samples.

    Positions, and velocities if they are passed, are those of the first and the last
    sample. Other derivatives are those of cubics through the samples next to the ends;
    negligible values are set to zero.

    Args:
        t: Times [s], shape (K,).
        q: Joint positions [rad], shape (K, n).
        dq: Joint velocities [rad/s], shape (K, n), or None.

    Returns:
        Boundary conditions of one motion with a free goal acceleration.

    Raises:
        UsageError: A shape is wrong, the times do not increase, or a value is not
            finite.
    """
    times, positions, velocities = checked_samples(t, q, dq)
    times, path = resampled(times - times[0], positions, velocities)
    first, last = (
        (None, None) if velocities is None else (velocities[0], -velocities[-1])
    )
    start_dq, start_ddq = _derivatives(times, path, first)
    # Reversed in time, the goal is a start with the opposite velocity.
    goal_dq, _ = _derivatives(times[-1] - times[::-1], path[::-1], last)
    return Boundary(
        *(part[None] for part in (path[0], start_dq, start_ddq, path[-1], -goal_dq))
    )


def _derivatives(t: Array, q: Array, velocity: Array | None) -> tuple[Array, Array]:
    """Estimate the velocity, unless it is known, and the acceleration at t = 0."""
    # Smaller velocities are noise of a robot at rest.
    min_speed = MAX_REST_SPEED_RATIO * np.abs(q[-1] - q[0]).max() / t[-1]
    travel = q[1:] - q[0]
    first = 1
    if velocity is None:
        velocity = _cubic(t[1:], travel, first)
        velocity = np.where(np.abs(velocity) < min_speed, 0.0, velocity)
    if len(t) < 3:
        return velocity, np.zeros_like(velocity)
    # Without the part that the velocity explains, the travel begins with t^2.
    travel = travel - velocity * t[1:, None]
    first = 2
    acceleration = 2 * _cubic(t[1:], travel, first)
    return velocity, np.where(
        np.abs(acceleration) < 10 * min_speed / t[-1], 0.0, acceleration
    )


def _cubic(t: Array, travel: Array, first: int) -> Array:
    """Fit a cubic without powers below t^first to the first samples; return its coefficient of t^first, shape (n,).

    A wide window averages noise, a narrow one follows the motion: the window with the
    smallest estimated standard error is chosen.
    """
    widths = [
        min(width, len(t)) for width in WINDOWS if width <= max(len(t) // 5, WINDOWS[0])
    ]
    best = np.inf, np.zeros(travel.shape[1])
    for width in widths:
        # Powers of t / t_max: well conditioned for any unit of time.
        powers = (t[:width, None] / t[width - 1]) ** np.arange(first, min(width, 3) + 1)
        inverse = np.linalg.pinv(powers)
        coefficients = inverse @ travel[:width]
        freedom = max(width - powers.shape[1], 1)
        variance = np.sum((powers @ coefficients - travel[:width]) ** 2) / freedom
        # Standard error of the first coefficient: residual variance times the row of
        # the pseudoinverse.
        error = np.sqrt(variance * np.sum(inverse[0] ** 2)) / t[width - 1] ** first
        if error < best[0]:
            best = error, coefficients[0] / t[width - 1] ** first
    return best[1]
