"""Verdict on a family of curves: valid if all of them are valid, invalid if none is, otherwise undecided.

It is the verdict on plans (``cnpgen.judges.plans``) with a bound of the error of every
value. Joint limits are proven from Bernstein coefficients, distances by interval
subdivision, and smooth conditions at samples and local maxima. A sampled trajectory
without phases has the share of its duration as phase.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, product
from typing import TypeVar, cast

import numpy as np

from cnpgen.addons.trajectories.curve_family import ORDERS, UNDEFINED, CurveFamily
from cnpgen.addons.trajectories.refuted_torques import TorqueLimit
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.trajectory_verdict import (
    DECIDING_ERROR,
    ConditionDecision,
    Decision,
    TrajectoryVerdict,
)
from cnpgen.addons.trajectories.uncertainty import uncertainty_of
from cnpgen.arrays import Array, Indices, Mask
from cnpgen.judges.plans.bernstein import Maximum, find_maximum
from cnpgen.judges.plans.continuous_collision import (
    check_continuous_collision,
    is_contact,
    pairs_of,
)
from cnpgen.judges.plans.evaluated_trajectory import EvaluatedTrajectory
from cnpgen.judges.plans.joint_limits import (
    ProvenJointLimits,
    joint_limits,
    quantity_of,
)
from cnpgen.judges.plans.judge import check_step
from cnpgen.judges.plans.local_maxima import check_local_maxima
from cnpgen.judges.plans.measure import (
    EvaluationContext,
    MeasuredCondition,
    by_name,
    evaluation_context,
)
from cnpgen.judges.plans.sampling import (
    MAX_DURATION_S,
    MAX_TIME_SAMPLES,
    Samples,
    times,
)
from cnpgen.judges.plans.verdict import ZERO_TOLERANCE, Margin, Reason
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import pose_width
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World

Kind = TypeVar("Kind", bound=Constraint)

MIN_SPAN_PARTS = 2  # between two knots


class FamilyJudge:
    """Judges families of curves of one problem, and reuses the memory of Pinocchio and Coal between calls.

    The step is the maximum time between checked times [s]; see ``check_step``.
    """

    def __init__(self, problem: Problem, robot: Robot, *, step: float = 1e-3) -> None:
        check_step(step)
        self._problem = problem
        self._robot = robot
        self._step = step
        self._world, self._moved = (
            PathWorld(robot, problem.obstacle, problem.object_size) for _ in range(2)
        )
        self._limits = joint_limits(problem, self._world)

    def limits(self, parameters: Array | None = None) -> ProvenJointLimits:
        """Return the joint limits of the problem with parameters of shape (p,), nominal by default."""
        names = self._problem.parameters.names
        return (
            self._limits
            if parameters is None
            else self._limits.scaled(dict(zip(names, parameters, strict=True)))
        )

    def constraints(self, kind: type[Kind]) -> list[Kind]:
        """Return the constraints of a kind."""
        return [each for each in self._problem.constraint if type(each) is kind]

    def torque_limit(self) -> TorqueLimit | None:
        """Return the limit of torques of the rigid body at the joints, or None."""
        constraint = next(iter(self.constraints(JointTorque)), None)
        if constraint is None:
            return None
        conditions = constraint.measured(cast(World, self._moved))
        name = JointTorque.condition_name
        condition = next((each for each in conditions if each.name == name), None)
        if condition is None:
            # Drives whose motors alone are limited.
            return None
        limit = condition.upper
        allowed = constraint.allowed(condition)
        return TorqueLimit(condition.name, constraint.reason, limit, allowed)

    def torques(
        self, q: Array, dq: Array, ddq: Array, parameters: Array | None = None
    ) -> Array:
        """Evaluate the inverse dynamics at K states of shape (K, n), shape (K, n) [N m]."""
        rows = None if parameters is None else parameters[None]
        tip = np.zeros((1, 3))
        poses = scene_of(self._problem, tip, tip, tip, rows).poses[0]
        q, dq, ddq = (np.ascontiguousarray(values.T) for values in (q, dq, ddq))
        self._moved.set_path(q, dq, ddq, poses, np.zeros_like(q))
        return np.ascontiguousarray(self._moved.torque.T)

    def __call__(
        self,
        family: CurveFamily,
        trajectory: Trajectory,
        *,
        scene: Array | None = None,
        smooth: CurveFamily | None = None,
        step: float | None = None,
    ) -> TrajectoryVerdict:
        """Judge one family; values that cannot be evaluated give an undecided verdict.

        The trajectory has the samples, with phases and parameters; without them, phases
        are shares of the duration, and parameters nominal. The scene has poses and
        sizes of the obstacles, then values for a constraint and parameters, shape
        (width,); by default, they follow from the ends of the curves and the
        parameters. Joint limits that ``smooth``, another curve at the same times,
        violates are not valid. The step replaces that of the judge [s].
        """
        if not family.duration < MAX_DURATION_S or len(family.t) > MAX_TIME_SAMPLES:
            reason = f"{Reason.TOO_LONG}: at most {MAX_DURATION_S:g} s and {MAX_TIME_SAMPLES:,} samples are judged"
            return TrajectoryVerdict(
                Decision.UNDECIDED, reason, duration=family.duration
            )
        # Overflows give inf or nan, which are detected.
        with np.errstate(all="ignore"):
            s = checked_phases(family, step or self._step)
            return self._judge(family, trajectory, s, scene, smooth)

    def _judge(
        self,
        family: CurveFamily,
        trajectory: Trajectory,
        s: Array,
        scene: Array | None,
        smooth: CurveFamily | None,
    ) -> TrajectoryVerdict:
        # Phase and time are proportional: both ends determine the table.
        table = np.array([[0.0, 1.0], [0.0, family.duration]])
        samples = Samples(s, times(s, table))
        states = family.evaluate(s, jerk=self._problem.uses_jerk)
        if not states.is_finite():
            return TrajectoryVerdict(
                Decision.UNDECIDED,
                Reason.NOT_FINITE,
                duration=family.duration,
                samples=len(s),
            )
        scenes = self._scenes(family, states, trajectory, scene)
        poses = scenes[0]
        self._world.set_path(states.q, states.dq, states.ddq, poses, states.jerk)
        phase_of = trajectory.phase_of()
        context = evaluation_context(
            self._problem, family, poses, self._world, samples, table, phase_of
        )
        errors = uncertainty_of(
            self._problem, family, self._moved, scenes, context.measured, s
        )
        measured = [errors.add(condition, s) for condition in context.measured]
        context = replace(context, measured=measured, with_uncertainty=errors.add)
        # Parameters such as velocity_factor may scale the limits.
        limits = self._limits.scaled(self._world.parameters.values)
        entries = [
            *_limit_entries(limits, family, smooth, samples),
            *_measured_entries(context),
        ]
        names = list(by_name([entry.margin for entry in entries]))
        # Conditions of one name get numbered names, in the order of the entries.
        return _verdict(dict(zip(names, entries, strict=True)), family.duration, len(s))

    def _scenes(
        self,
        family: CurveFamily,
        states: EvaluatedTrajectory,
        trajectory: Trajectory,
        scene: Array | None,
    ) -> list[Array]:
        """Return the scene of the nominal curve, then those of other curves of the family, shape (width,) each."""
        if scene is not None:
            return [scene]
        parameters = trajectory.parameters
        poses = self._obstacle_poses(states.q, states.dq, parameters)
        scenes = [poses, *self._possible_scenes(family, states, poses, parameters)]
        # Poses that the samples state replace those that follow from the ends of the
        # curve.
        if (placed := trajectory.obstacle_poses) is not None:
            for each in scenes:
                each[: len(placed)] = placed
        return scenes

    def _obstacle_poses(self, q: Array, dq: Array, parameters: Array | None) -> Array:
        """Place the obstacles, and the puck of a hit, by the tip at both ends."""
        (ends, speeds), still = (
            (np.ascontiguousarray(x[:, [0, -1]]) for x in (q, dq)),
            np.zeros((len(q), 2)),
        )
        # The tip depends on the joints alone, so its scene may have any ends.
        poses = scene_of(self._problem, *np.zeros((3, 1, 3))).poses[0]
        self._world.set_path(ends, speeds, still, poses, still)
        start, goal = self._world.tip_position.T[:, None].copy()
        rows = None if parameters is None else parameters[None]
        return np.asarray(
            scene_of(
                self._problem, start, goal, self._world.tip_velocity[:, 1:].T, rows
            ).poses[0]
        )

    def _possible_scenes(
        self,
        family: CurveFamily,
        states: EvaluatedTrajectory,
        poses: Array,
        parameters: Array | None,
    ) -> list[Array]:
        """Return scenes whose values of the motion, such as a puck, are those of other curves of the family."""
        if self._problem.scene_constraint is None:
            return []
        position, velocity, acceleration = (bound[-1] for bound in family.bounds[:3])
        if (acceleration >= UNDEFINED).all():
            # Velocities jump between spans.
            # The jump at the last knot but one is a further error of the final
            # velocity.
            velocity = velocity + np.abs(
                states.dq[:, -1] - family.polynomials.dq[-1, max(len(family.t) - 3, 0)]
            )
        scenes = []
        known = pose_width(self._problem.obstacle)
        for (order, bound), sign in product(
            {"q": position, "dq": velocity}.items(), (-1.0, 1.0)
        ):
            if not bound.any():
                continue
            # All joints together first, then each alone.
            for joint in (None, *np.flatnonzero(bound).tolist()):
                ends = {
                    name: getattr(states, name)[:, [0, -1]].copy()
                    for name in ("q", "dq")
                }
                moved = slice(None) if joint is None else joint
                ends[order][moved, -1] += sign * bound[moved]
                scene = self._obstacle_poses(ends["q"], ends["dq"], parameters)
                # Poses and sizes stay; only the values behind them follow the motion.
                scenes.append(np.concatenate([poses[:known], scene[known:]]))
        return scenes


def checked_phases(family: CurveFamily, step: float) -> Array:
    """Return phases at and between the knots, with both sides of every knot, at steps of at most ``step`` [s]."""
    # About MAX_TIME_SAMPLES phases in all: spans of long motions get coarser parts.
    count = max(1, int(np.ceil(MAX_TIME_SAMPLES / len(family.t))))
    parts = np.clip(
        np.ceil(np.diff(family.t) / step).astype(np.intp),
        MIN_SPAN_PARTS,
        count + MIN_SPAN_PARTS,
    )
    # The index in the span divided by its number of parts is the share of the span.
    first = np.repeat(np.cumsum(parts) - parts, parts)
    share = (np.arange(parts.sum()) - first) / np.repeat(parts, parts)
    low, high = (np.repeat(family.edges[k:][: len(parts)], parts) for k in (0, 1))
    inner = low + share * (high - low)
    return np.unique(
        # The largest number below a knot is its left side, where derivatives may jump.
        np.concatenate([inner, np.nextafter(family.edges[1:-1], 0.0), family.edges])
    )


def _decided(
    margin: Margin, error: float, certain: float, violated: float, undecided: float
) -> ConditionDecision:
    """Decide a condition by the worst margin of any curve and the largest relative violation that every curve has."""
    if margin.ok:
        decision = Decision.VALID
        reason = ""
    elif certain > 1:
        decision = Decision.INVALID
        reason = margin.reason
    else:
        decision = Decision.UNDECIDED
        reason = _doubt(margin, error)
    return ConditionDecision(decision, reason, margin, error, violated, undecided)


def _doubt(margin: Margin, error: float) -> str:
    """Return why a condition is undecided."""
    if error >= DECIDING_ERROR:
        return f"{margin.name}: the curve lacks a derivative at its samples"
    if error == 0:
        return f"{margin.name}: the bound depends on the phase, which the samples do not have"
    return f"{margin.name}: known up to {error:.2g} {margin.unit}, which some curves need to be valid"


def _share(mask: Mask, t: Array) -> float:
    """Return the share of time in which a condition holds at both ends of the intervals between times."""
    return float(np.diff(t) @ (mask[1:] & mask[:-1])) / float(t[-1])


def _limit_entries(
    limits: ProvenJointLimits,
    family: CurveFamily,
    smooth: CurveFamily | None,
    samples: Samples,
) -> Iterator[ConditionDecision]:
    """Decide the joint limits.

    A violation by the smooth curve leaves a limit undecided.
    """
    curves = [family] if smooth is None else [family, smooth]
    states = [curve.evaluate(samples.s, jerk=True) for curve in curves]
    bounds_at = family.bounds_at(samples.s)
    for limit, constraint in enumerate(limits.constraints):
        order = ORDERS.index(quantity_of(constraint))
        worst, certain = _proven_violations(limits, limit, curves, order)
        margin = limits.margin_at(limit, worst, float(worst[2] * family.duration))
        # Shares of time are measured at the samples.
        possible, least = _sampled_violations(
            limits,
            limit,
            [getattr(state, ORDERS[order]) for state in states],
            bounds_at[order],
        )
        yield _decided(
            margin,
            _uncertainty_at(curves, order, worst[1] % len(limits.joints), worst[2]),
            certain,
            _share(least > 1, samples.t),
            _share((possible > 1) & (least <= 1), samples.t),
        )


def _proven_violations(
    limits: ProvenJointLimits, limit: int, curves: Sequence[CurveFamily], order: int
) -> tuple[Maximum, float]:
    """Return the largest violation of a limit by any curve, and that which every curve has at least.

    They are relative to the tolerance: above 1 they count.
    """
    family = curves[0]
    scale = limits.scale[limit]
    rows = _sides(limits)
    nominal, *others = (
        (getattr(curve.polynomials, ORDERS[order])[..., rows] - limits.bounds[limit])
        / scale
        for curve in curves
    )
    # The scale has the sign of the side of the limit.
    error = family.bounds[order][:, rows] / np.abs(scale)
    # The worst of all curves: nominal plus error.
    possible = find_maximum(nominal + error, family.edges)
    for other in others:
        possible = find_maximum(other, family.edges, possible)
    # What every curve violates at least: nominal minus error.
    return possible, find_maximum(nominal - error, family.edges)[0]


def _sampled_violations(
    limits: ProvenJointLimits, limit: int, values: Sequence[Array], error: Array
) -> tuple[Array, Array]:
    """Return the largest relative violations at the samples by any curve, and by every curve, shape (K,) each.

    The values of the family and of another curve, and the errors of the family, have
    shape (n, K).
    """
    scale = limits.scale[limit]
    rows = _sides(limits)
    at, *others = ((each[rows].T - limits.bounds[limit]) / scale for each in values)
    error_at = error[rows].T / np.abs(scale)
    highest = np.max([at + error_at, *others], axis=(0, 2))
    return np.asarray(highest), np.asarray((at - error_at).max(axis=1))


def _sides(limits: ProvenJointLimits) -> Indices:
    """Return the joints of the lower limits, then of the upper ones, shape (2 n,)."""
    n = len(limits.joints)
    return np.arange(2 * n) % n


def _uncertainty_at(
    curves: Sequence[CurveFamily], order: int, joint: int, phase: float
) -> float:
    """Return the error of a joint's value at a phase; the curves of both interpolations differ, which is one, too."""
    family = curves[0]
    at = np.array([phase])
    values = [
        getattr(curve.evaluate(at, jerk=True), ORDERS[order])[joint, 0]
        for curve in curves
    ]
    return max(float(family.bounds_at(at)[order][joint, 0]), float(np.ptp(values)))


def _measured_entries(context: EvaluationContext) -> list[ConditionDecision]:
    """Decide the measured conditions; the world of the context is moved."""
    t = context.samples.t
    samples = context.samples
    worst = {
        id(condition): condition.margin(context.problem, samples)
        for condition in context.measured
    }
    certain = {}
    masks = {}
    for condition in context.measured:
        # Shares of time are measured at the samples, before the world moves.
        violated, possible = _violation_masks(context, condition)
        masks[id(condition)] = _share(violated, t), _share(possible & ~violated, t)
        certain[id(condition)] = float(_certain(context, condition).max())
    between = chain(
        check_continuous_collision(context, early_exit=False),
        check_local_maxima(context),
    )
    for condition, margin in between:
        key = id(condition)
        # That of the margin is at most as large.
        error = float(np.max(condition.uncertainty))
        worst[key] = max(worst[key], margin, key=lambda candidate: candidate.severity)
        if context.phase_of is not None or not condition.relaxation.any():
            # As in ``_certain``: a violation includes the error once.
            certain[key] = max(
                certain[key],
                (margin.violation - 2 * error) / max(margin.tolerance, ZERO_TOLERANCE),
            )
    entries = []
    for condition in context.measured:
        key = id(condition)
        error = _error_at(context, condition, worst[key])
        entries.append(_decided(worst[key], error, certain[key], *masks[key]))
    return entries


def _certain(context: EvaluationContext, condition: MeasuredCondition) -> Array:
    """Return the relative violations that every curve has, whatever its phases are if unknown, shape (m, K)."""
    excess: Array | float = 0.0
    if context.phase_of is None:
        # Bounds are widest at some phase.
        excess = condition.relaxation.max() - condition.relaxation
    # A violation includes the error once; subtracted twice, what every curve has is
    # left.
    certain = condition.violation - 2 * condition.uncertainty - excess
    return certain / np.maximum(condition.tolerance, ZERO_TOLERANCE)[:, None]


def _violation_masks(
    context: EvaluationContext, condition: MeasuredCondition
) -> tuple[Mask, Mask]:
    """Return masks of the samples that every curve violates, and that some curve violates, shape (K,)."""
    if is_contact(condition.constraint):
        pairs = pairs_of(context.world, condition.constraint)
        required = condition.condition.lower - condition.tolerance
        # A distance below the bound by more than the error is too small for every
        # curve.
        low = float(np.max(required - condition.uncertainty, initial=-np.inf))
        high = float(np.max(required + condition.uncertainty, initial=-np.inf))
        return ~pairs.clear_states(low), ~pairs.clear_states(high)
    possible = condition.relative_violation > 1
    return np.asarray((_certain(context, condition) > 1).any(axis=0)), np.asarray(
        possible.any(axis=0)
    )


def _error_at(
    context: EvaluationContext, condition: MeasuredCondition, margin: Margin
) -> float:
    """Return the error of a condition where a margin was measured."""
    uncertainty = condition.uncertainty
    if isinstance(uncertainty, float):
        return uncertainty
    # Between samples, the error of the nearest one is reported.
    k = int(np.abs(context.samples.s - margin.phase).argmin())
    return float(np.asarray(uncertainty)[:, k].max())


def _verdict(
    conditions: dict[str, ConditionDecision], duration: float, samples: int
) -> TrajectoryVerdict:
    """Combine the decisions on all conditions."""
    for decision in (Decision.INVALID, Decision.UNDECIDED):
        deciding: Sequence[ConditionDecision] = [
            c for c in conditions.values() if c.decision == decision
        ]
        if deciding:
            worst = max(deciding, key=lambda entry: entry.margin.severity)
            return TrajectoryVerdict(
                decision, worst.reason, conditions, duration, samples
            )
    return TrajectoryVerdict(Decision.VALID, "", conditions, duration, samples)
