"""Verdict on samples: lower bounds refute, and a valid curve through the samples proves that a valid motion exists.

Lower bounds of every curve come first, in every mode: they end most faulty recordings.
Without a stated interpolation, curves within the errors of all samples are then judged
as plans are: the smooth curve through samples that resolve the motion, and the smoothest
spline within the errors. If neither is valid, every condition is decided for all curves
within the estimated errors of the samples' resolution. Exact positions without
derivatives at 100 Hz or more are connected by lines instead. Lines hide velocities
between samples, so joint limits must also hold for polynomials through the positions
around every span.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from cnpgen.addons.trajectories.contradicting_columns import (
    CONTRADICTION,
    explain_velocities,
)
from cnpgen.addons.trajectories.curve_family import CurveFamily
from cnpgen.addons.trajectories.interpolate import (
    data_of,
    family_of_data,
    interpolated,
    through_positions,
)
from cnpgen.addons.trajectories.judge_family import FamilyJudge
from cnpgen.addons.trajectories.limited_witness import limited_witness
from cnpgen.addons.trajectories.refuted_limits import (
    BOTH,
    VELOCITIES,
    RefutedLimit,
    absolute_limits,
    largest_values,
    refuted_limits,
)
from cnpgen.addons.trajectories.refuted_torques import refuted_torques
from cnpgen.addons.trajectories.resolved_curves import is_resolved, resolved_curves
from cnpgen.addons.trajectories.sample_errors import SampleErrors, is_negligible
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.smooth_curve import AccelerationLimits, smooth_curve
from cnpgen.addons.trajectories.trajectory_verdict import (
    ConditionDecision,
    Decision,
    TrajectoryVerdict,
)
from cnpgen.addons.trajectories.velocity_by_position import VelocityByPosition
from cnpgen.addons.trajectories.window_program import TorqueBounds
from cnpgen.addons.trajectories.witness import witness
from cnpgen.arrays import Array
from cnpgen.judges.plans.bernstein import find_maximum
from cnpgen.judges.plans.joint_limits import ProvenJointLimits, quantity_of
from cnpgen.judges.plans.judge import MAX_STEP_S

# Between exact positions that a controller connects by lines.

MAX_LINEAR_SPAN_S = 0.0101
SMOOTH_NEIGHBORS = 8  # positions that determine velocities between two of them
# Of the tolerance of accelerations and jerks that the smooth curve uses.
TOLERANCE_SHARE = 0.9
WITNESS_SHARES = 0.98, 0.9  # that a curve with limited accelerations uses
LINES = "the positions are connected by lines"
NO_JITTER_BOUND = "a jitter of the times needs limits of velocities and accelerations"
RESOLUTION = "errors between the samples are as estimated from their resolution"


def refute(
    judge: FamilyJudge, trajectory: Trajectory, errors: SampleErrors
) -> TrajectoryVerdict | None:
    """Return the verdict on samples through which no curve within the joint limits leads; None if bounds refute none."""
    limits = judge.limits(trajectory.parameters)
    alone = replace(trajectory, dq=None, ddq=None)
    # Bounds by positions alone come first: they hold whatever the velocities are.
    found = refuted_limits(limits, alone, errors)
    if found or trajectory.dq is None:
        found = found or _refuted_further(judge, trajectory, errors, limits)
        return _refutation(trajectory, found) if found else None
    found = refuted_limits(limits, trajectory, errors)
    if not found:
        found = _refuted_further(judge, trajectory, errors, limits)
        return _refutation(trajectory, found) if found else None
    # Positions alone refute nothing: velocities are at fault, or both columns disagree.
    worst = next((each for each in found if each.samples == BOTH), found[0])
    if worst.samples not in {BOTH, VELOCITIES}:
        return _refutation(trajectory, found)
    # A shift or a factor of the velocities may explain the contradiction.
    joint = limits.joints.index(worst.margin.part)
    text = explain_velocities(trajectory, errors, joint, limits.joints)
    if not text and worst.samples != BOTH:
        return _refutation(trajectory, found)
    detail = f"{worst.detail}; {text}" if text else worst.detail
    return _refutation(trajectory, [worst], CONTRADICTION, detail)


def judge_samples(
    judge: FamilyJudge,
    trajectory: Trajectory,
    errors: SampleErrors,
    *,
    scene: Array | None = None,
) -> TrajectoryVerdict:
    """Judge the motion that samples resolve.

    Jitter must be part of the errors of the values (``with_jitter``) but for the curves
    that meet samples within it. The scene is that of ``FamilyJudge``.
    """
    limits = judge.limits(trajectory.parameters)
    ends = acceleration_limits(limits)
    moved = with_jitter(errors, limits, trajectory)
    exact = is_negligible(moved, trajectory, ends.acceleration)
    detail = ""
    tries = _curves(judge, trajectory, errors, ends, exact=exact)
    for curve, step in tries:
        excess = _joint_limit_excess(curve, limits)
        if excess is None:
            verdict = judge(curve, trajectory, scene=scene, step=step)
            if verdict.valid:
                return verdict
            excess = ""
            if verdict.conditions:
                excess = str(verdict.conditions[verdict.decisive].margin)
        text = f"a smooth curve within the errors is not valid: {excess}"
        detail = text if excess else ""
    noise = np.zeros(3) if exact else moved.values
    if not np.isfinite(noise).all():
        return TrajectoryVerdict(
            Decision.UNDECIDED, NO_JITTER_BOUND, duration=trajectory.duration
        )
    # A controller connects positions that are so close by lines.
    is_dense = np.diff(trajectory.t).max() <= MAX_LINEAR_SPAN_S
    if exact and is_dense and trajectory.dq is None:
        line = interpolated(trajectory, "linear", noise)
        smooth = through_positions(trajectory, SMOOTH_NEIGHBORS)
        found = judge(line, trajectory, scene=scene, smooth=smooth)
        return _assuming(LINES, found, detail)
    family = resolved_curves(trajectory, noise, ends.acceleration)
    return _assuming(RESOLUTION, judge(family, trajectory, scene=scene), detail)


def _assuming(
    assumption: str, found: TrajectoryVerdict, detail: str
) -> TrajectoryVerdict:
    """Return a verdict under an assumption; an undecided one says why no valid motion was found."""
    undecided = found.decision == Decision.UNDECIDED
    return replace(found, assumption=assumption, detail=detail if undecided else "")


def with_jitter(
    errors: SampleErrors, limits: ProvenJointLimits, trajectory: Trajectory
) -> SampleErrors:
    """Return errors of values at the stated times: under the limits, a time within d moves a position by V d at most."""
    if not errors.t:
        return errors
    largest = largest_values(limits)
    names = ("dq", "ddq", "jerk")[: len(data_of(trajectory))]
    moved = [float(largest[name].max()) * errors.t for name in names]
    q, dq, ddq = errors.values + np.array([*moved, 0.0, 0.0])[:3]
    return replace(errors, q=float(q), dq=float(dq), ddq=float(ddq))


def acceleration_limits(
    limits: ProvenJointLimits, tolerance_share: float = TOLERANCE_SHARE
) -> AccelerationLimits:
    """Return the smallest acceleration and jerk limits of a problem with most of their tolerances."""
    # Limits of both signs may differ, and the curve uses one number for both.
    smallest = absolute_limits(limits, np.minimum, tolerance_share)
    return AccelerationLimits(
        np.maximum(smallest["ddq"], 0.0), np.maximum(smallest["jerk"], 0.0)
    )


def _curves(
    judge: FamilyJudge,
    trajectory: Trajectory,
    errors: SampleErrors,
    ends: AccelerationLimits,
    *,
    exact: bool,
) -> Iterator[tuple[CurveFamily, float | None]]:
    """Yield curves within the errors of all samples, with the step at which they are judged."""
    # Samples that resolve the motion determine one curve, which is tried before
    # splines.
    if exact and is_resolved(trajectory, ends.acceleration):
        if trajectory.ddq is not None:
            yield family_of_data(trajectory.t, data_of(trajectory)), None
        if (curve := smooth_curve(trajectory, ends)) is not None:
            yield curve, None
    if (curve := witness(trajectory, errors)) is None:
        return
    yield curve, MAX_STEP_S
    for share in WITNESS_SHARES:
        limits = judge.limits(trajectory.parameters)
        limit = acceleration_limits(limits, share).acceleration
        torques = _torque_bounds(judge, trajectory, share)
        curve = limited_witness(trajectory, errors, limit, torques)
        if curve is not None:
            yield curve, MAX_STEP_S


def _torque_bounds(
    judge: FamilyJudge, trajectory: Trajectory, tolerance_share: float
) -> TorqueBounds | None:
    """Return the torque limits with most of their tolerances, or None without any."""
    allowed = judge.torque_limit()
    if allowed is None:
        return None
    limit = allowed.limit + tolerance_share * allowed.tolerance
    return TorqueBounds(partial(judge.torques, parameters=trajectory.parameters), limit)


def _joint_limit_excess(curve: CurveFamily, limits: ProvenJointLimits) -> str | None:
    """Return the first joint limit that a curve exceeds, or None; Bernstein coefficients prove it at little cost."""
    n = len(limits.joints)
    for limit, constraint in enumerate(limits.constraints):
        values = getattr(curve.polynomials, quantity_of(constraint))
        violations = values[..., np.arange(2 * n) % n] - limits.bounds[limit]
        relative = violations / limits.scale[limit]
        maximum = find_maximum(relative, curve.edges, threshold=1.0)
        if maximum[0] > 1:
            time = maximum[2] * curve.duration
            return str(limits.margin_at(limit, maximum, time))
    return None


def _refuted_further(
    judge: FamilyJudge,
    trajectory: Trajectory,
    errors: SampleErrors,
    limits: ProvenJointLimits,
) -> list[RefutedLimit]:
    """Return the limit by position, or the torque limit, that no curve within the other joint limits meets."""
    largest = largest_values(limits)
    for each in judge.constraints(VelocityByPosition):
        if speed := each.refuted(trajectory, errors, largest["dq"], limits.joints):
            return [speed]
    allowed = judge.torque_limit()
    error = with_jitter(errors, limits, replace(trajectory, dq=None, ddq=None)).q
    if allowed is None or not np.isfinite(error):
        return []
    found = refuted_torques(
        partial(judge.torques, parameters=trajectory.parameters),
        allowed,
        trajectory.t,
        trajectory.q,
        error=error,
        largest=(largest["dq"], largest["ddq"]),
        joint_names=limits.joints,
    )
    return [] if found is None else [found]


def _refutation(
    trajectory: Trajectory,
    found: list[RefutedLimit],
    reason: str = "",
    detail: str = "",
) -> TrajectoryVerdict:
    """Return the verdict by refuted limits, of which the first decides."""
    conditions = {
        each.margin.name: ConditionDecision(
            Decision.INVALID,
            reason or each.margin.reason,
            each.margin,
            0.0,
            None,
            None,
            detail or each.detail,
        )
        # Two limits of one name: the worse one stays.
        for each in reversed(found)
    }
    first = conditions[found[0].margin.name]
    return TrajectoryVerdict(
        Decision.INVALID,
        first.reason,
        conditions,
        trajectory.duration,
        len(trajectory.t),
        first.detail,
    )
