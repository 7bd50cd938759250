"""The curves that samples resolve: an accurate interpolation with estimates of its error.

The estimate is the difference from a less accurate interpolation of the same samples.
In the first and the last spans a motion may change its acceleration faster than the
samples resolve: there, the errors include those of every motion within the acceleration
limits of the problem. Derivatives that the samples do not resolve have no bounds.
"""

import numpy as np

from cnpgen.addons.trajectories.curve_family import UNDEFINED, CurveFamily
from cnpgen.addons.trajectories.interpolate import data_of
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.smooth_curve import (
    END_SPANS,
    FEW_NEIGHBORS,
    NEIGHBORS,
    estimated_derivative,
)
from cnpgen.addons.trajectories.span_polynomials import (
    SpanPolynomials,
    hermite_polynomials,
    lagrange_polynomials,
)
from cnpgen.arrays import Array, Mask

# Samples that determine positions in a span, and fewer of them for the estimate of the
# error.
WINDOWS = 4, 3
# On the differences of two interpolations, by the number of given derivatives.
ERROR_FACTORS = 4.0, 2.0, 2.0
COMPARED_PHASES = np.linspace(0, 1, 9)  # of a span
# Of two estimates of resolved accelerations, relative to the limits.
MAX_DISAGREEMENT = 0.02
MAX_RESOLVED_ERROR = 0.2  # of accelerations, relative to the limits
MAX_UNRESOLVED_SHARE = 0.5  # of the spans, above which none is resolved
LIMIT_FACTOR = 1.05  # on the acceleration limits


def resolved_curves(
    trajectory: Trajectory, noise: Array, max_acceleration: Array
) -> CurveFamily:
    """Return the curves that samples with noise resolve.

    The noise is that of positions, velocities and accelerations, shape (3,);
    acceleration limits [rad/s^2], shape (n,), may be inf.
    """
    data = data_of(trajectory)
    accurate, other, chord = _interpolations(trajectory, data, noise)
    bounds = [
        # The difference of both interpolations estimates the error of the less accurate
        # one.
        ERROR_FACTORS[len(data) - 1]
        * _with_neighbors(_difference(accurate, other, order))
        for order in range(3)
    ]
    unresolved = _unresolved_spans(bounds[2], max_acceleration, ends=len(data) < 3)
    for order in (0, 1):
        within = _errors_within(accurate, chord, order, max_acceleration)
        bounds[order] = np.where(unresolved, within, bounds[order])
    bounds = [
        bound + accurate.noise_errors(order) for order, bound in enumerate(bounds)
    ]
    bounds[2][unresolved | (len(data) == 1)] = UNDEFINED
    bounds.append(np.full_like(bounds[0], UNDEFINED))
    return CurveFamily(trajectory.t, accurate.coefficients(), bounds, has_jerk=False)


def _interpolations(
    trajectory: Trajectory, data: list[Array], noise: Array
) -> tuple[SpanPolynomials, SpanPolynomials, SpanPolynomials]:
    """Return the accurate polynomials, others of the same samples, and a chord that bounded accelerations stay near."""
    h = np.diff(trajectory.t)
    # Limits of accelerations bound the distance of a motion from lines between
    # positions, or from cubics.
    chord = hermite_polynomials(h, data[:2], noise)
    if len(data) == 1:
        accurate, other = (
            lagrange_polynomials(trajectory.t, data[0], size, noise[0])
            for size in WINDOWS
        )
        return accurate, other, chord
    accelerations = (
        data[2] if len(data) == 3 else estimated_derivative(trajectory, 2, NEIGHBORS)
    )
    quintic = hermite_polynomials(h, [*data[:2], accelerations], noise)
    if len(data) == 2 and noise.any():
        # Which estimated accelerations amplify.
        return chord, quintic, chord
    return quintic, chord, chord


def _difference(one: SpanPolynomials, other: SpanPolynomials, order: int) -> Array:
    """Return the largest differences of a derivative in every span, shape (S, n)."""
    values = [each.values(order, COMPARED_PHASES) for each in (one, other)]
    return np.asarray(np.abs(values[0] - values[1]).max(axis=0))


def is_resolved(trajectory: Trajectory, max_acceleration: Array) -> bool:
    """Return whether samples with velocities resolve the accelerations but at the ends; limits [rad/s^2] may be inf."""
    if trajectory.dq is None or len(trajectory.t) < 2 * END_SPANS + 2:
        return False
    few = estimated_derivative(trajectory, 2, FEW_NEIGHBORS)
    accurate = (
        estimated_derivative(trajectory, 2, NEIGHBORS)
        if trajectory.ddq is None
        else trajectory.ddq
    )
    # A joint without a limit is compared with its own largest acceleration.
    scale = np.where(
        np.isfinite(max_acceleration), max_acceleration, np.abs(accurate).max(axis=0)
    )
    inner = slice(END_SPANS, -END_SPANS)
    return bool((np.abs(few - accurate)[inner] <= MAX_DISAGREEMENT * scale).all())


def _with_neighbors(errors: Array) -> Array:
    """Return the maxima of errors, shape (S, n), over every span and its neighbors."""
    padded = np.concatenate([errors[:1], errors, errors[-1:]])
    return np.asarray(np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:]))


def _unresolved_spans(errors: Array, max_acceleration: Array, *, ends: bool) -> Mask:
    """Return a mask of the spans with large errors of accelerations, and of those at the ends, shape (S, n)."""
    # The negation counts nan as unresolved. Without a limit, any error is too large.
    mask = ~(
        errors
        <= MAX_RESOLVED_ERROR
        * np.where(np.isfinite(max_acceleration), max_acceleration, 0.0)
    )
    if ends:
        mask[:END_SPANS] = mask[-END_SPANS:] = True
    mask = _with_neighbors(mask.astype(float)) > 0
    mask[:, mask.mean(axis=0) > MAX_UNRESOLVED_SHARE] = True
    return mask


def _errors_within(
    accurate: SpanPolynomials,
    chord: SpanPolynomials,
    order: int,
    max_acceleration: Array,
) -> Array:
    """Bound the differences of motions within acceleration limits from polynomials, shape (S, n).

    A function that is zero at both ends of a span of length h, and whose second
    derivative is at most B, is at most B h^2 / 8, and its derivative B h / 2. They are
    B h^2 / 16 and B h / 4 if its derivative is zero there, too.
    """
    h = accurate.h[:, None]
    limit = np.where(
        np.isfinite(max_acceleration), LIMIT_FACTOR * max_acceleration, UNDEFINED
    )
    # Motion and chord agree at both ends. The second derivative of their difference is
    # at most B, the limit plus the acceleration of the chord.
    largest = limit + np.abs(chord.values(2, COMPARED_PHASES)).max(axis=0)
    # A chord through velocities, too, agrees in the derivative at both ends.
    share = 0.5 if len(chord.orders) > 2 else 1.0
    free = share * largest * (h**2 / 8 if order == 0 else h / 2)
    # Triangle inequality: from the polynomial to the chord, and to the motion.
    return np.asarray(_difference(accurate, chord, order) + free)
