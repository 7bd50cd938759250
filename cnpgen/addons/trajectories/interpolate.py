"""Families of curves through samples: a stated interpolation, or every curve whose jerk is bounded."""

from __future__ import annotations

from typing import Literal

import numpy as np

from cnpgen.addons.trajectories.curve_family import UNDEFINED, CurveFamily
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.span_polynomials import (
    SpanPolynomials,
    hermite_polynomials,
    lagrange_polynomials,
)
from cnpgen.arrays import Array, Indices
from cnpgen.errors import UsageError

Interpolation = Literal["hold", "linear", "cubic", "quintic"]

INTERPOLATIONS = ("hold", "linear", "cubic", "quintic")
# That the data must have.
_DERIVATIVES = {
    "hold": 0,
    "linear": 0,
    "cubic": 1,
    "quintic": 2,
}
STENCIL = 4  # samples around a span, for positions alone
CONSISTENCY_TOLERANCE = 1e-6  # relative, of samples with a bound of the jerk: rounding


def interpolated(
    trajectory: Trajectory, interpolation: Interpolation | None, noise: Array
) -> CurveFamily:
    """Return the curves of an interpolation, by default the one that the derivatives determine, through samples.

    Positions, velocities and accelerations have errors of at most the noise, shape
    (3,). If the samples lack the derivatives of the interpolation, UsageError is
    raised.
    """
    data = data_of(trajectory)
    kind = interpolation or INTERPOLATIONS[len(data)]
    if _DERIVATIVES[kind] >= len(data):
        missing = "velocities" if len(data) == 1 else "accelerations"
        raise UsageError(
            f"{kind} interpolation needs samples with {missing}",
            concerns="interpolation",
        )
    data = data[: _DERIVATIVES[kind] + 1]
    polynomials = hermite_polynomials(np.diff(trajectory.t), data, noise)
    joints = trajectory.q.shape[1]
    # Derivatives of higher orders than the data jump at the knots.
    bounds = [
        np.repeat(polynomials.noise_errors(order), joints, axis=1)
        if order <= len(data)
        else np.full((len(polynomials.h), joints), UNDEFINED)
        for order in range(4)
    ]
    if kind == "hold":
        # A held position jumps at the next sample: the error covers the jump.
        bounds[0] += np.abs(np.diff(trajectory.q, axis=0))
        bounds[1:] = [np.full_like(bounds[0], UNDEFINED)] * 3
    return CurveFamily(trajectory.t, polynomials.coefficients(), bounds)


def family_of_data(t: Array, data: list[Array]) -> CurveFamily:
    """Return the known curve through positions and derivatives at times from 0 [s], shape (S + 1, n) each."""
    return _known(t, hermite_polynomials(np.diff(t), data, np.zeros(len(data))))


def through_positions(trajectory: Trajectory, neighbors: int) -> CurveFamily:
    """Return the curve of polynomials through the positions around every span.

    Its velocities jump at the samples.
    """
    t = trajectory.t
    return _known(t, lagrange_polynomials(t, trajectory.q, neighbors))


def _known(t: Array, polynomials: SpanPolynomials) -> CurveFamily:
    coefficients = polynomials.coefficients()
    return CurveFamily(t, coefficients, [np.zeros(coefficients.shape[1:])] * 4)


def bounded_jerk(
    trajectory: Trajectory, max_jerk: Array, noise: Array
) -> CurveFamily | None:
    """Return all curves through samples with noise whose jerks are bounded; None if the samples contradict the bound.

    Bounds of the jerks [rad/s^3] have shape (n,), the largest errors of positions,
    velocities and accelerations (3,). Fewer than three samples with positions alone
    raise UsageError.
    """
    data = data_of(trajectory)
    t = trajectory.t
    if len(data) > 1:
        polynomials = hermite_polynomials(np.diff(t), data, noise)
    elif len(t) < STENCIL - 1:
        raise UsageError(
            "a bound of the jerk needs at least 3 samples of positions",
            concerns="max_jerk",
        )
    else:
        # Dense samples of positions alone amplify noise: fewer of them bound
        # derivatives better.
        error = float(noise[0])
        chosen = _thinned(t, float(max_jerk.min()), error)
        t = t[chosen]
        polynomials = lagrange_polynomials(t, trajectory.q[chosen], STENCIL, error)
    h = polynomials.h[:, None]
    # Let |jerk| <= J. With u as unit of time, a curve differs from its polynomial by at
    # most the integral of the absolute kernel times J h^3. Its own jerk is anywhere
    # within the bound: the nominal value is 0.
    bounds = [
        polynomials.kernel_norms(order)[:, None] * h ** (3 - order) * max_jerk
        + polynomials.noise_errors(order)
        for order in range(3)
    ]
    bounds.append(np.repeat(max_jerk[None], len(h), axis=0))
    if not _is_consistent(polynomials, data, max_jerk, noise):
        return None
    return CurveFamily(t, polynomials.coefficients(), bounds, has_jerk=False)


def data_of(trajectory: Trajectory) -> list[Array]:
    """Return the positions and the derivatives that there are, shape (K, n) each."""
    return [
        values
        for values in (trajectory.q, trajectory.dq, trajectory.ddq)
        if values is not None
    ]


def _thinned(t: Array, max_jerk: float, noise: float) -> Indices:
    """Choose samples whose distance minimizes the error of velocities: noise / h grows where max_jerk h^2 falls."""
    # Central differences of positions have an error of e / h + J h^2 / 6, smallest at h
    # = (3 e / J)^(1/3).
    best = (3 * noise / max_jerk) ** (1 / 3) if max_jerk > 0 else t[-1]
    steps = max(STENCIL, int(np.ceil(t[-1] / max(best, t[-1] / (len(t) - 1)))))
    return np.unique(np.linspace(0, len(t) - 1, steps + 1).round().astype(np.intp))


def _is_consistent(
    polynomials: SpanPolynomials, data: list[Array], max_jerk: Array, noise: Array
) -> bool:
    """Return whether a curve with bounded jerks can pass through the samples: a necessary condition.

    The third derivative of a cubic through data is a mean of the jerks of every curve
    through the data. Accelerations of samples change by at most the bound times the
    time between them.
    """
    h = polynomials.h[:, None]
    limit = max_jerk * (1 + CONSISTENCY_TOLERANCE)
    # Third differences amplify the rounding of coefficients.
    rounding = 1e-12 * (np.abs(polynomials.coefficients()).max() + 1)
    if len(data) == 3:
        change = np.abs(np.diff(data[2], axis=0))
        return bool((change <= limit * h + 2 * noise[2] + rounding).all())
    # Fewer data than these determine no cubic, so its third derivative says nothing.
    if polynomials.nodes.shape[1] < STENCIL:
        return True
    jerk = np.abs(polynomials.coefficients(3)[0] / h**3)
    from_noise = polynomials.noise_errors(3) + 8 * rounding / h**3
    return bool((jerk <= limit + from_noise).all())
