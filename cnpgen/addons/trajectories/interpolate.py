"""Families of curves through samples: a stated interpolation, or every curve whose jerk is bounded.

Both begin with weights that map the data of a span to the Bernstein coefficients of its
nominal polynomial. Noise of the data changes a derivative by at most the sum of the
absolute weights. The difference between a polynomial and another curve through the same
data is an integral of the curve's jerk against a kernel (Peano 1913), so a bound of the
jerk bounds it.
"""

from dataclasses import replace
from math import comb, factorial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cnpgen.addons.trajectories.curve_family import UNDEFINED, CurveFamily
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
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
KERNEL_NODES = 240  # of the integral over a kernel
KERNEL_PHASES = 9  # in a span, at which the integral is evaluated
KERNEL_MARGIN = 1.05  # factor on the integral, for phases and nodes between
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
    h = np.diff(trajectory.t)
    weights = hermite_weights(len(data))
    # Coefficients b = W d of every span, with data d for a span of length 1.
    coefficients = np.einsum("cw,swn->csn", weights, span_data(data, h))
    orders = np.tile(np.arange(len(data)), 2)
    # With u = (t - t_i) / h, a derivative of order k by u is h^k times that by t.
    scaled_noise = noise[orders] * h[:, None] ** orders
    # Errors e of the data change a coefficient by at most sum |w| e. Values of the
    # polynomial change by no more than its coefficients (convex hull).
    effects = [
        scaled_noise @ np.abs(differentiated(weights, order)).T for order in range(4)
    ]
    errors = [effect.max(axis=1) / h**order for order, effect in enumerate(effects)]
    bounds = [
        np.repeat(error[:, None], trajectory.q.shape[1], axis=1) for error in errors
    ]
    # Derivatives that jump at the knots.
    for order in range(len(data) + 1, 4):
        bounds[order] = np.full_like(bounds[order], UNDEFINED)
    if kind == "hold":
        # A held position jumps at the next sample: the error covers the jump.
        bounds[0] = bounds[0] + np.abs(np.diff(trajectory.q, axis=0))
        bounds[1] = bounds[2] = bounds[3] = np.full_like(bounds[0], UNDEFINED)
    return CurveFamily(
        trajectory.t, coefficients, (bounds[0], bounds[1], bounds[2], bounds[3])
    )


def family_of_data(t: Array, data: list[Array]) -> CurveFamily:
    """Return the known curve through positions and derivatives at times from 0 [s], shape (S + 1, n) each."""
    return _known(
        t,
        np.einsum(
            "cw,swn->csn", hermite_weights(len(data)), span_data(data, np.diff(t))
        ),
    )


def through_positions(trajectory: Trajectory, neighbors: int) -> CurveFamily:
    """Return the curve of polynomials through the positions around every span.

    Its velocities jump at the samples.
    """
    _, weights, data = polynomials_of_positions(trajectory.t, trajectory.q, neighbors)
    return _known(trajectory.t, np.einsum("scw,swn->csn", weights, data))


def _known(t: Array, coefficients: Array) -> CurveFamily:
    exact = np.zeros(coefficients.shape[1:])
    return CurveFamily(t, coefficients, (exact, exact, exact, exact))


def bounded_jerk(
    trajectory: Trajectory, max_jerk: Array, noise: Array
) -> CurveFamily | None:
    """Return all curves through samples with noise whose jerks are bounded; None if the samples contradict the bound.

    Bounds of the jerks [rad/s^3] have shape (n,), the largest errors of positions,
    velocities and accelerations (3,). Fewer than three samples with positions alone
    raise UsageError.
    """
    data = data_of(trajectory)
    if len(data) == 1:
        if len(trajectory.t) < STENCIL - 1:
            raise UsageError(
                "a bound of the jerk needs at least 3 samples of positions",
                concerns="max_jerk",
            )
        # Dense samples of positions alone amplify noise: fewer of them bound
        # derivatives better.
        chosen = _thinned(trajectory.t, float(max_jerk.min()), float(noise[0]))
        t = trajectory.t[chosen]
        data = [trajectory.q[chosen]]
        h = np.diff(t)
        nodes, weights, of_data = polynomials_of_positions(t, data[0], STENCIL)
        orders = np.zeros(nodes.shape[1], np.intp)
    else:
        t = trajectory.t
        h = np.diff(t)
        orders = np.tile(np.arange(len(data)), 2)
        # Data of both ends are at the phases 0 and 1.
        nodes = np.broadcast_to(
            np.repeat([0.0, 1.0], len(data)), (len(h), 2 * len(data))
        )
        weights = np.broadcast_to(
            hermite_weights(len(data)), (len(h), 2 * len(data), 2 * len(data))
        )
        of_data = span_data(data, h)
    coefficients = np.einsum("scw,swn->csn", weights, of_data)
    scaled_noise = np.asarray(noise)[orders] * h[:, None] ** orders
    bounds = []
    for order in range(3):
        kernel = _kernel_norms(nodes, orders, weights, order)
        from_noise = (
            np.abs(differentiated(weights, order) * scaled_noise[:, None])
            .sum(axis=2)
            .max(axis=1)
        )
        # Let |jerk| <= J. With u as unit of time, a curve differs from its polynomial
        # by at most the integral of the absolute kernel times J h^3.
        error = (kernel * h**3)[:, None] * max_jerk + from_noise[:, None]
        bounds.append(error / h[:, None] ** order)
    family = CurveFamily(
        t, coefficients, (bounds[0], bounds[1], bounds[2], np.zeros_like(bounds[0]))
    )
    if not _is_consistent(family, weights, scaled_noise, data, max_jerk, noise):
        return None
    # The jerk of a curve is anywhere within the bound: its nominal value is 0.
    wide = np.repeat(max_jerk[None], len(h), axis=0)
    return replace(family, bounds=(*family.bounds[:3], wide), has_jerk=False)


def data_of(trajectory: Trajectory) -> list[Array]:
    """Return the positions and the derivatives that there are, shape (K, n) each."""
    return [
        values
        for values in (trajectory.q, trajectory.dq, trajectory.ddq)
        if values is not None
    ]


def _thinned(t: Array, max_jerk: float, noise: float) -> NDArray[np.intp]:
    """Choose samples whose distance minimizes the error of velocities: noise / h grows where max_jerk h^2 falls."""
    # Central differences of positions have an error of e / h + J h^2 / 6, smallest at h
    # = (3 e / J)^(1/3).
    best = (3 * noise / max_jerk) ** (1 / 3) if max_jerk > 0 else t[-1]
    steps = max(STENCIL, int(np.ceil(t[-1] / max(best, t[-1] / (len(t) - 1)))))
    return np.unique(np.linspace(0, len(t) - 1, steps + 1).round().astype(np.intp))


def span_data(data: list[Array], h: Array) -> Array:
    """Return the scaled data of both ends of every span, shape (S, 2 m, n)."""
    scaled = [
        [
            values[end:][: len(h)] * h[:, None] ** order
            for order, values in enumerate(data)
        ]
        for end in (0, 1)
    ]
    return np.stack([*scaled[0], *scaled[1]], axis=1)


def polynomials_of_positions(
    t: Array, q: Array, neighbors: int
) -> tuple[Array, Array, Array]:
    """Return polynomials through K positions [rad], shape (K, n), around every span between times [s], shape (K,).

    At most W neighbors determine each. The results are nodes, where the span is [0, 1],
    shape (S, W), weights of the positions for the Bernstein coefficients, shape (S, W,
    W), and the positions, shape (S, W, n).
    """
    size = min(neighbors, len(t))
    count = len(t) - 1
    # The span is in the middle of its window, but at both ends of the samples.
    first = np.clip(np.arange(count) - (size // 2 - 1), 0, len(t) - size)
    window = first[:, None] + np.arange(size)
    nodes = (t[window] - t[:-1, None]) / np.diff(t)[:, None]
    return nodes, _lagrange_weights(nodes), q[window]


def hermite_weights(m: int) -> Array:
    """Return weights from m derivatives at both ends to Bernstein coefficients on [0, 1], shape (2 m, 2 m)."""
    degree = 2 * m - 1
    weights = np.zeros((2 * m, 2 * m))
    # The k-th coefficient from an end is a sum of its derivatives.
    for k in range(m):
        for order in range(k + 1):
            # b_k = sum_j C(k, j) (d - j)! / d! f^(j)(0), with the degree d.
            share = comb(k, order) * factorial(degree - order) / factorial(degree)
            weights[k, order] = share
            # From the other end, the phase runs backward, which changes odd
            # derivatives.
            weights[degree - k, m + order] = share * (-1) ** order
    return weights


def _lagrange_weights(nodes: Array) -> Array:
    """Return weights from values at nodes, shape (S, k), to Bernstein coefficients on [0, 1], shape (S, k, k)."""
    size = nodes.shape[1]
    # Of the phase, for the polynomial that is 1 at one node.
    powers = np.zeros((len(nodes), size, size))
    for node in range(size):
        polynomial = np.zeros((len(nodes), size))
        polynomial[:, 0] = 1.0
        for other in range(size):
            if other != node:
                # Multiplication by (u - u_j): powers shift by one, minus u_j times the
                # polynomial.
                shifted = np.roll(polynomial, 1, axis=1)
                product = shifted - nodes[:, other, None] * polynomial
                polynomial = product / (nodes[:, node] - nodes[:, other])[:, None]
        powers[:, :, node] = polynomial
    # Powers become Bernstein coefficients: b_i = sum_k C(i, k) / C(d, k) a_k.
    to_bernstein = np.array(
        [[comb(i, k) / comb(size - 1, k) for k in range(size)] for i in range(size)]
    )
    return np.asarray(to_bernstein @ powers)


def differentiated(weights: Array, order: int) -> Array:
    """Differentiate Bernstein coefficients (..., d + 1, W) by the phase of the span."""
    for _ in range(order):
        degree = weights.shape[-2] - 1
        weights = (
            degree * np.diff(weights, axis=-2) if degree else np.zeros_like(weights)
        )
    return weights


def _kernel_norms(
    nodes: Array, orders: NDArray[np.intp], weights: Array, order: int
) -> Array:
    """Integrate the absolute Peano kernel of a derivative over the nodes of every span, at most over it, shape (S,)."""
    # Spans with equal nodes have equal kernels: equal sampling needs only a few
    # integrals.
    _, chosen, inverse = np.unique(
        np.round(nodes, 6), axis=0, return_index=True, return_inverse=True
    )
    norms = np.empty(len(chosen))
    for row, index in enumerate(chosen):
        norms[row] = _kernel_norm(nodes[index], orders, weights[index], order)
    return np.asarray(norms[inverse.ravel()])


def _kernel_norm(
    nodes: Array, orders: NDArray[np.intp], weights: Array, order: int
) -> float:
    """Return the integral of one span; see ``_kernel_norms``."""
    low = min(nodes.min(), 0.0)
    high = max(nodes.max(), 1.0)
    # Midpoints of equal parts of the window integrate the kernel.
    tau = low + (high - low) * (np.arange(KERNEL_NODES) + 0.5) / KERNEL_NODES
    u = np.linspace(0, 1, KERNEL_PHASES)
    coefficients = differentiated(weights, order)
    degree = len(coefficients) - 1
    basis = np.stack(
        [comb(degree, k) * u**k * (1 - u) ** (degree - k) for k in range(degree + 1)]
    )
    # A jerk of 1 at tau gives the curve (x - tau)_+^2 / 2. The kernel is its derivative
    # minus that of the polynomial through its data (Peano).
    from_data = np.stack(
        [_truncated(node - tau, 2 - k) for node, k in zip(nodes, orders, strict=True)]
    )
    kernel = (
        _truncated(u[:, None] - tau, 2 - order) - (basis.T @ coefficients) @ from_data
    )
    # The mean times the length is the integral; the phase with the largest one counts.
    return float(np.abs(kernel).mean(axis=1).max() * (high - low) * KERNEL_MARGIN)


def _truncated(x: Array, power: int) -> Array:
    """Return max(x, 0)^power / power!."""
    return np.where(x > 0, np.abs(x) ** power / factorial(power), 0.0)


def _is_consistent(  # noqa: PLR0917 - the family with everything that it was made of
    family: CurveFamily,
    weights: Array,
    scaled_noise: Array,
    data: list[Array],
    max_jerk: Array,
    noise: Array,
) -> bool:
    """Return whether a curve with bounded jerks can pass through the samples: a necessary condition.

    The third derivative of a cubic through data is a mean of the jerks of every curve
    through the data. Accelerations of samples change by at most the bound times the
    time between them.
    """
    h = np.diff(family.t)[:, None]
    limit = max_jerk * (1 + CONSISTENCY_TOLERANCE)
    # Third differences amplify the rounding of coefficients.
    rounding = 1e-12 * (np.abs(family.coefficients).max() + 1)
    if len(data) == 3:
        change = np.abs(np.diff(data[2], axis=0))
        return bool((change <= limit * h + 2 * noise[2] + rounding).all())
    # Fewer data than these determine no cubic, so its third derivative says nothing.
    if weights.shape[1] < STENCIL:
        return True
    third = family.polynomials.jerk
    assert third is not None
    jerk = np.abs(third[0])
    from_noise = (
        (np.abs(differentiated(weights, 3)) * scaled_noise[:, None])
        .sum(axis=2)
        .max(axis=1)
    )
    return bool((jerk <= limit + (from_noise[:, None] + 8 * rounding) / h**3).all())
