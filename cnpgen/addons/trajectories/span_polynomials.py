"""Polynomials between samples: weights that map the data of a span to Bernstein coefficients.

The data of a span are positions and derivatives at both of its ends (Hermite), or
positions around it (Lagrange). Noise of the data changes a derivative by at most the sum
of the absolute weights. The difference between a polynomial and another curve through
the same data is an integral of the curve's jerk against a kernel (Peano 1913).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, factorial

import numpy as np

from cnpgen.addons.trajectories.curve_family import bernstein_basis
from cnpgen.arrays import Array, Indices

KERNEL_NODES = 240  # of the integral over a kernel
KERNEL_PHASES = 9  # in a span, at which the integral is evaluated
KERNEL_MARGIN = 1.05  # factor on the integral, for phases and nodes between


@dataclass(frozen=True, eq=False)
class SpanPolynomials:
    """Polynomials of the positions in S spans, each linear in W data, with its phase from 0 to 1.

    Attributes:
        h: Lengths of the spans [s], shape (S,).
        nodes: Phases of the data, shape (S, W).
        orders: Orders of the derivatives that the data are, shape (W,).
        weights: Weights of the data for the Bernstein coefficients, shape (S, d + 1, W).
        data: Derivatives by the phase [rad], shape (S, W, n).
        noise: Their largest errors, shape (S, W).
    """

    h: Array
    nodes: Array
    orders: Indices
    weights: Array
    data: Array
    noise: Array

    def coefficients(self, order: int = 0) -> Array:
        """Return the Bernstein coefficients of a derivative by the phase, shape (d - order + 1, S, n)."""
        return np.asarray(
            np.einsum("scw,swn->csn", _differentiated(self.weights, order), self.data)
        )

    def values(self, order: int, phases: Array) -> Array:
        """Return a derivative by time at phases of all spans, shape (phases, S, n)."""
        coefficients = self.coefficients(order)
        basis = bernstein_basis(len(coefficients) - 1, phases)
        values = np.einsum("cp,csn->psn", basis, coefficients)
        return np.asarray(values / self.h[:, None] ** order)

    def noise_errors(self, order: int) -> Array:
        """Bound the effect of the noise on a derivative by time, shape (S, 1)."""
        # Errors e of the data change a coefficient by at most sum |w| e. Values of the
        # polynomial change by no more than its coefficients (convex hull).
        weights = np.abs(_differentiated(self.weights, order))
        largest = np.einsum("scw,sw->sc", weights, self.noise).max(axis=1)
        return np.asarray((largest / self.h**order)[:, None])

    def kernel_norms(self, order: int) -> Array:
        """Integrate the absolute Peano kernel of a derivative by the phase over the nodes of every span, shape (S,)."""
        # Spans with equal nodes have equal kernels: equal sampling needs only a few
        # integrals.
        _, chosen, inverse = np.unique(
            np.round(self.nodes, 6), axis=0, return_index=True, return_inverse=True
        )
        norms = [self._kernel_norm(span, order) for span in chosen.tolist()]
        return np.array(norms)[inverse.ravel()]

    def _kernel_norm(self, span: int, order: int) -> float:
        """Return the integral of one span; see ``kernel_norms``."""
        nodes = self.nodes[span]
        low = min(nodes.min(), 0.0)
        high = max(nodes.max(), 1.0)
        # Midpoints of equal parts of the window integrate the kernel.
        tau = low + (high - low) * (np.arange(KERNEL_NODES) + 0.5) / KERNEL_NODES
        u = np.linspace(0, 1, KERNEL_PHASES)
        coefficients = _differentiated(self.weights[span], order)
        basis = bernstein_basis(len(coefficients) - 1, u)
        # A jerk of 1 at tau gives the curve (x - tau)_+^2 / 2. The kernel is its
        # derivative minus that of the polynomial through its data (Peano).
        from_data = [
            _truncated(node - tau, 2 - k)
            for node, k in zip(nodes, self.orders, strict=True)
        ]
        of_jerk = _truncated(u[:, None] - tau, 2 - order)
        kernel = of_jerk - (basis.T @ coefficients) @ np.stack(from_data)
        # The mean times the length is the integral; the phase with the largest one
        # counts.
        largest = np.abs(kernel).mean(axis=1).max()
        return float(largest * (high - low) * KERNEL_MARGIN)


def hermite_polynomials(h: Array, data: list[Array], noise: Array) -> SpanPolynomials:
    """Return polynomials through positions and m - 1 derivatives at the ends of spans of lengths h [s].

    The data have shape (S + 1, n) each, their largest errors at least (m,).
    """
    m = len(data)
    orders = np.tile(np.arange(m), 2)
    # With u = (t - t_i) / h, a derivative of order k by u is h^k times that by t.
    scale = h[:, None] ** orders
    ends = [values[end:][: len(h)] for end in (0, 1) for values in data]
    return SpanPolynomials(
        h,
        # Data of both ends are at the phases 0 and 1.
        np.broadcast_to(np.repeat([0.0, 1.0], m), (len(h), 2 * m)),
        orders,
        np.broadcast_to(_hermite_weights(m), (len(h), 2 * m, 2 * m)),
        np.stack(ends, axis=1) * scale[..., None],
        np.asarray(noise)[orders] * scale,
    )


def lagrange_polynomials(
    t: Array, q: Array, neighbors: int, noise: float = 0.0
) -> SpanPolynomials:
    """Return polynomials through at most ``neighbors`` positions, shape (K, n), around every span between times [s]."""
    size = min(neighbors, len(t))
    h = np.diff(t)
    # The span is in the middle of its window, but at both ends of the samples.
    first = np.clip(np.arange(len(h)) - (size // 2 - 1), 0, len(t) - size)
    window = first[:, None] + np.arange(size)
    # Phases in which the span is [0, 1].
    nodes = (t[window] - t[:-1, None]) / h[:, None]
    return SpanPolynomials(
        h,
        nodes,
        np.zeros(size, np.intp),
        _lagrange_weights(nodes),
        q[window],
        np.full(window.shape, noise),
    )


def _hermite_weights(m: int) -> Array:
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
    return to_bernstein @ powers


def _differentiated(weights: Array, order: int) -> Array:
    """Differentiate Bernstein coefficients (..., d + 1, W) by the phase of the span."""
    for _ in range(order):
        degree = weights.shape[-2] - 1
        weights = (
            degree * np.diff(weights, axis=-2) if degree else np.zeros_like(weights)
        )
    return weights


def _truncated(x: Array, power: int) -> Array:
    """Return max(x, 0)^power / power!."""
    return np.where(x > 0, np.abs(x) ** power / factorial(power), 0.0)
