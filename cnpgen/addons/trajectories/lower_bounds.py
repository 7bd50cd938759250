"""Lower bounds of velocities, accelerations and jerks of every curve through samples.

A divided difference of positions is a weighted mean of a derivative (Peano 1913; de
Boor, A Practical Guide to Splines, ch. I). The derivative reaches its mean somewhere,
so the mean bounds the supremum from below and the infimum from above. Errors of the
samples widen the mean to an interval. A fault of length T shows best at a distance near
T, and the effect of noise falls with the distance, so several distances are used.

Samples y_k at times t_k have errors of at most e, and belong to a time within d of t_k.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array

LAGS = (1, 2, 4, 8, 16, 32, 64)  # distances in samples
ROUNDING = 8 * float(np.finfo(float).eps)  # relative error of positions in memory


@dataclass(frozen=True, eq=False)
class MeanDerivatives:
    """Intervals of means of a derivative: its supremum is at least ``low``, its infimum at most ``high``.

    Attributes:
        low: Smallest possible means in SI units, shape (M, n).
        high: Largest possible means, shape (M, n).
        t: Midpoint of the time of each mean [s], shape (M,).
    """

    low: Array
    high: Array
    t: Array


def with_rounding(values: Array, error: float) -> float:
    """Add the rounding of values in memory, shape (K, n), to their error."""
    return error + ROUNDING * float(np.abs(values).max(initial=0.0))


def value_intervals(t: Array, y: Array, error: float) -> Iterator[MeanDerivatives]:
    """Yield the intervals of the samples themselves."""
    e = with_rounding(y, error)
    yield MeanDerivatives(y - e, y + e, t)


def first_derivatives(
    t: Array, y: Array, error: float, jitter: float = 0.0
) -> Iterator[MeanDerivatives]:
    """Yield mean first derivatives between samples (mean value theorem).

    With D = y_j - y_i and h = t_j - t_i, the mean lies in [(D - 2 e) / (h + 2 d), (D + 2
    e) / (h - 2 d)] for D > 0, and accordingly for other signs.
    """
    e = with_rounding(y, error)
    for lag in _lags(len(t), 1):
        low, high = _mean_intervals(t, y, lag, e, jitter)
        yield MeanDerivatives(low, high, (t[lag:] + t[:-lag]) / 2)


def swing_velocities(
    t: Array, y: Array, error: float, jitter: float
) -> Iterator[MeanDerivatives]:
    """Yield bounds of |dy/dt| of curves that move to and fro over two spans.

    The way |D_1| + |D_2| - 4 e takes at most h_1 + h_2 + 2 d: the time in the middle
    counts once, so the jitter lowers the bound less than that of either span.
    """
    e = with_rounding(y, error)
    for lag in _lags(len(t), 2):
        change = np.abs(y[lag:] - y[:-lag])
        way = np.maximum(change[lag:] + change[:-lag] - 4 * e, 0.0)
        least = way / ((t[2 * lag :] - t[: -2 * lag])[:, None] + 2 * jitter)
        yield MeanDerivatives(least, -least, t[lag:-lag])


def second_derivatives(
    t: Array, y: Array, error: float, jitter: float = 0.0
) -> Iterator[MeanDerivatives]:
    """Yield mean second derivatives, with a hat over three samples as weight.

    The change of the mean derivative between both spans is the integral of the second
    derivative against a hat of area (t_2 - t_0) / 2. Without jitter this is twice the
    second divided difference with an error of 4 e / (h_1 h_2). If both spans may be
    shorter than the jitter, the order of the samples is unknown and nothing follows.
    """
    e = with_rounding(y, error)
    for lag in _lags(len(t), 2):
        low, high = _mean_intervals(t, y, lag, e, jitter)
        # The area of the hat over both spans.
        area = ((t[2 * lag :] - t[: -2 * lag]) / 2)[:, None]
        least = low[lag:] - high[:-lag]
        most = high[lag:] - low[:-lag]
        # A larger area makes the mean smaller, but never changes its sign.
        large = area + jitter
        small = np.maximum(area - jitter, 1e-300)
        with np.errstate(over="ignore"):
            least = np.where(least > 0, least / large, least / small)
            most = np.where(most < 0, most / large, most / small)
        h = t[lag:] - t[:-lag]
        ordered = ((h[lag:] > 2 * jitter) & (h[:-lag] > 2 * jitter))[:, None]
        yield MeanDerivatives(
            np.where(ordered, least, -np.inf),
            np.where(ordered, most, np.inf),
            t[lag:-lag],
        )


def third_derivatives(t: Array, y: Array, error: float) -> Iterator[MeanDerivatives]:
    """Yield mean third derivatives: six times the third divided differences of four samples.

    The weight of sample i is w_i = 6 / prod_j (t_i - t_j), and the error e sum |w_i|.
    """
    e = with_rounding(y, error)
    for lag in _lags(len(t), 3):
        count = len(t) - 3 * lag
        x = np.stack([t[k * lag :][:count] for k in range(4)])
        parts = np.stack([y[k * lag :][:count] for k in range(4)])
        # The identity replaces the distance of a sample from itself by a factor of 1.
        distances = x[:, None] - x[None] + np.eye(4)[..., None]
        weights = 6 / distances.prod(axis=1)
        mean = np.einsum("km,kmn->mn", weights, parts)
        width = e * np.abs(weights).sum(axis=0)[:, None]
        yield MeanDerivatives(mean - width, mean + width, (x[1] + x[2]) / 2)


def second_derivatives_with_velocities(
    t: Array, q: Array, dq: Array, errors: tuple[Array | float, Array | float]
) -> Iterator[MeanDerivatives]:
    """Yield bounds of |ddq| of curves through positions and velocities at both ends of spans.

    A curve with |ddq| <= A exists between two samples if and only if m <= A h^2 / 4 -
    c^2 / (4 A), where m = |q_j - q_i - h (dq_i + dq_j) / 2| and c = |dq_j - dq_i|. The
    smallest such A is (2 m + sqrt(4 m^2 + h^2 c^2)) / h^2. Errors lower m by 2 e + h e_v
    and c by 2 e_v. The errors are those of positions and velocities, shape (n,) or one
    number.
    """
    e, e_v = (
        np.asarray(error) + ROUNDING * float(np.abs(values).max(initial=0.0))
        for error, values in zip(errors, (q, dq), strict=True)
    )
    for lag in _lags(len(t), 1):
        h = (t[lag:] - t[:-lag])[:, None]
        missing = q[lag:] - q[:-lag] - h * (dq[lag:] + dq[:-lag]) / 2
        # What a motion with linear velocity between both samples lacks.
        m = np.maximum(np.abs(missing) - 2 * e - h * e_v, 0.0)
        c = np.maximum(np.abs(dq[lag:] - dq[:-lag]) - 2 * e_v, 0.0)
        least = (2 * m + np.sqrt(4 * m**2 + (h * c) ** 2)) / h**2
        # The bound is one of |ddq|, whose sign is unknown: it holds for both signs.
        yield MeanDerivatives(least, -least, (t[lag:] + t[:-lag]) / 2)


def _lags(count: int, spans: int) -> Iterator[int]:
    """Yield the distances at which some samples of a number of equal spans exist."""
    return (lag for lag in LAGS if spans * lag < count)


def _mean_intervals(
    t: Array, y: Array, lag: int, error: float, jitter: float
) -> tuple[Array, Array]:
    """Return the interval of the mean derivative between samples at a distance, shape (M, n) each."""
    h = (t[lag:] - t[:-lag])[:, None]
    change = y[lag:] - y[:-lag]
    low = change - 2 * error
    high = change + 2 * error
    largest = h + 2 * jitter
    smallest = np.maximum(h - 2 * jitter, 1e-300)
    # A change is smallest per time over the longest possible time, but its sign decides
    # which time that is.
    with np.errstate(over="ignore"):
        return (
            np.where(low >= 0, low / largest, low / smallest),
            np.where(high >= 0, high / smallest, high / largest),
        )
