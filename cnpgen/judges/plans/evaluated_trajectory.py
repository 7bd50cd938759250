"""Curves that the judge evaluates at many phases: joint positions and their time derivatives, joint by joint.

The splines are those of ``scipy_splines``, not those of the planners and solvers that
are checked.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from cnpgen.arrays import Array
from cnpgen.judges.plans.bernstein import bernstein_coefficients
from cnpgen.judges.plans.scipy_splines import (
    basis_matrix,
    spline_derivatives,
    states_by_chain_rule,
)
from cnpgen.trajectory.spline_motion import Motion

# Derivatives of the path for accelerations, including order 0; jerks need one more.
PATH_ORDERS = 3
BOUND_PARTS = 4  # of every span, over which derivatives are bounded


@dataclass(frozen=True, eq=False)
class Phases:
    """Phases, ascending, in [0, 1], shape (K,), at which many motions are evaluated."""

    s: Array


@dataclass(frozen=True)
class EvaluatedTrajectory:
    """K states of one motion; every array has shape (n, K)."""

    q: Array  # joint positions [rad]
    dq: Array  # joint velocities [rad/s]
    ddq: Array  # joint accelerations [rad/s^2]
    # Joint jerks [rad/s^3], or None if no constraint needs them.
    jerk: Array | None = None

    def is_finite(self) -> bool:
        """Return whether all values are finite."""
        return all(
            values is None or bool(np.isfinite(values).all())
            for values in vars(self).values()
        )


def evaluate_trajectory(
    motion: Motion, s: Array, *, jerk: bool = False
) -> EvaluatedTrajectory:
    """Evaluate one motion at phases s in [0, 1], shape (K,), optionally with jerks.

    For many phases of one motion this takes a tenth of the time of ``Motion.at``.
    """
    orders = PATH_ORDERS + jerk
    p = spline_derivatives(motion.path[0], motion.degree, s, orders=orders)
    r = spline_derivatives(motion.rate[0, :, None], motion.degree, s, orders=orders - 1)
    return EvaluatedTrajectory(*states_by_chain_rule(p, r))


def evaluate_at_phases(
    motion: Motion, phases: Phases, *, jerk: bool = False
) -> EvaluatedTrajectory:
    """Evaluate one motion as ``evaluate_trajectory``, up to rounding, with cached bases of the splines."""
    orders = PATH_ORDERS + jerk
    path = motion.path[0].T
    rate = motion.rate[0]
    # One product for all derivatives: bases of orders 0, 1, ... side by side.
    p = (path @ _bases(path.shape[1], motion.degree, orders, phases)).reshape(
        len(path), orders, -1
    )
    r = (rate @ _bases(len(rate), motion.degree, orders - 1, phases)).reshape(
        orders - 1, -1
    )
    return EvaluatedTrajectory(*states_by_chain_rule(list(p.swapaxes(0, 1)), list(r)))


@lru_cache(maxsize=8)
def _bases(points: int, degree: int, orders: int, phases: Phases) -> Array:
    """Return the bases of a spline and of its derivatives, concatenated, shape (C, orders K)."""
    bases = [basis_matrix(phases.s, points, degree, order) for order in range(orders)]
    return np.ascontiguousarray(np.concatenate(bases).T)


def jerks(motion: Motion, s: Array) -> Array:
    """Evaluate the joint jerks of one motion at phases s [rad/s^3], shape (n, K)."""
    jerk = evaluate_trajectory(motion, s, jerk=True).jerk
    assert jerk is not None
    return jerk


class Curve(Protocol):
    """One motion of n joints as a function of the phase: splines, or the polynomials of a sampled trajectory."""

    def evaluate(self, s: Array, *, jerk: bool) -> EvaluatedTrajectory:
        """Evaluate the states at phases s in [0, 1], shape (K,), optionally with jerks."""

    def derivative_bounds(self) -> tuple[Array, Array, Array]:
        """Return S + 1 phases from 0 to 1, and bounds of p' and p'' between them [rad], shape (S, n) each."""

    def max_positions(self) -> Array:
        """Bound the absolute joint positions [rad], shape (n,)."""


@dataclass(frozen=True)
class SplineCurve:
    """One motion as two B-splines; for its methods see ``Curve``."""

    motion: Motion

    def evaluate(self, s: Array, *, jerk: bool) -> EvaluatedTrajectory:
        """Evaluate the states."""
        return evaluate_trajectory(self.motion, s, jerk=jerk)

    def derivative_bounds(self) -> tuple[Array, Array, Array]:
        """Bound derivatives by Bernstein coefficients of the path."""
        path = self.motion.path[0]
        degree = self.motion.degree
        # Shorter parts than spans: coefficients of a part are closer to the function.
        edges = np.linspace(0, 1, BOUND_PARTS * (len(path) - degree) + 1)
        first, second = (
            np.abs(values).max(axis=0)
            for values in bernstein_coefficients(path, degree, (1, 2), edges)
        )
        return edges, first, second

    def max_positions(self) -> Array:
        """Bound positions by the control points."""
        return np.asarray(np.abs(self.motion.path[0]).max(axis=0))
