"""The paper's own, looser rules of what counts as a valid plan, beside our strict ones.

They follow the authors' baselines and tables; which apply is decided by the constraints that a problem has:

* joint velocity and torque within the nominal limits, those before the problem's scales; accelerations likewise, the
  scale being the velocity's, but only on a table (the rules for the heavy object count none);
* on a table: the tip within 1 cm of its height and of its rectangle, all the way;
* where the tip must be vertical: ``1 - R_22 < 0.05`` (18 degrees);
* a held object: its centre further from every obstacle than half its height less 2 cm, no corner deeper than 2 cm;
* the tip ends within 1 cm of the goal.

Joint positions, the robot's clearance and constraints of plug-ins count nothing here.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.verdict import PaperRule
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.joint import JointAcceleration, JointTorque, JointVelocity
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.constraints.vertical import Vertical
from cnpgen.robots.solid import solids_of

if TYPE_CHECKING:
    from cnpgen.problems.problem import Problem
    from cnpgen.world.path import PathWorld

Array = NDArray[np.float64]

GOAL = 0.01  # m: goal radius of the paper's CBiRRT
TABLE = 0.01  # m
TILT = 0.05  # of 1 - R_22
OBJECT = 0.02  # m


def paper_rule(problem: "Problem", world: "PathWorld", tops: Array, goal_xyz: Array) -> PaperRule:
    """Judge one motion by the paper's rules.

    Args:
        problem: The problem.
        world: Its robot at the samples of the motion.
        tops: Where the obstacles are, as ``obstacle_tops`` says, shape (numbers,).
        goal_xyz: Where the tip must end [m], shape (3,).
    """
    finished = bool(np.linalg.norm(world.tip_position[:, -1] - goal_xyz) < GOAL)
    broken = tuple(reason for reason, ok in _checks(problem, world, tops) if not ok)
    return PaperRule(finished, finished and not broken, broken)


def _checks(problem: "Problem", world: "PathWorld", tops: Array) -> Iterator[tuple[str, bool]]:
    """Yield (reason, whether it is kept); what is nan is not."""
    on_table = any(isinstance(constraint, Table) for constraint in problem.constraint)
    for constraint in problem.constraint:
        if isinstance(constraint, JointVelocity | JointTorque) or (
            isinstance(constraint, JointAcceleration) and on_table
        ):
            yield constraint.reason, _is_nominal(constraint, problem, world)
        elif isinstance(constraint, Table):
            yield constraint.reason, _is_on_table(constraint, world.tip_position)
        elif isinstance(constraint, Vertical):
            yield constraint.reason, bool(np.all(1 - world.tip_rotation[2, 2] < TILT))
        elif isinstance(constraint, ObjectContact):
            yield constraint.reason, _is_clear(problem, world, tops)


def _is_nominal(constraint: Constraint, problem: "Problem", world: "PathWorld") -> bool:
    robot, limits = world.robot, problem.limits
    if isinstance(constraint, JointTorque):
        values, limit = world.torque, robot.torque_limit / limits.torque_scale
    elif isinstance(constraint, JointVelocity):
        values, limit = world.dq, robot.velocity_limit / limits.velocity_scale
    else:
        values, limit = world.ddq, robot.acceleration_limit / limits.velocity_scale
    return bool(np.all(np.abs(values) <= limit[:, None]))


def _is_on_table(table: Table, tip: Array) -> bool:
    low = np.array([table.x.low, table.y.low, table.z]) - TABLE
    high = np.array([table.x.high, table.y.high, table.z]) + TABLE
    return bool(np.all((low[:, None] < tip) & (tip < high[:, None])))


def _is_clear(problem: "Problem", world: "PathWorld", tops: Array) -> bool:
    size = np.array(problem.object_size or (0.0, 0.0, 0.0))
    centre, reach = world.tip_position, np.linalg.norm(size) / 2
    measured = world.object_distances() if any(not each.upright for each in problem.obstacle) else []
    for index, (obstacle, solid) in enumerate(zip(problem.obstacle, solids_of(problem.obstacle, tops), strict=True)):
        if not obstacle.upright:  # the paper knows upright boxes only
            if not np.all(measured[index] > -OBJECT):
                return False
            continue
        low, high = solid.low[:, None].copy(), solid.high[:, None]
        if obstacle.height is None:
            low[2] = -np.inf
        offset = centre - np.clip(centre, low, high)
        apart = np.sqrt(np.einsum("ik,ik->k", offset, offset))
        near = world.object_corners(apart < reach)  # elsewhere none is inside
        depth = np.minimum(near - low, high - near).min(axis=1)
        if not (np.all(apart > size[2] / 2 - OBJECT) and np.all(depth < OBJECT)):
            return False
    return True
