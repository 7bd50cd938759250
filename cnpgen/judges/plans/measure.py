"""How near one motion comes to every bound: of its boundary conditions and of the problem's constraints.

A margin is measured of each, where the motion comes closest to the bound or is furthest beyond, and is named by joint,
axis or obstacle.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.course import Course
from cnpgen.judges.plans.sampling import Samples
from cnpgen.judges.plans.verdict import NOTHING, Margin, Reason
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import JointAcceleration, JointJerk, JointPosition, JointTorque, JointVelocity
from cnpgen.problems.problem import Problem
from cnpgen.store.joint_units import unit_of
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.path import PathWorld

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot
    from cnpgen.world.state import World

Array = NDArray[np.float64]

# How exactly a plan must meet its boundary conditions: unit of joints that turn, and what is allowed. Control points
# rebuilt in float64 meet 1e-10; ones kept in float32 miss the velocity by some 1e-5 rad/s and are told so.
BOUNDARY = {
    "q": ("boundary position", "rad", 1e-6),
    "dq": ("boundary velocity", "rad/s", 1e-6),
    "ddq": ("boundary acceleration", "rad/s^2", 1e-4),
}
_PER_JOINT = JointPosition | JointVelocity | JointAcceleration | JointJerk | JointTorque


def boundary_margins(states: Course, boundary: Boundary, samples: Samples, robot: "Robot") -> list[Margin]:
    """Compare the ends of a motion with its boundary conditions.

    Args:
        states: States of one motion, both ends among them.
        boundary: Boundary conditions of one motion.
        samples: When and at which phase they are.
        robot: The robot.
    """
    margins = []
    for what, (name, unit, allowed) in BOUNDARY.items():
        start, goal = getattr(boundary, f"start_{what}"), getattr(boundary, f"goal_{what}")
        wanted = start if goal is None else np.concatenate([start, goal])
        found = getattr(states, what).T[:: len(samples.s) - 1][: len(wanted)]  # at the start, and at the goal
        error = np.abs(found - wanted)
        end, joint = divmod(int(error.argmax()), error.shape[1])
        margins.append(
            Margin(
                name,
                Reason.BOUNDARY,
                unit_of(robot.units(unit), joint),
                robot.joint_names[joint],
                value=float(found[end, joint]),
                bound=float(wanted[end, joint]),
                excess=float(error[end, joint]),
                allowed=allowed,
                time=float(samples.t[-end]),
                phase=float(samples.s[-end]),
            )
        )
    return margins


@dataclass(frozen=True)
class Measured:
    """A condition along a motion.

    Attributes:
        constraint: The constraint that states it.
        condition: What the constraint measured at K samples.
        g: The m values [unit of the condition], shape (m, K).
        wider: How much wider than its bounds it is [unit of the condition], shape (K,).
        allowed: How far beyond them a motion may be and still be called valid, shape (m,).
    """

    constraint: Constraint
    condition: Condition
    g: Array
    wider: Array
    allowed: Array

    @cached_property
    def excess(self) -> Array:
        """How far the values are beyond their bounds, shape (m, K)."""
        below, above = self.condition.lower[:, None] - self.g, self.g - self.condition.upper[:, None]
        return np.asarray(np.maximum(below, above) - self.wider)

    @cached_property
    def share(self) -> Array:
        """The excess in multiples of what is allowed, shape (m, K)."""
        return np.asarray(self.excess / np.maximum(self.allowed, NOTHING)[:, None])

    def margin(self, problem: Problem, samples: Samples) -> Margin:
        """Say where the motion comes closest to breaking the condition, or breaks it most."""
        part, k = divmod(int(self.share.argmax()), len(samples.s))  # argmax finds the first that is nan, if any is
        low, high, g = self.condition.lower[part], self.condition.upper[part], self.g[part, k]
        worst = float(self.excess[part, k])
        return Margin(
            self.condition.name,
            self.constraint.reason,
            unit_of(self.condition.unit, part),
            name_part(problem, self.constraint, self.condition, part),
            value=float(g),
            bound=float(low - self.wider[k] if low - g > g - high else high + self.wider[k]),
            excess=np.inf if np.isnan(worst) else worst,
            allowed=float(self.allowed[part]),
            time=float(samples.t[k]),
            phase=float(samples.s[k]),
        )


def measure(constraint: Constraint, world: PathWorld, s: Array, start_tip: Array) -> list[Measured]:
    """Measure the conditions of a constraint along a motion.

    Args:
        constraint: The constraint.
        world: The robot at phases s.
        s: Phases, shape (K,).
        start_tip: Where the tip is at the start of the motion [m], shape (3,).
    """
    found = []
    for condition in constraint.measured(cast("World", world)):  # the same questions, answered for K states
        if condition.g:
            g = np.empty((len(condition.g), len(s)))
            for row, value in zip(g, condition.g, strict=True):
                row[:] = value
            wider = constraint.funnel(condition, s, start_tip)
            found.append(Measured(constraint, condition, g, wider, constraint.allowed(condition)))
    return found


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
    if condition.parts:
        return condition.parts[part]
    if isinstance(constraint, ObjectContact):
        return problem.obstacle[part].name
    return f"[{part}]"
