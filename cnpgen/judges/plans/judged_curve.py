"""Interface of the curves that the judge evaluates: motions as splines, and sampled trajectories as polynomials."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.bernstein import bernstein_coefficients
from cnpgen.judges.plans.evaluated_trajectory import EvaluatedTrajectory, evaluate_trajectory
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]

BOUND_PARTS = 4  # of every span, over which derivatives are bounded


@dataclass(frozen=True)
class DerivativeBounds:
    """Bounds of the derivatives of joint positions by the phase, on S intervals.

    Attributes:
        edges: Phases between which they hold, ascending from 0 to 1, shape (S + 1,).
        first: Largest absolute first derivatives [rad], shape (S, n).
        second: Largest absolute second derivatives [rad], shape (S, n).
    """

    edges: Array
    first: Array
    second: Array


class Curve(Protocol):
    """One motion of n joints as a function of the phase."""

    def evaluate(self, s: Array, *, jerk: bool) -> EvaluatedTrajectory:
        """Evaluate the states at phases s in [0, 1], shape (K,), optionally with jerks."""

    def derivative_bounds(self) -> DerivativeBounds:
        """Bound the derivatives of the joint positions by the phase."""

    def max_positions(self) -> Array:
        """Bound the absolute joint positions [rad], shape (n,)."""


@dataclass(frozen=True)
class SplineCurve:
    """One motion as two B-splines."""

    motion: Motion

    def evaluate(self, s: Array, *, jerk: bool) -> EvaluatedTrajectory:
        """Evaluate the states; see ``Curve``."""
        return evaluate_trajectory(self.motion, s, jerk=jerk)

    def derivative_bounds(self) -> DerivativeBounds:
        """Bound derivatives by Bernstein coefficients of the path; see ``Curve``."""
        path, degree = self.motion.path[0], self.motion.degree
        edges = np.linspace(0, 1, BOUND_PARTS * (len(path) - degree) + 1)
        coefficients = bernstein_coefficients(path, degree, (1, 2), edges)
        first, second = (np.abs(values).max(axis=0) for values in coefficients)
        return DerivativeBounds(edges, first, second)

    def max_positions(self) -> Array:
        """Bound positions by the control points; see ``Curve``."""
        return np.asarray(np.abs(self.motion.path[0]).max(axis=0))
