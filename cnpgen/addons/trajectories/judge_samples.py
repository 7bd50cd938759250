"""Verdict on samples without a stated interpolation: what they resolve decides, and a valid curve through them proves.

A trajectory is valid if its samples resolve the motion and the smooth curve through
them is valid. At both ends this curve has the smallest changes of acceleration within
the limits, which samples of faster changes allow. Otherwise every condition is decided
for all curves within the errors of the samples' resolution. Exact positions without
derivatives at 100 Hz or more are connected by lines. Lines hide velocities between
samples, so joint limits must also hold for polynomials through the positions around
every span.
"""

import numpy as np
from numpy.typing import NDArray

from cnpgen.addons.trajectories.interpolate import (
    data_of,
    family_of_data,
    interpolated,
    through_positions,
)
from cnpgen.addons.trajectories.judge_family import FamilyJudge
from cnpgen.addons.trajectories.resolved_curves import is_resolved, resolved_curves
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.smooth_curve import AccelerationLimits, smooth_curve
from cnpgen.addons.trajectories.trajectory_verdict import TrajectoryVerdict
from cnpgen.judges.plans.joint_limits import ProvenJointLimits, quantity_of

Array = NDArray[np.float64]

# Between exact positions that a controller connects by lines.

MAX_LINEAR_SPAN_S = 0.0101
SMOOTH_NEIGHBORS = 8  # positions that determine velocities between two of them
# Of the tolerance of accelerations and jerks that the smooth curve uses.
TOLERANCE_SHARE = 0.9


def judge_samples(
    judge: FamilyJudge,
    trajectory: Trajectory,
    noise: Array,
    *,
    scene: Array | None = None,
) -> TrajectoryVerdict:
    """Judge the motion that samples resolve.

    The noise is the largest error of positions, velocities and accelerations [rad,
    rad/s, rad/s^2], shape (3,). For the scene see ``FamilyJudge``.
    """
    limits = acceleration_limits(judge.limits(trajectory.parameters))
    if (
        trajectory.dq is None
        and not noise.any()
        and np.diff(trajectory.t).max() <= MAX_LINEAR_SPAN_S
    ):
        line = interpolated(trajectory, "linear", noise)
        return judge(
            line,
            trajectory,
            scene=scene,
            smooth=through_positions(trajectory, SMOOTH_NEIGHBORS),
        )
    if not noise.any() and is_resolved(trajectory, limits.acceleration):
        curves = [smooth_curve(trajectory, limits)]
        if trajectory.ddq is not None:
            curves.insert(0, family_of_data(trajectory.t, data_of(trajectory)))
        for curve in curves:
            verdict = None if curve is None else judge(curve, trajectory, scene=scene)
            if verdict is not None and verdict.valid:
                return verdict
    return judge(
        resolved_curves(trajectory, noise, limits.acceleration), trajectory, scene=scene
    )


def acceleration_limits(limits: ProvenJointLimits) -> AccelerationLimits:
    """Return the smallest acceleration and jerk limits of a problem with most of their tolerances."""
    n = len(limits.joints)
    smallest = {"ddq": np.full(n, np.inf), "jerk": np.full(n, np.inf)}
    for constraint, bounds, tolerance in zip(
        limits.constraints, limits.bounds, limits.tolerance, strict=True
    ):
        quantity = quantity_of(constraint)
        if quantity in smallest:
            allowed = np.minimum(-bounds[:n], bounds[n:]) + TOLERANCE_SHARE * tolerance
            smallest[quantity] = np.minimum(
                smallest[quantity], np.maximum(allowed, 0.0)
            )
    return AccelerationLimits(smallest["ddq"], smallest["jerk"])
