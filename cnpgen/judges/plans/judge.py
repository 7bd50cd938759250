"""Independent check of plans with Pinocchio and Coal, on a fine time grid and between its samples.

It shares with the optimizers only the problem (bounds, tolerances, obstacle poses) and
the control points of motions: no kinematics, dynamics, distances or splines, and no
transcription.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import chain

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.judges.plans.bernstein import PiecewisePolynomials, knots, polynomials
from cnpgen.judges.plans.continuous_collision import check_continuous_collision
from cnpgen.judges.plans.evaluated_trajectory import (
    EvaluatedTrajectory,
    Phases,
    SplineCurve,
    evaluate_at_phases,
    evaluate_trajectory,
    jerks,
)
from cnpgen.judges.plans.joint_limits import ProvenJointLimits, joint_limits
from cnpgen.judges.plans.local_maxima import check_local_maxima
from cnpgen.judges.plans.measure import (
    EvaluationContext,
    boundary_margins,
    by_name,
    evaluation_context,
    measure,
)
from cnpgen.judges.plans.metrics import metrics_of
from cnpgen.judges.plans.sampling import (
    EARLY_EXIT_CELLS,
    MAX_DURATION_S,
    TABLE_CELLS,
    Samples,
    early_exit_phases,
    sample,
    time_table,
    times,
)
from cnpgen.judges.plans.scipy_splines import is_positive
from cnpgen.judges.plans.tracking_tube import TrackingError, TrackingTube
from cnpgen.judges.plans.verdict import Margin, Metrics, PaperRule, Reason, Verdict
from cnpgen.problems.problem import Problem
from cnpgen.problems.published_rules import find_rules
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.path import PathWorld

MAX_STEP_S = 0.01  # with longer steps the samples miss most of the motion
KINK_OFFSET = 1e-3  # in phase, between samples on either side of a kink
# Enough to refute most invalid plans.
_REFUTATION_PHASES = Phases(np.linspace(0, 1, 33))


def judge(  # noqa: PLR0917 - all of them are needed to interpret a plan
    problem: Problem,
    robot: Robot,
    motion: Motion,
    boundary: Boundary,
    scene: Scene,
    goal_xyz: Array,
    *,
    step: float = 1e-3,
    tracking_error: TrackingError | None = None,
) -> list[Verdict]:
    """Judge N plans independently of each other.

    A plan is valid if it meets its boundary conditions and violates no bound by more
    than its tolerance over the whole motion. Limits of joint positions, velocities,
    accelerations and jerks are proven for the whole motion (``bernstein``). The
    ``measured`` forms of all other constraints are evaluated with Pinocchio and Coal at
    samples with steps of at most ``step``, and more densely near both ends
    (``sampling``). Smooth conditions are then searched for local maxima that could
    change the verdict (``local_maxima``), and distances are checked between samples
    (``continuous_collision``). Values that cannot be evaluated give a verdict with that
    reason, not an exception.

    Args:
        problem: The problem.
        robot: Its robot.
        motion: N motions.
        boundary: Boundary conditions of the motions.
        scene: Obstacles of the N plans.
        goal_xyz: Tip positions at the goal [m], shape (N, 3).
        step: Time step [s].
        tracking_error: Largest tracking error of the joints [rad], one number or shape
            (n,): position constraints must hold for every state within it
            (``tracking_tube``). None for exact tracking.

    Raises:
        UsageError: Shapes do not match, the step is not positive or too long, or a
            tracking error is negative.
    """
    return Judge(problem, robot, step=step, tracking_error=tracking_error)(
        motion, boundary, scene, goal_xyz
    )


class Judge:
    """Judges plans of one problem as ``judge`` does, and reuses the memory of Pinocchio and Coal between calls.

    The arguments are those of ``judge``; the step is that of verdicts without early
    exit.
    """

    def __init__(
        self,
        problem: Problem,
        robot: Robot,
        *,
        step: float = 1e-3,
        tracking_error: TrackingError | None = None,
    ) -> None:
        check_step(step)
        self._problem = problem
        self._robot = robot
        self._step = step
        self._world = PathWorld(robot, problem.obstacle, problem.object_size)
        self._limits = joint_limits(problem, self._world)
        self._paper = find_rules("paper")
        self._tube = (
            None
            if tracking_error is None
            else TrackingTube(problem, robot, tracking_error)
        )
        if self._tube is not None:
            self._limits = self._tube.tighten(self._limits)

    def __call__(
        self,
        motion: Motion,
        boundary: Boundary,
        scene: Scene,
        goal_xyz: Array,
        *,
        early_exit: bool = False,
    ) -> list[Verdict]:
        """Judge N plans; arguments as of ``judge``.

        A verdict with early exit has neither metrics nor the paper's rule, and starts
        from fewer samples. Validity does not depend on that, but margins are less
        accurate.
        """
        plans = self._plans(motion, boundary, scene, goal_xyz)
        # Overflows give inf or nan, which are detected.
        with np.errstate(all="ignore"):
            return [self._judge(plan, early_exit=early_exit) for plan in plans]

    def refutes(
        self, motion: Motion, boundary: Boundary, scene: Scene, goal_xyz: Array
    ) -> list[bool]:
        """Return for N plans whether a few samples prove that they are invalid.

        False proves nothing.
        """
        plans = self._plans(motion, boundary, scene, goal_xyz)
        with np.errstate(all="ignore"):
            return [_is_refuted(plan, self._world) for plan in plans]

    def _judge(self, plan: "_Plan", *, early_exit: bool) -> Verdict:
        """Judge one plan."""
        if reason := _invalid_reason(plan):
            return Verdict(reason)
        cells = EARLY_EXIT_CELLS if early_exit else TABLE_CELLS
        table = time_table(plan.motion.rate[0], plan.motion.degree, cells=cells)
        sampled = _sampled(plan, table, None if early_exit else self._step)
        if sampled is None:
            return Verdict(
                Reason.TOO_LONG, metrics=Metrics(duration=float(table[1, -1]))
            )
        (states, samples), world = sampled, self._world
        if not states.is_finite():
            metrics = Metrics(duration=float(samples.t[-1]))
            return Verdict(Reason.NOT_FINITE, metrics=metrics, samples=len(samples.s))
        # With early exit, a lower bound that proves a sufficient distance takes the
        # place of the exact smallest one.
        world.set_path(
            states.q,
            states.dq,
            states.ddq,
            plan.obstacle_poses,
            states.jerk,
            exact=not early_exit,
        )
        metrics = Metrics()
        paper = None if self._paper is None else PaperRule()
        if not early_exit:
            jerk = jerks(plan.motion, samples.s)
            metrics = metrics_of(plan.problem, world, samples, jerk)
            paper = self._judge_by_paper(plan)
        margins = [
            *boundary_margins(states, plan.boundary, samples, world.robot),
            *self._constraint_margins(plan, samples, table, early_exit=early_exit),
        ]
        return Verdict(
            reason_of(margins), by_name(margins), metrics, paper, len(samples.s)
        )

    def _constraint_margins(
        self, plan: "_Plan", samples: Samples, table: Array, *, early_exit: bool
    ) -> list[Margin]:
        """Measure the constraints of the plan whose samples the world has; the world is moved."""
        # Proven limits use the polynomials of the motion; all other conditions its
        # samples.
        curve = SplineCurve(plan.motion)
        context = evaluation_context(
            plan.problem, curve, plan.obstacle_poses, self._world, samples, table
        )
        context = context if self._tube is None else self._tube.widen(context)
        motion = polynomials(plan.motion, jerk=plan.problem.uses_jerk)
        return _margins(context, motion, self._limits, early_exit=early_exit)

    def _judge_by_paper(self, plan: "_Plan") -> PaperRule | None:
        """Judge the plan whose samples the world has by the paper's rules, if they are installed."""
        if self._paper is None:
            return None
        finished, broken = self._paper.judge(
            plan.problem, self._world, plan.obstacle_poses, plan.goal_xyz
        )
        return PaperRule(finished, finished and not broken, broken)

    def _plans(
        self, motion: Motion, boundary: Boundary, scene: Scene, goal_xyz: Array
    ) -> "list[_Plan]":
        _check_shapes(self._robot, motion, boundary, scene, goal_xyz)
        return [
            _Plan(
                self._problem,
                motion[i : i + 1],
                boundary[i : i + 1],
                scene.poses[i],
                goal_xyz[i],
            )
            for i in range(len(motion))
        ]


def check_step(step: float) -> None:
    """Raise UsageError if a time step [s] is not above 0 and at most ``MAX_STEP_S``."""
    if not 0 < step <= MAX_STEP_S:
        raise UsageError(
            f"the time step must be above 0 and at most {MAX_STEP_S:g} s, got {step:g} s",
            concerns="step",
        )


@dataclass(frozen=True)
class _Plan:
    """One motion with its problem, boundary conditions, obstacle poses, shape (width,), and goal of the tip [m]."""

    problem: Problem
    motion: Motion
    boundary: Boundary
    obstacle_poses: Array
    goal_xyz: Array

    @property
    def spans(self) -> int:
        """Number of intervals between the knots of the finer spline."""
        return (
            int(max(self.motion.path.shape[1], self.motion.rate.shape[1]))
            - self.motion.degree
        )

    @property
    def corners(self) -> frozenset[float]:
        """Phases of kinks of constraints, two phases on either side of each, and the knots of both splines."""
        kinks = tuple(
            s for constraint in self.problem.constraint for s in constraint.kinks
        )
        return _corners(
            self.motion.path.shape[1],
            self.motion.rate.shape[1],
            self.motion.degree,
            kinks,
        )

    def is_finite(self) -> bool:
        arrays = (
            self.motion.path,
            self.motion.rate,
            self.obstacle_poses,
            self.goal_xyz,
            *vars(self.boundary).values(),
        )
        return bool(
            np.isfinite(
                np.concatenate([array.ravel() for array in arrays if array is not None])
            ).all()
        )


@lru_cache(maxsize=8)
def _corners(
    path_points: int, rate_points: int, degree: int, kinks: tuple[float, ...]
) -> frozenset[float]:
    """Return knots and two phases on either side of kinks, across which second differences estimate no derivative."""
    around_kinks = (s + k * KINK_OFFSET for s in kinks for k in range(-2, 3))
    return frozenset(knots(path_points, rate_points, degree).tolist()).union(
        around_kinks
    )


def _check_shapes(
    robot: Robot, motion: Motion, boundary: Boundary, scene: Scene, goal_xyz: Array
) -> None:
    n_plans = len(motion)
    n = robot.n
    expected = {
        "path control points": (motion.path, (n_plans, *motion.path.shape[1:2], n)),
        "rate control points": (motion.rate, (n_plans, *motion.rate.shape[1:2])),
        "goal_xyz": (goal_xyz, (n_plans, 3)),
        **{
            name: (values, (n_plans, n))
            for name, values in boundary.conditions().items()
        },
    }
    if len(scene) != n_plans:
        raise UsageError(
            f"must have {n_plans} samples, one for each plan, got {len(scene)}",
            argument="scene",
        )
    for name, (values, shape) in expected.items():
        if np.shape(values) != shape or len(shape) < 2:
            raise UsageError(
                f"{name} must have shape {shape} for {n_plans} plans of {n} joints, got {np.shape(values)}"
            )


def _margins(
    context: EvaluationContext,
    motion: PiecewisePolynomials,
    limits: ProvenJointLimits,
    *,
    early_exit: bool,
) -> list[Margin]:
    """Measure every constraint, at the samples and between them.

    The world of the context is moved.
    """
    proven = limits.margins(
        context.world, motion, context.samples.s, context.table, early_exit=early_exit
    )
    # The worst margin of each condition so far; margins between samples may replace it.
    worst = {
        id(condition): condition.margin(context.problem, context.samples)
        for condition in context.measured
    }
    between_samples = chain(
        check_continuous_collision(context, early_exit=early_exit),
        check_local_maxima(context),
    )
    for condition, margin in between_samples:
        worst[id(condition)] = max(
            worst[id(condition)], margin, key=lambda candidate: candidate.severity
        )
    # In the order of the problem's constraints, whichever check found the margin.
    margins: dict[int, list[Margin]] = {
        id(constraint): [] for constraint in context.problem.constraint
    }
    for constraint, margin in zip(limits.constraints, proven, strict=True):
        margins[id(constraint)].append(margin)
    for condition in context.measured:
        margins[id(condition.constraint)].append(worst[id(condition)])
    return [*chain.from_iterable(margins.values())]


def _is_refuted(plan: _Plan, world: PathWorld) -> bool:
    """Return whether the ends, or a constraint at one of a few phases, are violated."""
    if _invalid_reason(plan):
        return True
    # Times do not matter for a refutation, so the phases stand in for them.
    samples = Samples(_REFUTATION_PHASES.s, _REFUTATION_PHASES.s)
    states = evaluate_at_phases(
        plan.motion, _REFUTATION_PHASES, jerk=plan.problem.uses_jerk
    )
    if not states.is_finite():
        return True
    world.set_path(
        states.q, states.dq, states.ddq, plan.obstacle_poses, states.jerk, exact=False
    )
    start_tip = world.tip_position[:, 0]
    measured = chain.from_iterable(
        measure(each, world, samples.s, start_tip) for each in plan.problem.constraint
    )
    # Inverted comparison: a nan counts as a violation.
    if not all((condition.relative_violation <= 1).all() for condition in measured):
        return True
    return not all(
        margin.ok
        for margin in boundary_margins(states, plan.boundary, samples, world.robot)
    )


def _sampled(
    plan: _Plan, table: Array, step: float | None
) -> tuple[EvaluatedTrajectory, Samples] | None:
    """Choose samples with a maximum step and evaluate the motion there; None if its duration is too long.

    Without a step, for early exit, they are few phases, the same ones for every plan of
    a problem.
    """
    jerk = plan.problem.uses_jerk
    if step is not None:
        samples = sample(table, step, plan.spans, plan.corners)
        return (
            (evaluate_trajectory(plan.motion, samples.s, jerk=jerk), samples)
            if samples
            else None
        )
    # A nan duration is too long, too.
    if not table[1, -1] < MAX_DURATION_S:
        return None
    phases = early_exit_phases(plan.spans, plan.corners)
    if any(constraint.tolerance == 0 for constraint in plan.problem.constraint):
        # Needs the rounding of other verdicts.
        states = evaluate_trajectory(plan.motion, phases.s, jerk=jerk)
    else:
        states = evaluate_at_phases(plan.motion, phases, jerk=jerk)
    return states, Samples(phases.s, times(phases.s, table))


def _invalid_reason(plan: _Plan) -> Reason | None:
    """Return the reason for which a plan cannot be evaluated, or None."""
    if not plan.is_finite():
        return Reason.NOT_FINITE
    return None if is_positive(plan.motion.rate[0], plan.motion.degree) else Reason.RATE


def reason_of(margins: list[Margin]) -> str:
    """Return the reason of a verdict: boundary conditions first, then the constraint with the largest severity."""
    broken = [margin for margin in margins if not margin.ok]
    if not broken:
        return Reason.OK
    # A plan that starts elsewhere is not a plan for its problem, whatever else it
    # violates.
    if any(margin.reason == Reason.BOUNDARY for margin in broken):
        return Reason.BOUNDARY
    return max(broken, key=lambda margin: margin.severity).reason
