"""What a motion is worth, by the definitions of the paper's tables."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.sampling import Samples
from cnpgen.judges.plans.verdict import Metrics
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.constraints.vertical import Vertical
from cnpgen.problems.problem import Problem
from cnpgen.world.path import PathWorld

Array = NDArray[np.float64]


def metrics_of(problem: Problem, world: PathWorld, samples: Samples, jerk: Array) -> Metrics:
    """Compute the metrics of one motion.

    Args:
        problem: The problem.
        world: Its robot at the samples.
        samples: When they are.
        jerk: Joint jerks at the samples [rad/s^3], shape (n, K); nan where nobody knows.
    """
    robot = world.robot
    share = world.torque / robot.torque_limit[:, None]
    table = problem.first(Table)
    upright = any(isinstance(constraint, Vertical) for constraint in problem.constraint)
    return Metrics(
        duration=float(samples.t[-1]),
        effort=samples.integral(np.sum(share**2, axis=0)),
        jerk=float(np.max(np.abs(jerk) / robot.jerk_limit[:, None])),
        hit_speed=float(np.linalg.norm(world.tip_velocity_at(-1))),
        z_error=np.nan if table is None else samples.integral(np.abs(world.tip_position[2] - table.z)),
        vertical_error=samples.integral(tilt(world.tip_rotation)) if upright else np.nan,
    )


def tilt(R: Array) -> Array:
    """|roll| + |pitch| of rotations ``Rz(yaw) Ry(pitch) Rx(roll)`` [rad], shape (3, 3, K) -> (K,)."""
    return np.asarray(np.abs(np.arctan2(R[2, 1], R[2, 2])) + np.abs(np.arctan2(R[2, 0], np.hypot(R[2, 1], R[2, 2]))))
