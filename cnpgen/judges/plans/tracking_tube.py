"""Tube of states around a plan, which a robot with a bounded tracking error may reach.

The constraints on positions must hold for every state of the tube: limits of joint
positions, clearances and the manifold. Velocities, accelerations, jerks and torques are
judged on the plan itself. Limits of joints are exact. Distances change by at most the
displacement of the robot's points, which motion bounds give (Schwarzer et al. 2005).
Other conditions are measured again with every joint moved to both sides, one by one and
in random combinations. The sum of the changes, and three times the curvature that these
show, bounds their change.

Contact of the mallet with the puck is intended at the end of a hit. The tip may be in
the disc of permitted contact, and with an error it then touches the puck beside the
disc. So the distance must be larger by the change d only farther than 2 d from the
disc, and nearer by the distance from the disc less d. A hit whose path is up to 60
degrees from the normal of the contact gains the required d on the last 2 d of its way.
Where the robot touches the puck, the planned tip is then within 2 d of the disc, and
the tip itself within 3 d.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.judges.plans.continuous_collision import is_contact
from cnpgen.judges.plans.joint_limits import ProvenJointLimits
from cnpgen.judges.plans.measure import EvaluationContext, MeasuredCondition, measure
from cnpgen.problems.conditions import measured_needs
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.joint import JointPosition
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.arguments import check_range
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World

TrackingError = float | Sequence[float] | Array  # of every joint [rad], or one for all

MAX_TRACKING_ERROR = 1.0  # rad or m
# On the measured curvature: the largest of all corners is at most about three times that
# of a few random ones.
TUBE_CURVATURE_FACTOR = 3.0
TUBE_COMBINATIONS = 8  # random ones of all changes


class TrackingTube:
    """States within a tracking error of a plan.

    The error is the largest one of every joint [rad], shape (n,), or one for all; a
    negative one raises UsageError.
    """

    def __init__(self, problem: Problem, robot: Robot, error: TrackingError) -> None:
        values = np.asarray(error, float)
        if values.shape not in ((), (robot.n,)) or not np.isfinite(values).all():
            expected = f"one number [rad], or {robot.n}, one per joint"
            raise UsageError(
                f"must be {expected}, got {error!r}", argument="tracking_error"
            )
        unit = "m" if all(robot.prismatic) else "rad"
        check_range("tracking_error", values, 0.0, MAX_TRACKING_ERROR, unit)
        # Motion bounds of the whole tube need positions that include the error.
        self._problem = problem
        self._error = np.broadcast_to(values, robot.n).copy()
        self._world = PathWorld(robot, problem.obstacle, problem.object_size)
        world = World(robot, problem.obstacle, problem.object_size)
        self._position_conditions: set[tuple[int, str]] = set()
        # Derivatives of a condition decide whether the tube concerns it: those that
        # need no velocity are conditions on positions.
        for constraint in problem.constraint:
            orders = measured_needs([constraint.judged], world, jerk=problem.uses_jerk)
            judged = zip(constraint.judged(world), orders, strict=True)
            self._position_conditions |= {
                (id(constraint), condition.name)
                for condition, order in judged
                if order == 0
            }

    def tighten(self, limits: ProvenJointLimits) -> ProvenJointLimits:
        """Return joint limits whose position limits are moved inwards by the tracking error."""
        inwards = np.concatenate([self._error, -self._error])
        rows = [
            isinstance(constraint, JointPosition) for constraint in limits.constraints
        ]
        return replace(limits, bounds=limits.bounds + np.outer(rows, inwards))

    def widen(self, context: EvaluationContext) -> EvaluationContext:
        """Return the conditions of a plan with their largest change in the tube, at samples and between them."""
        # |x(q + e) - x(q)| <= sum over joints of reach_j |e_j|.
        reach = context.world.motion_bounds(context.curve.max_positions() + self._error)
        displacement = float(self._error @ reach)

        def add(condition: MeasuredCondition, s: Array) -> MeasuredCondition:
            if is_contact(condition.constraint):
                return replace(
                    condition, uncertainty=self._contact_error(condition, displacement)
                )
            if (
                id(condition.constraint),
                condition.condition.name,
            ) not in self._position_conditions:
                return condition
            change = self._largest_change(context, condition, s)
            if isinstance(condition.constraint, PuckContact):
                self._move(context, s)
                distances = condition.constraint.distances_from_contact_region(
                    cast(World, self._world)
                )
                # min(d, max(D - d, 0)) at the distance D from the disc of permitted
                # contact.
                change = np.minimum(change, np.maximum(distances - change, 0.0))
            return replace(condition, uncertainty=change)

        measured = [add(condition, context.samples.s) for condition in context.measured]
        return replace(context, measured=measured, with_uncertainty=add)

    def _contact_error(
        self, condition: MeasuredCondition, displacement: float
    ) -> "float | Array":
        """Return the change of distances [m].

        Contact of the object with what it stands on is intended.
        """
        if not isinstance(condition.constraint, ObjectContact):
            return displacement
        return np.array(
            [
                [0.0 if obstacle.below else displacement]
                for obstacle in self._problem.obstacle
            ]
        )

    def _largest_change(
        self, context: EvaluationContext, condition: MeasuredCondition, s: Array
    ) -> Array:
        """Return the largest change of the values of a smooth condition in the tube at phases s, shape (m, K)."""

        def values(offset: Array) -> Array:
            self._move(context, s, offset)
            conditions = measure(
                condition.constraint, self._world, s, context.start_tip
            )
            return next(
                each.g
                for each in conditions
                if each.condition.name == condition.condition.name
            )

        # Changes by one joint, to both sides: |g(q +- e_j) - g(q)| contains the gradient.
        nominal = values(np.zeros_like(self._error))
        offsets = np.diag(self._error)
        above, below = (
            np.array([values(sign * offset) - nominal for offset in offsets])
            for sign in (1, -1)
        )
        total = np.maximum(np.abs(above), np.abs(below)).sum(axis=0)
        # Curvature: e_j^2 d^2g/dq_j^2 of every joint, and for random corners of the tube
        # what the joints change together and not one by one.
        own = np.abs(above + below).sum(axis=0)
        shared = np.zeros_like(nominal)
        # Fixed seed: a verdict must not depend on chance.
        random = np.random.default_rng(0)
        for signs in random.choice([-1.0, 1.0], (TUBE_COMBINATIONS, len(self._error))):
            single = np.where(signs[:, None, None] > 0, above, below).sum(axis=0)
            together = values(signs * self._error) - nominal
            np.maximum(shared, np.abs(together - single), out=shared)
        return np.asarray(total + TUBE_CURVATURE_FACTOR * (own + shared))

    def _move(
        self, context: EvaluationContext, s: Array, offset: Array | float = 0.0
    ) -> None:
        """Move the world of the tube to the states of a plan at phases s, with joints moved by an offset [rad]."""
        states = context.curve.evaluate(s, jerk=self._problem.uses_jerk)
        self._world.set_path(
            states.q + np.reshape(offset, (-1, 1)),
            states.dq,
            states.ddq,
            context.obstacle_poses,
            states.jerk,
        )
