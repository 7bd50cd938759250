"""The paper's own rules of what counts as a valid plan, which are looser than ours,.

They follow the authors' baselines. The constraints of a problem determine which rules
apply:

* joint velocity and torque within the nominal limits, those before the problem's scales; on a table also accelerations,
  with the scale of the velocity (the rules for the heavy object have none);
* on a table: the tip within 1 cm of its height and of its rectangle over the whole motion;
* with a vertical constraint: ``1 - R_22 < 0.05`` (18 degrees), along the upright direction of the sample;
* a held object: the distance of its center from every obstacle above half its height minus 2 cm, no corner deeper than
  2 cm;
* the tip ends within 1 cm of the goal.

Joint positions, the robot's clearance and constraints of plug-ins are not checked by
these rules.
"""

from collections.abc import Iterator

import numpy as np

from cnpgen.arrays import Array
from cnpgen.problems.constraints.axis import Vertical
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.joint import (
    JointAcceleration,
    JointTorque,
    JointVelocity,
)
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import solids_of
from cnpgen.world.path import PathWorld

MAX_GOAL_DISTANCE_M = 0.01  # goal radius of the paper's CBiRRT
TABLE_TOLERANCE_M = 0.01
MAX_TILT = 0.05  # of 1 - R_22
MAX_OBJECT_DEPTH_M = 0.02


def paper_rule(
    problem: Problem, world: PathWorld, obstacle_poses: Array, goal_xyz: Array
) -> tuple[bool, tuple[str, ...]]:
    """Judge one motion by the paper's rules, as of ``PublishedRules.judge``; the world is at its samples.

    ``obstacle_poses`` has shape (width,); ``goal_xyz`` is the position of the tip at
    the goal [m], shape (3,).
    """
    finished = bool(
        np.linalg.norm(world.tip_position[:, -1] - goal_xyz) < MAX_GOAL_DISTANCE_M
    )
    broken = tuple(
        reason for reason, ok in _checks(problem, world, obstacle_poses) if not ok
    )
    return finished, broken


def _checks(
    problem: Problem, world: PathWorld, obstacle_poses: Array
) -> Iterator[tuple[str, bool]]:
    """Yield pairs of a reason and whether its rule is met.

    Nan values violate a rule.
    """
    on_table = any(isinstance(constraint, Table) for constraint in problem.constraint)
    for constraint in problem.constraint:
        if isinstance(constraint, JointVelocity | JointTorque) or (
            isinstance(constraint, JointAcceleration) and on_table
        ):
            yield constraint.reason, _is_nominal(constraint, problem, world)
        elif isinstance(constraint, Table):
            yield constraint.reason, _is_on_table(constraint, world)
        elif isinstance(constraint, Vertical):
            yield (
                constraint.reason,
                bool(
                    np.all(
                        1 - world.parameters.along_upright(world.tip_rotation)[2, 2]
                        < MAX_TILT
                    )
                ),
            )
        elif isinstance(constraint, ObjectContact):
            yield constraint.reason, _is_clear(problem, world, obstacle_poses)


def _is_nominal(constraint: Constraint, problem: Problem, world: PathWorld) -> bool:
    robot = world.robot
    limits = problem.limits
    if isinstance(constraint, JointTorque):
        # The problem's scales are removed: the paper's rules refer to nominal limits.
        values = world.torque
        limit = robot.torque_limit / limits.torque_scale
    elif isinstance(constraint, JointVelocity):
        factor = world.parameters.values.get("velocity_factor", 1.0)
        values = world.dq
        limit = factor * robot.velocity_limit / limits.velocity_scale
    else:
        factor = world.parameters.values.get("acceleration_factor", 1.0)
        values = world.ddq
        limit = factor * robot.acceleration_limit / limits.velocity_scale
    return bool(np.all(np.abs(values) <= limit[:, None]))


def _is_on_table(table: Table, world: PathWorld) -> bool:
    tip = world.parameters.on_table(world.tip_position)
    corners = table.bounds_of(world.parameters.values)
    low, high = (np.array([*corner, table.z], float) for corner in corners)
    low = low - TABLE_TOLERANCE_M
    high = high + TABLE_TOLERANCE_M
    # Comparisons with nan are false, so nan violates the rule.
    return bool(np.all((low[:, None] < tip) & (tip < high[:, None])))


def _is_clear(problem: Problem, world: PathWorld, obstacle_poses: Array) -> bool:
    size = np.array(problem.object_size or (0.0, 0.0, 0.0))
    center = world.tip_position
    reach = np.linalg.norm(size) / 2
    measured = (
        world.object_distances()
        if any(not obstacle.upright for obstacle in problem.obstacle)
        else []
    )
    for index, (obstacle, solid) in enumerate(
        zip(problem.obstacle, solids_of(problem.obstacle, obstacle_poses), strict=True)
    ):
        if not obstacle.upright:
            # The paper has rules for upright boxes only.
            if not np.all(measured[index] > -MAX_OBJECT_DEPTH_M):
                return False
            continue
        low = solid.low[:, None].copy()
        high = solid.high[:, None]
        # A box without a lower end reaches down without limit.
        if obstacle.height is None:
            low[2] = -np.inf
        # The nearest point of a box is the clipped center.
        offset = center - np.clip(center, low, high)
        distance = np.sqrt(np.einsum("ik,ik->k", offset, offset))
        # At other states no corner is inside.
        corners = world.object_corners(distance < reach)
        # A corner is inside by its least distance from a face.
        depth = np.minimum(corners - low, high - corners).min(axis=1)
        if not (
            np.all(distance > size[2] / 2 - MAX_OBJECT_DEPTH_M)
            and np.all(depth < MAX_OBJECT_DEPTH_M)
        ):
            return False
    return True
