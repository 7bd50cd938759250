"""Collisions between grid points, fed back to the solver as larger required distances at the neighboring points.

A corner that passes a thin edge may collide between two grid points without a violation at either of them. Some
collisions are found by the verdict only, which names their phase.
"""

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.solver.bounds import accepted_along, near_ends
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.trajectory.spline import basis
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

Array = NDArray[np.float64]

STATES_PER_INTERVAL = 10
FEEDBACK_MARGIN_M = 2e-4  # added to the required distances between grid points
MARGIN_EDGE = 0.05  # phase over which the margin fades in from either end, where the clearance may be smaller
MIN_FED_BACK_M = 1e-6  # an object that stands on something at an end touches it up to rounding
MAX_FED_BACK_M = 0.02  # larger collisions are not between grid points


class HullFeedback:
    """Check of a motion's hulls between the points of a grid with phases s, shape (K,)."""

    def __init__(self, spec: TrajectorySpec, s: Array) -> None:
        fractions = np.arange(STATES_PER_INTERVAL) / STATES_PER_INTERVAL
        phases = (s[:-1, None] + np.diff(s)[:, None] * fractions).ravel()
        self._spec, self._phases = spec, s
        self._basis = basis(phases, spec.path_control_points, spec.degree)
        self._near_ends = near_ends(phases)
        self._margins = FEEDBACK_MARGIN_M * np.clip(np.minimum(phases, 1 - phases) / MARGIN_EDGE, 0, 1)
        self._intervals = len(s) - 1

    def missing_clearance(
        self, path: Array, hulls: Hulls, obstacle_poses: Array, *, accepted: Array | None = None
    ) -> Array | None:
        """Return by how much the required distances must grow at the grid points [m].

        Args:
            path: Path control points, shape (C, n).
            hulls: Clearances of the hulls.
            obstacle_poses: Poses and sizes of the obstacles, shape (width,).
            accepted: Accepted violations of both ends [m], shape (2, columns), or None.

        Returns:
            Shape (K, columns), or None if no motion between grid points collides, or more than ``MAX_FED_BACK_M``.
        """
        missing = hulls.missing((self._basis @ path).T, self._margins, obstacle_poses)
        if accepted is not None:
            missing = np.maximum(missing - accepted_along(self._near_ends, accepted), 0.0)
        worst = float((missing.max(axis=1) - self._margins).max())
        if not MIN_FED_BACK_M < worst < MAX_FED_BACK_M:
            return None
        between = missing.reshape(self._intervals, STATES_PER_INTERVAL, -1).max(axis=1)
        edge = np.zeros((1, between.shape[1]))
        return np.asarray(np.maximum(np.concatenate([between, edge]), np.concatenate([edge, between])))

    def clearance_at(self, path: Array, hulls: Hulls, obstacle_poses: Array, *, phase: float, depth: float) -> Array:
        """Return by how much the required distances must grow around a rejected collision [m], shape (K, columns).

        The depth [m] is that of the verdict, and the least increase for the pairs that are closest.
        """
        interval = int(np.searchsorted(self._phases, phase)) - 1
        first, last = max(interval - 1, 0), min(interval + 2, self._intervals)
        window = np.linspace(self._phases[first], self._phases[last], STATES_PER_INTERVAL * (last - first) + 1)
        q = basis(window, self._spec.path_control_points, self._spec.degree) @ path
        margins = np.full(len(q), depth + FEEDBACK_MARGIN_M)
        extra = np.zeros((self._intervals + 1, len(hulls.min_distances)))
        extra[first : last + 1] = hulls.missing(q.T, margins, obstacle_poses).max(axis=0)
        return extra
