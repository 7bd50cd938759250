"""Check of motions that follow the path of a judged plan in another time, with Pinocchio and Coal.

The path has been judged with its plan. All conditions are measured again along the
motion, with its own velocities, accelerations, jerks and torques. Constraints that are
relaxed at some phases of a plan are relaxed at the states that have these phases.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cnpgen.addons.online.set_points import SampledMotion, parts_of
from cnpgen.arrays import Array, Mask
from cnpgen.judges.plans.measure import measure
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.world.path import PathWorld

MAX_CHECK_STEP_S = 1e-3
STEP_ROUNDING = 1e-6  # relative, of the widths of cells
JERK_STEP_S = 1e-6  # of the difference quotient of accelerations


@dataclass(frozen=True)
class _OpenedProblem:
    """A problem with the memory of Pinocchio and Coal that evaluates it."""

    problem: Problem
    world: PathWorld


class MotionChecker:
    """Measures motions along judged paths; the memory of Pinocchio and Coal is used by one thread at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._opened: dict[ProblemRecord, _OpenedProblem] = {}

    def violation(self, motion: SampledMotion, first: float, last: float) -> str:
        """Describe the first violated constraint of a motion between two times [s]; empty if there is none."""
        # Accelerations have their kinks at edges of cells.
        edges = motion.edges[(first < motion.edges) & (motion.edges < last)]
        times = np.concatenate([[first], edges, [last]])
        if np.diff(times).max() > MAX_CHECK_STEP_S * (1 + STEP_ROUNDING):
            count = int(np.ceil((last - first) / MAX_CHECK_STEP_S)) + 1
            times = np.union1d(times, np.linspace(first, last, count))
        for part, mask, phases in passed_parts(motion, times):
            if found := self._violation(part, motion, times[mask], phases):
                return found
        return ""

    def _violation(
        self, part: Plans, motion: SampledMotion, times: Array, phases: Array
    ) -> str:
        q, dq, ddq = (values.T for values in motion.at(times))
        # Values that overflow are inf or nan, which violate.
        with self._lock, np.errstate(all="ignore"):
            problem, world = self._open(part)
            start_tip = self._start_tip(world, part)
            jerk = _jerks(motion, times) if problem.uses_jerk else None
            world.set_path(q, dq, ddq, part.scene.poses[0], jerk, exact=False)
            for constraint in problem.constraint:
                for condition in measure(constraint, world, phases, start_tip):
                    if not (condition.relative_violation <= 1).all():  # nan violates
                        return f"{constraint.reason}: {condition.condition.name}"
        return ""

    def torques(self, part: Plans, q: Array, dq: Array, ddq: Array) -> Array:
        """Compute the inverse dynamics of K states with the load of a plan [N m], shape (K, n)."""
        with self._lock:
            _, world = self._open(part)
            world.set_path(q.T, dq.T, ddq.T, part.scene.poses[0], exact=False)
            return world.torque.T

    def _open(self, part: Plans) -> tuple[Problem, PathWorld]:
        """Return the problem of a plan and a world for it, which are kept."""
        if (opened := self._opened.get(part.problem)) is None:
            problem, robot = open_problem(part.problem)
            world = PathWorld(robot, problem.obstacle, problem.object_size)
            opened = self._opened[part.problem] = _OpenedProblem(problem, world)
        return opened.problem, opened.world

    def _start_tip(self, world: PathWorld, part: Plans) -> Array:
        """Return the tip position at the start of a plan [m], shape (3,), on which relaxations depend."""
        start = part.path_control_points[:1, 0].T
        rest = np.zeros_like(start)
        world.set_path(start, rest, rest, part.scene.poses[0], rest, exact=False)
        return np.array(world.tip_position[:, 0])


def passed_parts(
    motion: SampledMotion, times: Array
) -> Iterator[tuple[Plans, Mask, Array]]:
    """Yield the parts of its plan that a motion passes at K times [s], in their order.

    With each, return the mask of these times, shape (K,), and the phases of the part
    then.
    """
    if motion.plan is None:
        return
    # The motion is at the place that the plan passes at these times.
    plan_times = np.interp(times, motion.edges, motion.plan_times)
    parts = parts_of(motion.plan)
    index = np.searchsorted([begin for _, begin, _ in parts], plan_times, side="right")
    for number, (part, begin, _) in enumerate(parts, 1):
        # A time before the first part, by rounding, belongs to it.
        mask = np.maximum(index, 1) == number
        if mask.any():
            yield part, mask, part.motion.phase_at(plan_times[mask] - begin)[0]


def _jerks(motion: SampledMotion, times: Array) -> Array:
    """Compute the jerks of a motion [rad/s^3], shape (n, K), within its duration."""
    # Times are shifted inward at the ends, so that all of them are within the motion.
    low = np.clip(times - JERK_STEP_S, motion.start, motion.end_time - 3 * JERK_STEP_S)
    before, after = (motion.at(low + k * JERK_STEP_S).ddq for k in (0, 2))
    return (after - before).T / (2 * JERK_STEP_S)
