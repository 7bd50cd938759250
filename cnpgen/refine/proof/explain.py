"""Explanations of boundary problems without a valid plan: a proof of infeasibility, or none.

A proof does not depend on splines: it holds for every motion that the verdict would
accept, tolerances included. The ends, the reachable joint positions and the edges of
the table suffice for most infeasible problems. A problem without a proof may have a
valid plan.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain

import numpy as np

from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem import Problem
from cnpgen.refine.proof.end_check import EndCheck
from cnpgen.refine.proof.reachable_positions import (
    end_states,
    joint_limits,
    sample_times,
)
from cnpgen.refine.proof.table_proof import find_table_exit
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.store.joint_units import unit_of
from cnpgen.trajectory.boundary import Boundary

# For motion between the times of the verdict, and its tolerance of boundary conditions.
POSITION_MARGIN_RAD = 1e-4


class Feasibility(StrEnum):
    """Result of an explanation."""

    INFEASIBLE = "infeasible"
    VERGE = "on the verge"
    UNKNOWN = "gave up"


@dataclass(frozen=True)
class Explanation:
    """Explanation of one problem.

    Attributes:
        kind: Result.
        text: The proof, or a description of what else is known.
    """

    kind: Feasibility
    text: str

    def __str__(self) -> str:
        """Return result and text in one line."""
        return f"{self.kind}: {self.text}"


def explain_failure(
    problem: Problem, robot: Robot, boundary: Boundary, scene: Scene
) -> Explanation:
    """Explain why no valid plan of a boundary problem was found: one motion, with a scene of one sample."""
    conditions = (scene.poses, *vars(boundary).values())
    if not all(values is None or np.isfinite(values).all() for values in conditions):
        return Explanation(
            Feasibility.INFEASIBLE, "the boundary conditions are not finite"
        )
    ends = EndCheck(problem, robot).violations(boundary, scene)
    violations = (text for _, text in ends)
    # Cheap proofs first; the first one is enough.
    for text in chain(violations, _cannot_brake(problem, robot, boundary)):
        return Explanation(Feasibility.INFEASIBLE, text)
    unknown = Explanation(Feasibility.UNKNOWN, "there is no proof of infeasibility")
    return _off_table(problem, robot, boundary) or unknown


@checked_arguments
def explain_plans(
    plans: Plans, indices: Sequence[int] | None = None
) -> dict[int, Explanation]:
    """Explain why no valid plans of some problems were found.

    Args:
        plans: The plans.
        indices: Indices of the plans to explain; by default all whose status is not
            valid.

    Returns:
        Index -> explanation.

    Raises:
        UsageError: An index is out of range.
    """
    from cnpgen.plans.format import PlanStatus
    from cnpgen.plans.tips import correct_tips
    from cnpgen.problems.problem_record import open_problem

    if indices is None:
        indices = np.flatnonzero(plans.status != PlanStatus.VALID).tolist()
    indices = [integer("indices", index) for index in indices]
    if wrong := [index for index in indices if not 0 <= index < len(plans)]:
        raise UsageError(
            f"there are plans 0 to {len(plans) - 1}, got {wrong[0]}", concerns="indices"
        )
    if not indices:
        return {}
    plans = correct_tips(plans)
    problem, robot = open_problem(plans.problem)
    return {
        index: explain_failure(
            problem, robot, plans.boundary[index : index + 1], plans.scene[index]
        )
        for index in indices
    }


def _cannot_brake(problem: Problem, robot: Robot, boundary: Boundary) -> Iterator[str]:
    """Describe the joints that leave their range for any acceleration."""
    limits = joint_limits(problem, robot, tolerances=1.0)
    times = sample_times(boundary, limits)
    for end, state in end_states(boundary).items():
        for time in times:
            lower, upper = state.box(float(time), limits)
            # An empty box: the joint cannot be within its range at this time.
            for joint in np.flatnonzero(lower > upper + POSITION_MARGIN_RAD):
                instant = _time_text(end, float(time))
                name = robot.joint_names[joint]
                violation = float(lower[joint] - upper[joint]) - POSITION_MARGIN_RAD
                unit = unit_of(robot.units("rad"), int(joint))
                yield f"{instant} {name} is {violation:.2g} {unit} or more outside its range, for any acceleration"


def _off_table(
    problem: Problem, robot: Robot, boundary: Boundary
) -> Explanation | None:
    """Explain whether the tip must leave a table."""
    table_exit = find_table_exit(problem, robot, boundary)
    if table_exit is None:
        return None
    subject = f"{_time_text(table_exit.end, table_exit.time)} the tip"
    distance = f"{1e3 * abs(table_exit.distance):.2g} mm"
    if table_exit.proven:
        return Explanation(
            Feasibility.INFEASIBLE,
            f"{subject} is {distance} or more off the table, for any acceleration",
        )
    best = (
        f"has {distance} of the table left"
        if table_exit.distance < 0
        else f"is {distance} off the table"
    )
    return Explanation(
        Feasibility.VERGE,
        f"{subject} {best} at best, by a local search without tolerances",
    )


def _time_text(end: str, time: float) -> str:
    return f"{1e3 * time:.0f} ms {'after the start' if end == 'start' else 'before the goal'}"
