"""Checks of states of rest among obstacles: collisions of links, self-collisions and holding torques."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.errors import UsageError
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.link_clearance import SelfClearance
from cnpgen.problems.problem import Problem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.obstacle_shapes.convex_solid import Solid
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.world.forward_kinematics import ForwardKinematics
from cnpgen.world.rigid_bodies import RigidBodies

LINE_SPACING_RAD = 0.02  # rad or m, between checked states of a line


class RestingStates:
    """States of rest of a robot among the obstacles of its problem and further ones.

    It reuses Coal's memory: use it in one thread only.

    Raises:
        UsageError: The robot has no link geometry.
    """

    def __init__(
        self, problem: Problem, robot: Robot, obstacles: Sequence[Obstacle] = ()
    ) -> None:
        if robot.shape is None:
            raise UsageError(
                f'the problem {problem.name!r} needs geometry = "urdf" in [robot] for collision checks in scenes',
                concerns="problem",
            )
        self._robot = robot
        self._data = robot.model.createData()
        self._kinematics = ForwardKinematics(robot.model)
        self._bodies = RigidBodies(
            robot.shape, len(problem.obstacle) + len(obstacles), robot.n
        )
        clearance = problem.first(RobotClearance)
        own = problem.first(SelfClearance)
        self._clearance = 0.0 if clearance is None else clearance.distance
        self._self_clearance = None if own is None else own.distance
        placed = (*problem.obstacle, *obstacles)
        self._solids = solids_of(placed, place_obstacles(placed))

    def place_solids(self, solids: Sequence[Solid]) -> None:
        """Replace the obstacles by as many others, see ``Scene.bodies``."""
        self._solids = list(solids)

    def are_clear(self, q: Array, *, margin: float = 0.0) -> Mask:
        """Return whether nothing collides at each state q [rad], shape (n, K).

        The margin [m] is added to the problem's distance of links from obstacles.
        """
        if not q.shape[1]:
            return np.zeros(0, bool)
        bodies = self._bodies
        bodies.place(*self._kinematics.poses(q), self._solids)
        # The margin does not apply to distances of links from each other.
        clear = bodies.pair_distances(bodies.obstacle_pairs).clear_states(
            self._clearance + margin
        )
        if self._self_clearance is not None:
            clear &= bodies.pair_distances(bodies.link_pairs).clear_states(
                self._self_clearance
            )
        return clear

    def can_hold(self, q: Array) -> Mask:
        """Return whether the holding torques are within their limits at each state, shape (K,)."""
        import pinocchio as pin

        torques = [
            pin.computeGeneralizedGravity(self._robot.model, self._data, state)
            for state in q.T
        ]
        return np.array(
            [
                bool((np.abs(torque) <= self._robot.holding_limit).all())
                for torque in torques
            ],
            bool,
        )

    def are_ends(self, q: Array, *, margin: float = 0.0) -> Mask:
        """Return which states can start or end a motion: within limits, clear, and with feasible torques."""
        robot = self._robot
        inside = (q >= robot.position_lower[:, None]) & (
            q <= robot.position_upper[:, None]
        )
        valid = np.array(np.logical_and.reduce(inside))
        # Each check only has the states that the cheaper ones before it accept.
        valid[valid] = self.can_hold(q[:, valid])
        valid[valid] = self.are_clear(q[:, valid], margin=margin)
        return valid

    def is_line_clear(self, start: Array, goal: Array) -> bool:
        """Return whether the straight line between two joint positions is clear."""
        # No joint moves by more than the spacing from one state to the next.
        count = max(2, int(np.ceil(np.abs(goal - start).max() / LINE_SPACING_RAD)) + 1)
        return bool(self.are_clear(np.linspace(start, goal, count).T.copy()).all())


def seeds_of(robot: Robot, count: int, random: np.random.Generator) -> Array:
    """Return random joint positions within the limits [rad], shape (n, count)."""
    low = robot.position_lower[:, None]
    high = robot.position_upper[:, None]
    return np.asarray(low + (high - low) * random.uniform(size=(robot.n, count)))
