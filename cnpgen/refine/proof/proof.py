"""Why there is no valid plan: what is proven about a boundary problem, or that nothing is.

A proof assumes nothing about splines: it holds for every motion that the verdict would call valid, tolerances
included. What is known of the ends, how joints can move within their limits, and where the table ends is enough for
most problems that have no plan. What is not proven may have a plan all the same.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.refine.proof.ends import end_mistakes
from cnpgen.refine.proof.reachable import departures, joint_limits, moments
from cnpgen.refine.proof.table_proof import find_leaving
from cnpgen.store.joint_units import unit_of
from cnpgen.trajectory.boundary import Boundary

if TYPE_CHECKING:
    from cnpgen.plans.plans import Plans
    from cnpgen.problems.problem import Problem
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
MARGIN = 1e-4  # rad, for what happens between the moments that the verdict looks at, and how exactly it begins


class Feasibility(StrEnum):
    """What is known of a problem without a valid plan."""

    INFEASIBLE = "infeasible"
    VERGE = "on the verge"
    UNKNOWN = "gave up"


@dataclass(frozen=True)
class Explanation:
    """What is known of one problem.

    Attributes:
        kind: Whether it is proven to have no plan.
        text: What the proof is, or what else is known.
    """

    kind: Feasibility
    text: str

    def __str__(self) -> str:
        """Feasibility and text in one line."""
        return f"{self.kind}: {self.text}"


def explain_failure(
    problem: "Problem", robot: "Robot", boundary: Boundary, *, start_xyz: Array, goal_xyz: Array
) -> Explanation:
    """Say why no valid plan of a boundary problem was found.

    Args:
        problem: The problem.
        robot: Its robot.
        boundary: Boundary conditions of one motion.
        start_xyz: Position of the tip at the start [m], shape (3,).
        goal_xyz: Position of the tip at the goal [m], shape (3,).
    """
    values = (start_xyz, goal_xyz, *vars(boundary).values())
    if not all(each is None or np.isfinite(each).all() for each in values):
        return Explanation(Feasibility.INFEASIBLE, "the boundary conditions are no numbers")
    for mistake in end_mistakes(problem, robot, boundary, start_xyz=start_xyz, goal_xyz=goal_xyz):
        return Explanation(Feasibility.INFEASIBLE, mistake)
    for mistake in _cannot_brake(problem, robot, boundary):
        return Explanation(Feasibility.INFEASIBLE, mistake)
    unknown = Explanation(Feasibility.UNKNOWN, "nothing proves that there is no valid plan")
    return _off_table(problem, robot, boundary) or unknown


def explain_plans(plans: "Plans", which: Sequence[int] | None = None) -> dict[int, Explanation]:
    """Say of some plans' problems why no valid plan was found.

    Args:
        plans: The plans.
        which: Indices of those that are to be explained; by default all whose status is not valid.

    Returns:
        Index -> finding.

    Raises:
        UsageError: There is no plan of such an index.
    """
    from cnpgen.plans.status import PlanStatus
    from cnpgen.plans.tips import settle_tips
    from cnpgen.problems.record import open_problem

    if which is None:
        which = np.flatnonzero(plans.status != PlanStatus.VALID).tolist()
    if wrong := [index for index in which if not 0 <= index < len(plans)]:
        raise UsageError(f"there are plans 0 to {len(plans) - 1}, got {wrong[0]}")
    if not len(which):
        return {}
    plans = settle_tips(plans)
    problem, robot = open_problem(plans.problem)
    ends = plans.columns["start_xyz"], plans.columns["goal_xyz"]
    return {
        index: explain_failure(
            problem, robot, plans.boundary[index : index + 1], start_xyz=ends[0][index], goal_xyz=ends[1][index]
        )
        for index in which
    }


def _cannot_brake(problem: "Problem", robot: "Robot", boundary: Boundary) -> Iterator[str]:
    """Say which joints leave their range, however they brake."""
    limits = joint_limits(problem, robot, tolerances=1.0)
    times = moments(boundary, limits)
    for end, departure in departures(boundary).items():
        for time in times:
            lower, upper = departure.box(float(time), limits)
            for joint in np.flatnonzero(lower > upper + MARGIN):
                what, name = _moment(end, float(time)), robot.joint_names[joint]
                over = float(lower[joint] - upper[joint]) - MARGIN
                unit = unit_of(robot.units("rad"), int(joint))
                yield f"{what} {name} is {over:.2g} {unit} or more outside its range, however it is accelerated"


def _off_table(problem: "Problem", robot: "Robot", boundary: Boundary) -> Explanation | None:
    """Say whether the tip must leave a table."""
    found = find_leaving(problem, robot, boundary)
    if found is None:
        return None
    where, distance = f"{_moment(found.end, found.time)} the tip", f"{1e3 * abs(found.distance):.2g} mm"
    if found.proven:
        text = f"{where} is {distance} or more off the table, however the joints are accelerated"
        return Explanation(Feasibility.INFEASIBLE, text)
    room = f"has {distance} of the table left" if found.distance < 0 else f"is {distance} off the table"
    return Explanation(
        Feasibility.VERGE, f"{where} {room} at best, as far as a local search without tolerances can tell"
    )


def _moment(end: str, time: float) -> str:
    return f"{1e3 * time:.0f} ms {'after the start' if end == 'start' else 'before the goal'}"
