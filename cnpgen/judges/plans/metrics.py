"""Metrics of plans, as defined in the paper's tables."""

import numpy as np

from cnpgen.arrays import Array
from cnpgen.judges.plans.sampling import Samples
from cnpgen.judges.plans.verdict import Metrics
from cnpgen.problems.constraints.axis import Vertical
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.world.path import PathWorld


def metrics_of(
    problem: Problem, world: PathWorld, samples: Samples, jerk: Array
) -> Metrics:
    """Compute the metrics of one motion from its joint jerks at the samples [rad/s^3], shape (n, K); nan if unknown."""
    robot = world.robot
    drive = robot.drive
    limit = robot.torque_limit if drive is None else drive.torque_limit
    torque_ratio = world.linear_torque / limit[:, None]
    table = problem.first(Table)
    tip = world.parameters.on_table(world.tip_position)
    upright = any(isinstance(constraint, Vertical) for constraint in problem.constraint)
    return Metrics(
        duration=float(samples.t[-1]),
        effort=samples.integral(np.sum(torque_ratio**2, axis=0)),
        jerk=float(np.max(np.abs(jerk) / robot.jerk_limit[:, None])),
        hit_speed=float(np.linalg.norm(world.tip_velocity_at(-1))),
        z_error=np.nan if table is None else samples.integral(np.abs(tip[2] - table.z)),
        vertical_error=samples.integral(
            tilt(world.parameters.along_upright(world.tip_rotation))
        )
        if upright
        else np.nan,
    )


def tilt(R: Array) -> Array:
    """Compute |roll| + |pitch| of rotations ``Rz(yaw) Ry(pitch) Rx(roll)`` [rad], shape (3, 3, K) -> (K,)."""
    return np.asarray(
        np.abs(np.arctan2(R[2, 1], R[2, 2]))
        + np.abs(np.arctan2(R[2, 0], np.hypot(R[2, 1], R[2, 2])))
    )
