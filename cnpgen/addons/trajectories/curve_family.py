"""A family of curves around a piecewise polynomial: everything that samples and assumptions say about a motion.

The nominal curve is a polynomial on every span between two knots. Every curve of the
family differs from it by at most a bound that is constant on each span. A family with
zero bounds is one known curve.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import comb

import numpy as np

from cnpgen.arrays import Array, Indices
from cnpgen.judges.plans.bernstein import PiecewisePolynomials
from cnpgen.judges.plans.evaluated_trajectory import EvaluatedTrajectory

ORDERS = ("q", "dq", "ddq", "jerk")
# Bound of a derivative that the curve does not have, in SI units; no real robot comes
# close.
UNDEFINED = 1e6


@dataclass(frozen=True, eq=False)
class CurveFamily:
    """Curves of n joints on S spans.

    The bound of a derivative that does not exist at the knots is ``UNDEFINED``.
    """

    t: Array  # times of the knots [s], from 0 to the duration, shape (S + 1,)
    # Bernstein coefficients of the nominal positions [rad], shape (d + 1, S, n).
    coefficients: Array
    # Largest differences of q, dq, ddq and jerk, shape (S, n) each.
    bounds: Sequence[Array]
    # Whether the nominal jerks are those of the polynomials; otherwise they are 0.
    has_jerk: bool = True

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.t[-1])

    @cached_property
    def edges(self) -> Array:
        """Phases of the knots, the shares of the duration, shape (S + 1,)."""
        return np.asarray(self.t / self.t[-1])

    @cached_property
    def polynomials(self) -> PiecewisePolynomials:
        """The nominal curve and its time derivatives."""
        found = [self.coefficients]
        for _ in range(3):
            found.append(_derivative(found[-1], np.diff(self.t)))
        if not self.has_jerk:
            found[3] = np.zeros_like(found[3])
        return PiecewisePolynomials(self.edges, *found)

    def evaluate(self, s: Array, *, jerk: bool) -> EvaluatedTrajectory:
        """Evaluate the nominal curve at phases s in [0, 1], shape (K,).

        At a knot, the span after it.
        """
        span, u = self._spans(s)
        orders = ORDERS if jerk else ORDERS[:3]
        return EvaluatedTrajectory(
            *(_values(getattr(self.polynomials, name), span, u) for name in orders)
        )

    def bounds_at(self, s: Array) -> list[Array]:
        """Return the bounds of all orders at phases s, shape (n, K) each."""
        span, _ = self._spans(s)
        return [np.ascontiguousarray(bound[span].T) for bound in self.bounds]

    def derivative_bounds(self) -> tuple[Array, Array, Array]:
        """Bound the derivatives of the nominal positions by the phase.

        See ``Curve``.
        """
        # Bernstein coefficients bound a polynomial. With s = t / T, derivatives by s
        # have factors T and T^2.
        first, second = (
            np.abs(values).max(axis=0)
            for values in (self.polynomials.dq, self.polynomials.ddq)
        )
        return self.edges, first * self.duration, second * self.duration**2

    def max_positions(self) -> Array:
        """Bound the absolute positions of all curves [rad], shape (n,)."""
        # A polynomial lies in the convex hull of its coefficients.
        return np.asarray(
            (np.abs(self.coefficients).max(axis=0) + self.bounds[0]).max(axis=0)
        )

    def _spans(self, s: Array) -> tuple[Indices, Array]:
        """Return the span of every phase and the position in it, from 0 to 1."""
        span = np.clip(np.searchsorted(self.edges, s, "right") - 1, 0, len(self.t) - 2)
        low = self.edges[span]
        return span, np.asarray((s - low) / (self.edges[span + 1] - low))


def _derivative(coefficients: Array, lengths: Array) -> Array:
    """Differentiate polynomials by time, shape (d + 1, S, n) -> (max(d, 1), S, n)."""
    if len(coefficients) == 1:
        return np.zeros_like(coefficients)
    # Coefficients of the derivative: d (b_k+1 - b_k) / h, with the degree d.
    return (len(coefficients) - 1) * np.diff(coefficients, axis=0) / lengths[:, None]


def bernstein_basis(degree: int, u: Array) -> Array:
    """Evaluate the Bernstein polynomials of a degree at phases u in [0, 1], shape (degree + 1, K)."""
    # B_k(u) = C(d, k) u^k (1 - u)^(d - k).
    return np.stack(
        [comb(degree, k) * u**k * (1 - u) ** (degree - k) for k in range(degree + 1)]
    )


def _values(coefficients: Array, span: Indices, u: Array) -> Array:
    """Evaluate polynomials in their spans, shape (n, K)."""
    total = np.zeros((len(span), coefficients.shape[2]))
    basis = bernstein_basis(len(coefficients) - 1, u)
    for weight, row in zip(basis, coefficients, strict=True):
        total += weight[:, None] * row[span]
    return np.ascontiguousarray(total.T)
