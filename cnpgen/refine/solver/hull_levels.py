"""Levels of the solver on hulls in place of capsules: their problems, residuals, and collisions between grid points.

If hulls replace capsules (``can_measure_hulls``), all levels are of this kind. The
kernels are then those of the problem without clearances, so that all its scenes share
them. A corner
that passes a thin edge may collide between two grid points without a violation at
either of them. Such collisions are fed back to the solver as larger required distances
at the neighboring points. Some are found by the verdict only, which names their phase.
"""

from dataclasses import replace

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.collision.collision_checker import MAX_JOINTS
from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.bounds import (
    NO_TIGHTENING,
    accepted_along,
    bounds_template,
    near_ends,
)
from cnpgen.refine.solver.hulls import LINK_CONSTRAINTS, OBJECT_CONSTRAINTS, Hulls
from cnpgen.refine.solver.transcription import Transcription
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.spline import basis
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from cnpgen.world.world import World

TEMPLATE_POINTS = 32  # of a grid that is only used to find equalities
STATES_PER_INTERVAL = 10
FEEDBACK_MARGIN_M = 2e-4  # added to the required distances between grid points
# Phase over which the margin fades in from either end, where the clearance may be
# smaller.
MARGIN_EDGE = 0.05
# An object that stands on something at an end touches it up to rounding.
MIN_FED_BACK_M = 1e-6
MAX_FED_BACK_M = 0.02  # larger collisions are not between grid points


def can_measure_hulls(problem: Problem, robot: Robot, world: World) -> bool:
    """Return whether hulls replace capsules: distances of link geometry, among obstacles or without equalities.

    On a manifold without obstacles a kernel with the few capsules of the links takes
    less time.
    """
    others = without_distances(problem)
    if (
        robot.n > MAX_JOINTS
        or robot.shape is None
        or len(others.constraint) in {0, len(problem.constraint)}
    ):
        return False
    if problem.obstacle:
        return True
    return not bounds_template(
        others, world, np.linspace(0, 1, TEMPLATE_POINTS), NO_TIGHTENING
    ).equal.any()


def without_distances(problem: Problem) -> Problem:
    """Return a problem without distances that hulls measure, and without obstacles unless a plug-in may use them."""
    measured = (
        LINK_CONSTRAINTS
        if problem.object_size is None
        else LINK_CONSTRAINTS | OBJECT_CONSTRAINTS
    )
    others = tuple(
        item for item in problem.constraint if not isinstance(item, measured)
    )
    return problem.replaced(
        constraint=others,
        obstacle=problem.obstacle if problem.structure is None else (),
    )


def without_contacts(problem: Problem) -> Problem:
    """Return a problem whose links may not touch each other or an obstacle, not even within a tolerance."""
    strict = (
        replace(each, tolerance=0.0) if isinstance(each, LINK_CONSTRAINTS) else each
        for each in problem.constraint
    )
    return problem.replaced(constraint=tuple(strict))


class HullTranscription(Transcription):
    """A motion with the clearances of the links' hulls as further residuals.

    The hulls are among obstacles with ``obstacle_poses``, shape (width,), all of those
    of the scene.
    """

    def __init__(
        self, motion: Transcription, hulls: Hulls, obstacle_poses: Array
    ) -> None:
        self._rows = hulls.row_kernels(motion.kernels, obstacle_poses)
        kernels = replace(
            motion.kernels, values=self._rows.values, jacobian=self._rows.jacobian
        )
        super().__init__(
            kernels,
            motion.grid,
            boundary=motion.boundary,
            obstacle_poses=motion.obstacle_poses,
        )

    def activate(self) -> None:
        """Make the kernels those of this thread, see ``RowKernels``."""
        self._rows.activate()


class HullFeedback:
    """Check of a motion's hulls between the points of a grid with phases s, shape (K,)."""

    def __init__(self, spec: TrajectorySpec, s: Array) -> None:
        # States of each interval from its first grid point up to, but without, the
        # last.
        fractions = np.arange(STATES_PER_INTERVAL) / STATES_PER_INTERVAL
        phases = (s[:-1, None] + np.diff(s)[:, None] * fractions).ravel()
        self._spec = spec
        self._phases = s
        self._basis = basis(phases, spec.path_control_points, spec.degree)
        self._near_ends = near_ends(phases)
        self._margins = FEEDBACK_MARGIN_M * np.clip(
            np.minimum(phases, 1 - phases) / MARGIN_EDGE, 0, 1
        )
        self._intervals = len(s) - 1

    def missing_clearance(
        self,
        path: Array,
        hulls: Hulls,
        obstacle_poses: Array,
        *,
        accepted: Array | None = None,
    ) -> Array | None:
        """Return by how much the required distances must grow at the grid points [m], shape (K, columns).

        The result is None if no motion of the path control points, (C, n), collides
        between grid points, or more than ``MAX_FED_BACK_M``. Accepted violations of
        both ends [m] have shape (2, columns).
        """
        missing = hulls.missing((self._basis @ path).T, self._margins, obstacle_poses)
        if accepted is not None:
            missing = np.maximum(
                missing - accepted_along(self._near_ends, accepted), 0.0
            )
        # The margin alone is no collision; deep ones are no matter of the grid.
        worst = float((missing.max(axis=1) - self._margins).max())
        if not MIN_FED_BACK_M < worst < MAX_FED_BACK_M:
            return None
        # A collision between two grid points is fed back to both of them.
        between = missing.reshape(self._intervals, STATES_PER_INTERVAL, -1).max(axis=1)
        edge = np.zeros((1, between.shape[1]))
        return np.asarray(
            np.maximum(np.concatenate([between, edge]), np.concatenate([edge, between]))
        )

    def clearance_at(
        self,
        path: Array,
        hulls: Hulls,
        obstacle_poses: Array,
        *,
        phase: float,
        depth: float,
    ) -> Array:
        """Return by how much the required distances must grow around a rejected collision [m], shape (K, columns).

        The depth [m] is that of the verdict, and the least increase for the pairs that
        are closest.
        """
        # The interval of the collision and its neighbors: the motion will shift a little.
        interval = int(np.searchsorted(self._phases, phase)) - 1
        first = max(interval - 1, 0)
        last = min(interval + 2, self._intervals)
        window = np.linspace(
            self._phases[first],
            self._phases[last],
            STATES_PER_INTERVAL * (last - first) + 1,
        )
        q = basis(window, self._spec.path_control_points, self._spec.degree) @ path
        margins = np.full(len(q), depth + FEEDBACK_MARGIN_M)
        extra = np.zeros((self._intervals + 1, len(hulls.min_distances)))
        extra[first : last + 1] = hulls.missing(q.T, margins, obstacle_poses).max(
            axis=0
        )
        return extra
