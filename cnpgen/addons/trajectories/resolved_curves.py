"""The curves that samples resolve: an accurate interpolation with estimates of its error.

The estimate is the difference from a less accurate interpolation of the same samples.
In the first and the last spans a motion may change its acceleration faster than the
samples resolve: there, the errors include those of every motion within the acceleration
limits of the problem. Derivatives that the samples do not resolve have no bounds.
"""

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from cnpgen.addons.trajectories.curve_family import UNDEFINED, CurveFamily
from cnpgen.addons.trajectories.interpolate import (
    data_of,
    differentiated,
    hermite_weights,
    polynomials_of_positions,
    span_data,
)
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.smooth_curve import (
    END_SPANS,
    FEW_NEIGHBORS,
    NEIGHBORS,
    estimated_derivative,
)
from cnpgen.arrays import Array

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


@dataclass(frozen=True, eq=False)
class _Polynomials:
    """Polynomials of positions in S spans."""

    # Weights of the data for the Bernstein coefficients, shape (S, d + 1, W).

    weights: Array
    data: Array  # data of the spans, scaled by powers of their lengths, shape (S, W, n)
    noise: Array  # largest errors of the data, shape (S, W)
    h: Array  # lengths of the spans [s], shape (S,)

    def values(self, order: int) -> Array:
        """Return a derivative by time at the compared phases of all spans, shape (phases, S, n)."""
        coefficients = np.einsum(
            "scw,swn->csn", differentiated(self.weights, order), self.data
        )
        # Basis polynomials B_k(u) = C(d, k) u^k (1 - u)^(d - k).
        degree = len(coefficients) - 1
        u = COMPARED_PHASES[:, None]
        k = np.arange(degree + 1)
        basis = (
            np.array([comb(degree, each) for each in k])
            * u**k
            * (1 - u) ** (degree - k)
        )
        return np.asarray(
            np.einsum("pc,csn->psn", basis, coefficients) / self.h[:, None] ** order
        )

    def noise_errors(self, order: int) -> Array:
        """Bound the effect of noise on a derivative, shape (S, 1)."""
        weights = np.abs(differentiated(self.weights, order))
        return np.asarray(
            (np.einsum("scw,sw->sc", weights, self.noise).max(axis=1) / self.h**order)[
                :, None
            ]
        )


def resolved_curves(
    trajectory: Trajectory, noise: Array, max_acceleration: Array
) -> CurveFamily:
    """Return the curves that samples with noise resolve.

    The noise is that of positions, velocities and accelerations, shape (3,);
    acceleration limits [rad/s^2], shape (n,), may be inf.
    """
    t = trajectory.t
    data = data_of(trajectory)
    h = np.diff(t)
    if len(data) == 1:
        accurate, other = (
            _through_positions(trajectory, size, noise) for size in WINDOWS
        )
        # Limits of accelerations bound the distance of a motion from lines between
        # positions.
        chord = _hermite(h, data[:1], noise)
    else:
        accelerations = (
            data[2]
            if len(data) == 3
            else estimated_derivative(trajectory, 2, NEIGHBORS)
        )
        accurate = _hermite(h, [*data[:2], accelerations], noise)
        other = chord = _hermite(h, data[:2], noise)
        if len(data) == 2 and noise.any():
            # Which estimated accelerations amplify.
            accurate, other = chord, accurate
    resolution = [
        # The difference of both interpolations estimates the error of the less accurate
        # one.
        np.abs(accurate.values(order) - other.values(order)).max(axis=0)
        for order in range(3)
    ]
    bounds = [
        ERROR_FACTORS[len(data) - 1] * _with_neighbors(error) for error in resolution
    ]
    unresolved = _unresolved_spans(bounds[2], max_acceleration, ends=len(data) < 3)
    for order in (0, 1):
        bounds[order] = np.where(
            unresolved,
            _errors_within(accurate, chord, order, max_acceleration),
            bounds[order],
        )
    bounds = [
        bound + accurate.noise_errors(order) for order, bound in enumerate(bounds)
    ]
    bounds[2][unresolved | (len(data) == 1)] = UNDEFINED
    coefficients = np.einsum("scw,swn->csn", accurate.weights, accurate.data)
    exact_ends = (bounds[0], bounds[1], bounds[2], np.full_like(bounds[0], UNDEFINED))
    return CurveFamily(t, coefficients, exact_ends, has_jerk=False)


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


def _through_positions(trajectory: Trajectory, size: int, noise: Array) -> _Polynomials:
    """Return polynomials through the positions around every span."""
    _, weights, data = polynomials_of_positions(trajectory.t, trajectory.q, size)
    return _Polynomials(
        weights, data, np.full(data.shape[:2], noise[0]), np.diff(trajectory.t)
    )


def _hermite(h: Array, data: list[Array], noise: Array) -> _Polynomials:
    """Return polynomials through derivatives at both ends of every span."""
    weights = hermite_weights(len(data))
    orders = np.tile(np.arange(len(data)), 2)
    scaled = np.asarray(noise)[orders] * h[:, None] ** orders
    return _Polynomials(
        np.broadcast_to(weights, (len(h), *weights.shape)),
        span_data(data, h),
        scaled,
        h,
    )


def _with_neighbors(errors: Array) -> Array:
    """Return the maxima of errors, shape (S, n), over every span and its neighbors."""
    padded = np.concatenate([errors[:1], errors, errors[-1:]])
    return np.asarray(np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:]))


def _unresolved_spans(
    errors: Array, max_acceleration: Array, *, ends: bool
) -> NDArray[np.bool_]:
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
    return np.asarray(mask)


def _errors_within(
    accurate: _Polynomials, chord: _Polynomials, order: int, max_acceleration: Array
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
    largest = limit + np.abs(chord.values(2)).max(axis=0)
    # A chord through velocities, too, agrees in the derivative at both ends.
    share = 0.5 if chord.weights.shape[2] > 2 else 1.0
    free = share * largest * (h**2 / 8 if order == 0 else h / 2)
    # Triangle inequality: from the polynomial to the chord, and to the motion.
    return np.asarray(
        np.abs(accurate.values(order) - chord.values(order)).max(axis=0) + free
    )
