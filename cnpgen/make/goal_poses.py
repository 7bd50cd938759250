"""Goal states of goal poses: batched inverse kinematics, then the valid states with the fastest straight line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cnpgen.pipelines.families.resting_states import RestingStates, seeds_of
from cnpgen.problems.scenes.scene_problem import GoalPose
from cnpgen.robots.robot import Robot
from cnpgen.world.pose_ik import PoseKinematics, PoseTolerance, solve_pose_ik

Array = NDArray[np.float64]

MAX_GOAL_STATES = 5  # of one task that are tried, the nearest first
POSE_REASON = "no inverse kinematics of the goal"
POSE_SEEDS = 128  # of the inverse kinematics of a goal pose
MIN_DIFFERENCE_RAD = 0.3  # rad or m, of two goal states with one pose in their farthest joint


def states_of_pose(
    kinematics: PoseKinematics, states: RestingStates | None, pose: GoalPose, random: np.random.Generator
) -> tuple[Array, Array]:
    """Return joint positions with a goal pose.

    Args:
        kinematics: Kinematics of the frame that has the pose.
        states: Checks of states of rest in the scene; None if the robot has no link geometry.
        pose: The pose with its tolerances.
        random: Random numbers for the seeds.

    Returns:
        Joint positions that can end a motion, and all with this pose [rad], shape (G, n) and (H, n).
    """
    positions, rotations = np.tile(pose.position, (POSE_SEEDS, 1)), np.tile(pose.rotation, (POSE_SEEDS, 1, 1))
    tolerances = [np.tile(np.broadcast_to(each, 3), (POSE_SEEDS, 1)) for each in pose.tolerances]
    tolerance = PoseTolerance(*tolerances) if any(each.any() for each in tolerances) else None
    seeds = seeds_of(kinematics.robot, POSE_SEEDS, random)
    q, met = solve_pose_ik(kinematics, positions, rotations, seeds, tolerance=tolerance)
    found = q[:, met]
    valid = found if states is None else found[:, states.are_ends(found)]
    return valid.T.copy(), found.T.copy()


def nearest_states(states: Array, start: Array, robot: Robot, *, min_difference: float = 0.0) -> Array:
    """Return at most ``MAX_GOAL_STATES`` states in the order of the straight line's duration at full speed.

    Args:
        states: Joint positions [rad], shape (G, n).
        start: Joint positions at the start [rad], shape (n,).
        robot: The robot.
        min_difference: Difference of the farthest joint from a nearer state, below which a state is left out.
    """
    duration = (np.abs(states - start) / robot.velocity_limit).max(axis=1)
    chosen = list[Array]()
    for index in np.argsort(duration, kind="stable"):
        if len(chosen) == MAX_GOAL_STATES:
            break
        if all(np.abs(states[index] - other).max() >= min_difference for other in chosen):
            chosen.append(states[index])
    return np.array(chosen).reshape(-1, states.shape[1])
