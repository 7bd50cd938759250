"""Goal states of goal poses: batched inverse kinematics, then the valid states with the fastest straight line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cnpgen.pipelines.families.resting_states import RestingStates, seeds_of
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.link_clearance import SelfClearance
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.problems.scenes.scene_problem import GoalPose
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.world.pose_ik import PoseKinematics, PoseTolerance, solve_pose_ik
from cnpgen.world.world import World

Array = NDArray[np.float64]

MAX_GOAL_STATES = 5  # of one task that are tried, the nearest first
POSE_REASON = "no inverse kinematics of the goal"
POSE_SEEDS = 128  # of the inverse kinematics of a goal pose
MIN_DIFFERENCE_RAD = 0.3  # rad or m, of two goal states with one pose in their farthest joint


class EndConditions:
    """Conditions of a problem on states at rest, except for distances of links, which ``RestingStates`` checks."""

    def __init__(self, problem: Problem, robot: Robot, obstacles: Sequence[Obstacle] = ()) -> None:
        placed = problem.with_obstacles((*problem.obstacle, *obstacles)) if obstacles else problem
        others = RobotClearance | SelfClearance
        if any(obstacle.below for obstacle in placed.obstacle):  # their places depend on both ends
            others |= ObjectContact
        self._constraints = [constraint for constraint in placed.constraint if not isinstance(constraint, others)]
        self._world = World(robot, placed.obstacle, placed.object_size)
        zero = np.zeros((1, 3))
        self._poses = scene_of(placed, zero, zero, zero).poses[0]

    def met(self, q: Array) -> NDArray[np.bool_]:
        """Return which joint positions (n, K) meet the conditions within their tolerances, shape (K,)."""
        return np.array([self._are_met(state) for state in q.T], bool)

    def _are_met(self, q: Array) -> bool:
        self._world.set_state(q, np.zeros_like(q), np.zeros_like(q), self._poses)
        for constraint in self._constraints:
            for condition in constraint.measured(self._world):
                violation = np.maximum(condition.lower - condition.g, condition.g - condition.upper)
                if (violation > constraint.allowed(condition)).any():
                    return False
        return True


def states_of_pose(
    kinematics: PoseKinematics,
    states: RestingStates | None,
    conditions: EndConditions,
    pose: GoalPose,
    *,
    start: Array,
    random: np.random.Generator,
) -> tuple[Array, Array]:
    """Return joint positions with a goal pose of a frame.

    Robots without link geometry have no ``states`` of rest in a scene. ``random`` draws the seeds.

    Returns:
        Joint positions that can end a motion, the nearest to the start (n,) first, and all with this pose [rad], shape
        (G, n) and (H, n).
    """
    positions, rotations = np.tile(pose.position, (POSE_SEEDS, 1)), np.tile(pose.rotation, (POSE_SEEDS, 1, 1))
    tolerances = [np.tile(np.broadcast_to(each, 3), (POSE_SEEDS, 1)) for each in pose.tolerances]
    tolerance = PoseTolerance(*tolerances) if any(each.any() for each in tolerances) else None
    seeds = seeds_of(kinematics.robot, POSE_SEEDS, random)
    q, met = solve_pose_ik(kinematics, positions, rotations, seeds, tolerance=tolerance)
    found = q[:, met]
    valid = found if states is None else found[:, states.are_ends(found)]
    valid = valid[:, conditions.met(valid)]
    return nearest_states(valid.T, start, kinematics.robot, min_difference=MIN_DIFFERENCE_RAD), found.T.copy()


def nearest_states(states: Array, start: Array, robot: Robot, *, min_difference: float = 0.0) -> Array:
    """Return at most ``MAX_GOAL_STATES`` states [rad], shape (G, n), the nearest to the start, shape (n,), first.

    The distance is the duration of the straight line at full speed. A state is left out if its farthest joint differs
    less than ``min_difference`` from a nearer state.
    """
    duration = (np.abs(states - start) / robot.velocity_limit).max(axis=1)
    chosen = list[Array]()
    for index in np.argsort(duration, kind="stable"):
        if len(chosen) == MAX_GOAL_STATES:
            break
        if all(np.abs(states[index] - other).max() >= min_difference for other in chosen):
            chosen.append(states[index])
    return np.array(chosen).reshape(-1, states.shape[1])
