"""Margins of one motion: of its boundary conditions and of the problem's constraints.

Each margin is taken where the motion comes closest to the bound or violates it most,
and is named by joint, axis or obstacle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np

from cnpgen.arrays import Array
from cnpgen.judges.plans.evaluated_trajectory import Curve, EvaluatedTrajectory
from cnpgen.judges.plans.joint_limits import is_proven
from cnpgen.judges.plans.sampling import Samples, times
from cnpgen.judges.plans.verdict import ZERO_TOLERANCE, Margin, Reason
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import (
    JointAcceleration,
    JointJerk,
    JointPosition,
    JointTorque,
    JointVelocity,
)
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.store.joint_units import unit_of
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World

# Tolerances of the boundary conditions, with the units of revolute joints. Control
# points that are rebuilt in float64 have errors of 1e-10; those kept in float32 have
# velocity errors of about 1e-5 rad/s, which are reported.
BOUNDARY_TOLERANCES = {
    "q": ("boundary position", "rad", 1e-6),
    "dq": ("boundary velocity", "rad/s", 1e-6),
    "ddq": ("boundary acceleration", "rad/s^2", 1e-4),
}
_PER_JOINT = JointPosition | JointVelocity | JointAcceleration | JointJerk | JointTorque


def boundary_margins(
    states: EvaluatedTrajectory, boundary: Boundary, samples: Samples, robot: Robot
) -> list[Margin]:
    """Compare the ends of one motion with its boundary conditions.

    The states include both ends.
    """
    margins = []
    for quantity, (name, unit, tolerance) in BOUNDARY_TOLERANCES.items():
        start = getattr(boundary, f"start_{quantity}")
        goal = getattr(boundary, f"goal_{quantity}")
        # Only the start is prescribed if the goal is free.
        expected = start if goal is None else np.concatenate([start, goal])
        # At the start and at the goal.
        # The last sample is the goal: rows 0 and K - 1.
        actual = getattr(states, quantity).T[:: len(samples.s) - 1][: len(expected)]
        error = np.abs(actual - expected)
        end, joint = divmod(int(error.argmax()), error.shape[1])
        margins.append(
            Margin(
                name,
                Reason.BOUNDARY,
                unit_of(robot.units(unit), joint),
                robot.joint_names[joint],
                value=float(actual[end, joint]),
                bound=float(expected[end, joint]),
                violation=float(error[end, joint]),
                tolerance=tolerance,
                # End 0 is sample 0, end 1 is sample -1.
                time=float(samples.t[-end]),
                phase=float(samples.s[-end]),
            )
        )
    return margins


@dataclass(frozen=True)
class MeasuredCondition:
    """A condition along a motion."""

    constraint: Constraint  # constraint that states the condition
    condition: Condition  # judged values of the constraint at K samples
    g: Array  # values [unit of the condition], shape (m, K)
    # Distance by which the bounds are relaxed [unit of the condition], shape (K,).
    relaxation: Array
    tolerance: Array  # accepted violation, shape (m,)
    # Largest errors of the values, shape (m, K), (m, 1), or one of all; 0 if known.
    uncertainty: Array | float = 0.0

    @cached_property
    def violation(self) -> Array:
        """Signed distances of the values outside their bounds at most, negative inside, shape (m, K)."""
        # Positive outside. A relaxed bound or an uncertain value shifts the violation.
        below = self.condition.lower[:, None] - self.g
        above = self.g - self.condition.upper[:, None]
        return np.asarray(np.maximum(below, above) - self.relaxation + self.uncertainty)

    @cached_property
    def relative_violation(self) -> Array:
        """Violations in multiples of the tolerance, shape (m, K)."""
        return np.asarray(
            self.violation / np.maximum(self.tolerance, ZERO_TOLERANCE)[:, None]
        )

    def margin(self, problem: Problem, samples: Samples) -> Margin:
        """Return the margin where the motion comes closest to a violation, or violates the condition most."""
        # argmax returns the first nan, if any.
        part, k = divmod(int(self.relative_violation.argmax()), len(samples.s))
        low = self.condition.lower[part]
        high = self.condition.upper[part]
        g = self.g[part, k]
        violation = float(self.violation[part, k])
        return Margin(
            self.condition.name,
            self.constraint.reason,
            unit_of(self.condition.unit, part),
            name_part(problem, self.constraint, self.condition, part),
            value=float(g),
            # The bound that is closer, or violated more.
            bound=float(
                low - self.relaxation[k]
                if low - g > g - high
                else high + self.relaxation[k]
            ),
            violation=np.inf if np.isnan(violation) else violation,
            tolerance=float(self.tolerance[part]),
            time=float(samples.t[k]),
            phase=float(samples.s[k]),
        )


def measure(
    constraint: Constraint, world: PathWorld, s: Array, start_tip: Array
) -> list[MeasuredCondition]:
    """Measure the conditions of a constraint where the robot is, at phases of shape (K,).

    ``start_tip`` is the position of the tip at the start of the motion [m], shape (3,).
    """
    measured = []
    # PathWorld has the interface of World for K states
    for condition in constraint.judged(cast(World, world)):
        if condition.g:
            g = np.empty((len(condition.g), len(s)))
            # A value may be one number for all states.
            for row, value in zip(g, condition.g, strict=True):
                row[:] = value
            relaxation = constraint.bound_relaxation(condition, s, start_tip)
            measured.append(
                MeasuredCondition(
                    constraint, condition, g, relaxation, constraint.allowed(condition)
                )
            )
    return measured


def by_name(margins: list[Margin]) -> dict[str, Margin]:
    """Index margins by the names of their conditions; number repeated names."""
    named: dict[str, Margin] = {}
    for margin in margins:
        count = sum(other.name == margin.name for other in named.values())
        named[f"{margin.name} {count + 1}" if count else margin.name] = margin
    return named


def name_part(
    problem: Problem, constraint: Constraint, condition: Condition, part: int
) -> str:
    """Name one of a condition's values by its index: empty if it is the only one, a number for those of plug-ins."""
    if len(condition.g) == 1:
        return ""
    if condition.parts:
        return condition.parts[part]
    if isinstance(constraint, _PER_JOINT):
        return problem.robot.joints[part]
    if isinstance(constraint, ObjectContact):
        return problem.obstacle[part].name
    return f"[{part}]"


AddUncertainty = Callable[[MeasuredCondition, Array], MeasuredCondition]


@dataclass(frozen=True)
class EvaluationContext:
    """One motion with its measured conditions, and the means to measure them at other phases."""

    problem: Problem  # the problem
    curve: Curve  # one motion
    obstacle_poses: Array  # poses and sizes of the obstacles, shape (width,)
    samples: Samples  # times and phases of the initial samples
    table: Array  # times of the motion (``time_table``)
    start_tip: Array  # tip position at the start [m], shape (3,)
    world: PathWorld  # the robot; ``move`` moves it
    measured: Sequence[MeasuredCondition]  # conditions at the samples
    # Adds errors to conditions at phases, if the motion is not known.
    with_uncertainty: AddUncertainty | None = None
    # Phases of the curve -> phases of bounds, if they differ.
    phase_of: Callable[[Array], Array] | None = None

    def move(self, s: Array) -> None:
        """Move the robot to phases s, shape (K,)."""
        states = self.curve.evaluate(s, jerk=self.problem.uses_jerk)
        self.world.set_path(
            states.q, states.dq, states.ddq, self.obstacle_poses, states.jerk
        )

    def measure(self, constraint: Constraint, s: Array) -> list[MeasuredCondition]:
        """Measure a constraint at phases s, shape (K,), to which the robot was moved."""
        phases = s if self.phase_of is None else self.phase_of(s)
        measured = measure(constraint, self.world, phases, self.start_tip)
        add = self.with_uncertainty
        return (
            measured if add is None else [add(condition, s) for condition in measured]
        )

    def margin(self, measured: MeasuredCondition, s: Array) -> Margin:
        """Return the margin of a condition that was measured at phases s."""
        return measured.margin(self.problem, Samples(s, times(s, self.table)))


def evaluation_context(  # noqa: PLR0917 - all of them are independent inputs
    problem: Problem,
    curve: Curve,
    obstacle_poses: Array,
    world: PathWorld,
    samples: Samples,
    table: Array,
    phase_of: Callable[[Array], Array] | None = None,
) -> EvaluationContext:
    """Measure all conditions that are not proven where the robot is.

    Arguments as of ``EvaluationContext``.
    """
    start_tip = world.tip_position[:, 0].copy()
    constraints = [
        constraint for constraint in problem.constraint if not is_proven(constraint)
    ]
    phases = samples.s if phase_of is None else phase_of(samples.s)
    measured = [
        condition
        for constraint in constraints
        for condition in measure(constraint, world, phases, start_tip)
    ]
    return EvaluationContext(
        problem,
        curve,
        obstacle_poses,
        samples,
        table,
        start_tip,
        world,
        measured,
        phase_of=phase_of,
    )
