"""How near one motion comes to every bound: of its boundary conditions and of the problem's constraints.

A margin is measured of each, where the motion comes closest to the bound or is furthest beyond, and is named by joint,
axis or obstacle.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.course import Course
from cnpgen.judges.plans.sampling import Samples
from cnpgen.judges.plans.verdict import NOTHING, Margin, Reason
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import JointAcceleration, JointPosition, JointTorque, JointVelocity
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.constraints.vertical import Vertical
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.path import PathWorld

if TYPE_CHECKING:
    from cnpgen.world.state import World

Array = NDArray[np.float64]

# How exactly a plan must meet its boundary conditions: unit, and what is allowed. Control points rebuilt in float64
# meet 1e-10; ones kept in float32 miss the velocity by some 1e-5 rad/s and are told so.
BOUNDARY = {
    "q": ("boundary position", "rad", 1e-6),
    "dq": ("boundary velocity", "rad/s", 1e-6),
    "ddq": ("boundary acceleration", "rad/s^2", 1e-4),
}
_PER_JOINT = JointPosition | JointVelocity | JointAcceleration | JointTorque


def boundary_margins(states: Course, boundary: Boundary, samples: Samples, joints: tuple[str, ...]) -> list[Margin]:
    """Compare the ends of a motion with its boundary conditions.

    Args:
        states: States of one motion, both ends among them.
        boundary: Boundary conditions of one motion.
        samples: When and at which phase they are.
        joints: Names of the joints.
    """
    margins = []
    for what, (name, unit, allowed) in BOUNDARY.items():
        wanted = [getattr(boundary, f"{end}_{what}") for end in ("start", "goal")]
        pairs = [(k, want[0]) for k, want in zip((0, -1), wanted, strict=True) if want is not None]
        found = np.array([getattr(states, what)[:, k] for k, _ in pairs])
        error = np.abs(found - np.array([want for _, want in pairs]))
        end, joint = np.unravel_index(np.argmax(error), error.shape)
        k, want = pairs[int(end)]
        margins.append(
            Margin(
                name,
                Reason.BOUNDARY,
                unit,
                joints[int(joint)],
                value=float(found[end, joint]),
                bound=float(want[joint]),
                excess=float(error[end, joint]),
                allowed=allowed,
                time=float(samples.t[k]),
                phase=float(samples.s[k]),
            )
        )
    return margins


def constraint_margins(problem: Problem, world: PathWorld, samples: Samples) -> Iterator[Margin]:
    """Measure every constraint along a motion, one by one.

    Args:
        problem: The problem.
        world: Its robot at the samples.
        samples: When and at which phase they are.
    """
    start_tip = world.tip_position[:, 0]
    for constraint in problem.constraint:
        for condition in constraint.measured(cast("World", world)):  # the same questions, answered for K states
            if condition.g:
                yield measure_condition(problem, constraint, condition, samples, start_tip=start_tip)


def measure_condition(
    problem: Problem,
    constraint: Constraint,
    condition: Condition,
    samples: Samples,
    *,
    start_tip: Array,
) -> Margin:
    """Find where a motion comes closest to breaking a condition, or breaks it most.

    Args:
        problem: The problem.
        constraint: One of its constraints.
        condition: What the constraint measured at the samples.
        samples: When and at which phase they are.
        start_tip: Where the tip is at the start of the motion [m], shape (3,).
    """
    g = np.empty((len(condition.g), len(samples.s)))
    for row, value in zip(g, condition.g, strict=True):
        row[:] = value
    wider = constraint.funnel(condition, samples.s, start_tip)
    below, above = condition.lower[:, None] - g, g - condition.upper[:, None]
    excess = np.maximum(below, above) - wider
    allowed = constraint.allowed(condition)
    share = excess / np.maximum(allowed, NOTHING)[:, None]  # argmax finds the first that is nan, if any is
    part, k = divmod(int(np.argmax(share)), len(samples.s))
    is_low = below[part, k] > above[part, k]
    worst = float(excess[part, k])
    return Margin(
        condition.name,
        constraint.reason,
        condition.unit,
        name_part(problem, constraint, condition, part),
        value=float(g[part, k]),
        bound=float(condition.lower[part] - wider[k] if is_low else condition.upper[part] + wider[k]),
        excess=np.inf if np.isnan(worst) else worst,
        allowed=float(allowed[part]),
        time=float(samples.t[k]),
        phase=float(samples.s[k]),
    )


def by_name(margins: list[Margin]) -> dict[str, Margin]:
    """Index margins by the names of their conditions; a name that comes again gets a number."""
    found: dict[str, Margin] = {}
    for margin in margins:
        count = sum(other.name == margin.name for other in found.values())
        found[f"{margin.name} {count + 1}" if count else margin.name] = margin
    return found


def name_part(problem: Problem, constraint: Constraint, condition: Condition, part: int) -> str:
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
