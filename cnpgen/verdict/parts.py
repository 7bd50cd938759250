"""What the values of a condition are about: a joint, an axis, an obstacle."""

from typing import TYPE_CHECKING

from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import JointAcceleration, JointPosition, JointTorque, JointVelocity
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.constraints.vertical import Vertical

if TYPE_CHECKING:
    from cnpgen.problems.problem import Problem

_PER_JOINT = JointPosition | JointVelocity | JointAcceleration | JointTorque


def name_part(problem: "Problem", constraint: Constraint, condition: Condition, part: int) -> str:
    """Name one of a condition's values; the only one has no name, those of plug-ins are numbered.

    Args:
        problem: The problem.
        constraint: The constraint that the condition belongs to.
        condition: The condition.
        part: Index of the value.
    """
    if len(condition.g) == 1:
        return ""
    if isinstance(constraint, _PER_JOINT):
        return problem.robot.joints[part]
    if isinstance(constraint, Table | Vertical):
        return "xy"[part]
    obstacles = [obstacle.name for obstacle in problem.obstacle]
    if isinstance(constraint, ObjectContact):
        return obstacles[part]
    if isinstance(constraint, RobotClearance):  # segment by segment
        segment, obstacle = divmod(part, len(obstacles))
        return f"segment {segment + 1}, {obstacles[obstacle]}"
    return f"[{part}]"
