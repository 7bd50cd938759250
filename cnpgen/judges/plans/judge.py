"""Check plans with Pinocchio and Coal, on a fine time grid and between its moments.

With what optimised them it shares the problem, with its bounds, tolerances and where its obstacles stand, and what
control points mean (``cnpgen.trajectory``); but no kinematics, dynamics or distances, and no transcription.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.judges.plans.between import knots, polynomials
from cnpgen.judges.plans.closer import look_closer
from cnpgen.judges.plans.course import Course, Phases, course, course_at, jerks
from cnpgen.judges.plans.limits import Limits, limits_of
from cnpgen.judges.plans.measure import boundary_margins, by_name, measure
from cnpgen.judges.plans.metrics import metrics_of
from cnpgen.judges.plans.paper import paper_rule
from cnpgen.judges.plans.peaks import look_at_peaks
from cnpgen.judges.plans.sampling import CELLS, FEW_CELLS, LONGEST, Samples, few_phases, sample, time_table, times
from cnpgen.judges.plans.survey import Survey, survey
from cnpgen.judges.plans.verdict import Margin, Metrics, PaperRule, Reason, Verdict
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion
from cnpgen.world.path import PathWorld

Array = NDArray[np.float64]

LONGEST_STEP = 0.01  # s: looks further apart miss most of what a robot does in between
BESIDE = 1e-3  # in phase: how far apart looks on either side of a kink are
_GLANCE = Phases(np.linspace(0, 1, 33))  # phases at which most plans that are not valid show it


def judge(  # noqa: PLR0917 - each of them is half of a plan's meaning
    problem: Problem,
    robot: Robot,
    motion: Motion,
    boundary: Boundary,
    start_xyz: Array,
    goal_xyz: Array,
    *,
    step: float = 1e-3,
) -> list[Verdict]:
    """Judge N plans, each for itself: what one of them holds changes nothing about the others.

    A plan is valid if it meets its boundary conditions and exceeds every bound by no more than the constraint allows,
    at every moment. Limits of joint positions, velocities, accelerations and jerks are proven to hold between any two
    moments (``cnpgen.judges.plans.between``). Every other constraint's ``measured`` form is evaluated with Pinocchio
    and Coal at moments no further than ``step`` apart and at more of them near both ends (``sampling``); then around
    every maximum that could decide, until nothing is left to gain (``peaks``), and between moments where contacts could
    hide more than is allowed (``closer``). Numbers that cannot be evaluated give a verdict that says so, no exception.

    Args:
        problem: The problem.
        robot: Its robot.
        motion: N motions.
        boundary: What they must begin and end with.
        start_xyz: Tip positions at the start [m], shape (N, 3): they say where obstacles below the object stand.
        goal_xyz: Tip positions at the goal [m], shape (N, 3).
        step: Time step [s].

    Raises:
        UsageError: Shapes that do not fit together, or a step that is not positive or too long.
    """
    return Judge(problem, robot, step=step)(motion, boundary, start_xyz, goal_xyz)


class Judge:
    """Judges plans of one problem as ``judge`` does, with the memory of Pinocchio and Coal kept from call to call.

    Args:
        problem: The problem.
        robot: Its robot.
        step: Time step [s] of what is not brief.

    Raises:
        UsageError: The step is not positive, or above ``LONGEST_STEP``.
    """

    def __init__(self, problem: Problem, robot: Robot, *, step: float = 1e-3) -> None:
        check_step(step)
        self._problem, self._robot, self._step = problem, robot, step
        self._world = PathWorld(robot, problem.obstacle, problem.object_size)
        self._limits = limits_of(problem, self._world)

    def __call__(
        self, motion: Motion, boundary: Boundary, start_xyz: Array, goal_xyz: Array, *, brief: bool = False
    ) -> list[Verdict]:
        """Judge N plans; arguments as of ``judge``.

        A brief verdict has neither metrics nor the paper's rule. It is from fewer samples, on which it does not depend
        whether a plan is valid; how much room conditions have is less exact.
        """
        plans = self._plans(motion, boundary, start_xyz, goal_xyz)
        with np.errstate(all="ignore"):  # numbers too large to compute with become inf or nan, and are found to be
            return [_judge_plan(plan, self._world, self._limits, self._step, brief=brief) for plan in plans]

    def refutes(self, motion: Motion, boundary: Boundary, start_xyz: Array, goal_xyz: Array) -> list[bool]:
        """Say of N plans whether a few samples show that they are not valid; of those that pass nothing is known."""
        plans = self._plans(motion, boundary, start_xyz, goal_xyz)
        with np.errstate(all="ignore"):
            return [_is_refuted(plan, self._world) for plan in plans]

    def _plans(self, motion: Motion, boundary: Boundary, start_xyz: Array, goal_xyz: Array) -> "list[_Plan]":
        _check_shapes(self._robot, motion, boundary, start_xyz, goal_xyz)
        tops = obstacle_tops(self._problem, start_xyz, goal_xyz)
        return [
            _Plan(
                self._problem,
                Motion(motion.path[i : i + 1], motion.rate[i : i + 1], motion.degree),
                boundary[i : i + 1],
                tops[i],
                goal_xyz[i],
            )
            for i in range(len(motion))
        ]


def check_step(step: float) -> None:
    """Refuse a time step [s] that is not above 0 and at most ``LONGEST_STEP``.

    Raises:
        UsageError: It does not.
    """
    if not 0 < step <= LONGEST_STEP:
        raise UsageError(f"the time step must be above 0 and at most {LONGEST_STEP:g} s, got {step:g} s")


@dataclass(frozen=True)
class _Plan:
    """One motion and what it must do.

    Attributes:
        problem: The problem.
        motion: One motion.
        boundary: Its boundary conditions.
        tops: Where the obstacles are, as ``obstacle_tops`` says, shape (numbers,).
        goal_xyz: Where the tip must end [m], shape (3,).
    """

    problem: Problem
    motion: Motion
    boundary: Boundary
    tops: Array
    goal_xyz: Array

    @property
    def spans(self) -> int:
        """Number of intervals between the knots of the finer spline."""
        return int(max(self.motion.path.shape[1], self.motion.rate.shape[1])) - self.motion.degree

    @property
    def corners(self) -> frozenset[float]:
        """Phases at which constraints change abruptly, two on either side of each, and the knots of both splines."""
        kinks = tuple(s for each in self.problem.constraint for s in each.kinks)
        return _corners(self.motion.path.shape[1], self.motion.rate.shape[1], self.motion.degree, kinks)

    def is_finite(self) -> bool:
        numbers = (self.motion.path, self.motion.rate, self.tops, self.goal_xyz, *vars(self.boundary).values())
        return bool(np.isfinite(np.concatenate([each.ravel() for each in numbers if each is not None])).all())


@lru_cache(maxsize=8)
def _corners(path_points: int, rate_points: int, degree: int, kinks: tuple[float, ...]) -> frozenset[float]:
    """Return the knots of both splines, and two phases on either side of each kink.

    Second differences across a kink say nothing of what lies beside it.
    """
    return knots(path_points, rate_points, degree).union(s + k * BESIDE for s in kinks for k in range(-2, 3))


def _check_shapes(robot: Robot, motion: Motion, boundary: Boundary, start_xyz: Array, goal_xyz: Array) -> None:
    n_plans, n = len(motion), robot.n
    wanted = {
        "path control points": (motion.path, (n_plans, *motion.path.shape[1:2], n)),
        "rate control points": (motion.rate, (n_plans, *motion.rate.shape[1:2])),
        "start_xyz": (start_xyz, (n_plans, 3)),
        "goal_xyz": (goal_xyz, (n_plans, 3)),
        **{name: (values, (n_plans, n)) for name, values in vars(boundary).items() if values is not None},
    }
    for name, (values, shape) in wanted.items():
        if np.shape(values) != shape or len(shape) < 2:
            found = np.shape(values)
            raise UsageError(f"{name} must have shape {shape} for {n_plans} plans of {n} joints, got {found}")


def _judge_plan(plan: _Plan, world: PathWorld, limits: Limits, step: float, *, brief: bool) -> Verdict:
    """Judge one plan."""
    if fault := _fault(plan):
        return Verdict(fault)
    table = time_table(plan.motion.rate[0], plan.motion.degree, cells=FEW_CELLS if brief else CELLS)
    found = _first_look(plan, table) if brief else _look(plan, table, step)
    if found is None:
        return Verdict(Reason.TOO_LONG, metrics=Metrics(duration=float(table[1, -1])))
    states, samples = found
    if not states.is_finite():
        return Verdict(Reason.NOT_FINITE, metrics=Metrics(duration=float(samples.t[-1])), samples=len(samples.s))
    world.set_path(states.q, states.dq, states.ddq, plan.tops, states.jerk, exact=not brief)
    ends = boundary_margins(states, plan.boundary, samples, world.robot)
    metrics, paper = Metrics(), PaperRule()
    if not brief:
        metrics = metrics_of(plan.problem, world, samples, jerks(plan.motion, samples.s))
        paper = paper_rule(plan.problem, world, plan.tops, plan.goal_xyz)
    seen = survey(plan.problem, plan.motion, plan.tops, world, samples, table)
    margins = [*ends, *_margins(seen, limits, brief=brief)]
    return Verdict(reason_of(margins), by_name(margins), metrics, paper, len(samples.s))


def _margins(survey: Survey, limits: Limits, *, brief: bool) -> list[Margin]:
    """Measure every constraint, at the samples and between them; the survey's world is moved."""
    pieces, s, table = polynomials(survey.motion, jerk=survey.problem.uses_jerk), survey.samples.s, survey.table
    proven = limits.margins(survey.world, pieces, s, table, brief=brief)
    worst = {id(each): each.margin(survey.problem, survey.samples) for each in survey.measured}
    for each, margin in chain(look_closer(survey, brief=brief), look_at_peaks(survey)):
        worst[id(each)] = max(worst[id(each)], margin, key=lambda one: one.severity)
    found: dict[int, list[Margin]] = {id(constraint): [] for constraint in survey.problem.constraint}
    for constraint, margin in zip(limits.constraints, proven, strict=True):
        found[id(constraint)].append(margin)
    for each in survey.measured:
        found[id(each.constraint)].append(worst[id(each)])
    return [*chain.from_iterable(found.values())]


def _is_refuted(plan: _Plan, world: PathWorld) -> bool:
    """Whether the ends, or a constraint at one of a few phases, are wrong."""
    if _fault(plan):
        return True
    samples = Samples(_GLANCE.s, _GLANCE.s)
    states = course_at(plan.motion, _GLANCE, jerk=plan.problem.uses_jerk)
    if not states.is_finite():
        return True
    world.set_path(states.q, states.dq, states.ddq, plan.tops, states.jerk, exact=False)
    start_tip = world.tip_position[:, 0]
    found = [each for kind in plan.problem.constraint for each in measure(kind, world, samples.s, start_tip)]
    if not all((each.share <= 1).all() for each in found):
        return True
    return not all(margin.ok for margin in boundary_margins(states, plan.boundary, samples, world.robot))


def _look(plan: _Plan, table: Array, step: float) -> tuple[Course, Samples] | None:
    """Choose where to look, and look there; None where the motion is too long."""
    samples = sample(table, step, plan.spans, plan.corners)
    return (course(plan.motion, samples.s, jerk=plan.problem.uses_jerk), samples) if samples else None


def _first_look(plan: _Plan, table: Array) -> tuple[Course, Samples] | None:
    """Look at few phases, the same ones for every plan of a problem; see ``_look``."""
    if not table[1, -1] < LONGEST:
        return None
    phases, jerk = few_phases(plan.spans, plan.corners), plan.problem.uses_jerk
    exact = any(each.tolerance == 0 for each in plan.problem.constraint)  # then rounding decides: that of ``_look``
    states = course(plan.motion, phases.s, jerk=jerk) if exact else course_at(plan.motion, phases, jerk=jerk)
    return states, Samples(phases.s, times(phases.s, table))


def _fault(plan: _Plan) -> Reason | None:
    """Say why a plan cannot be evaluated, if it cannot."""
    if not plan.is_finite():
        return Reason.NOT_FINITE
    forward = plan.motion.rate.min() > 0 or plan.motion.runs_forward()[0]  # r is between its control points
    return None if forward else Reason.RATE


def reason_of(margins: list[Margin]) -> str:
    """Say why a plan is not valid: its boundary conditions first, then the constraint that is broken worst."""
    broken = [margin for margin in margins if not margin.ok]
    if not broken:
        return Reason.OK
    if any(margin.reason == Reason.BOUNDARY for margin in broken):
        return Reason.BOUNDARY
    return max(broken, key=lambda margin: margin.severity).reason
