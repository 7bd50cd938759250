"""Ruckig (Berscheid and Kroeger, 2021): time-optimal motions between two states with limited jerk, joint by joint.

It regards the limits of velocity, acceleration and jerk, and neither obstacles nor the
table.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import (
    BenchmarkPlanner,
    Plan,
    Setting,
    distinct_times,
)
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.errors import requires_extra
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary

MIN_SPAN_S = 1e-6  # shorter spans of constant jerk are joined


@dataclass(frozen=True)
class Ruckig(BenchmarkPlanner):
    """Time-optimal motion with limited jerk in joint space, without regard to the table or obstacles (Ruckig)."""

    def prepare(self, setting: Setting) -> Plan:
        """Import Ruckig."""
        ruckig = load_ruckig()
        _, robot = open_problem(setting.problem)
        return lambda task: time_optimal_motion(ruckig, robot, task.boundary)


def load_ruckig() -> Any:
    """Import Ruckig; raise MissingExtraError if it is missing."""
    with requires_extra("benchmark", "Ruckig"):
        import ruckig
    return ruckig


def time_optimal_motion(
    ruckig: Any, robot: Robot, boundary: Boundary
) -> Trajectory | None:
    """Return the time-optimal motion of one boundary problem, or None if there is none within the limits.

    The acceleration at the goal is 0.
    """
    state = ruckig.InputParameter(robot.n)
    for name, values in (
        ("current_position", boundary.start_q[0]),
        ("current_velocity", boundary.start_dq[0]),
        ("current_acceleration", boundary.start_ddq[0]),
        ("target_position", boundary.goal_q[0]),
        ("target_velocity", boundary.goal_dq[0]),
        ("max_velocity", robot.velocity_limit),
        ("max_acceleration", robot.acceleration_limit),
        ("max_jerk", robot.jerk_limit),
    ):
        setattr(state, name, values.tolist())
    motion = ruckig.Trajectory(robot.n)
    try:
        result = ruckig.Ruckig(robot.n).calculate(state, motion)
    except ruckig.RuckigError:
        # The input is outside the limits.
        return None
    if result != ruckig.Result.Working or not motion.duration > 0:
        return None
    t = _knots(motion)
    q, dq, ddq = (
        np.array(part)
        for part in zip(*(motion.at_time(time) for time in t.tolist()), strict=True)
    )
    return Trajectory(t, q, dq, ddq)


def _knots(motion: Any) -> Array:
    """Return the times at which a jerk changes [s].

    Between them a quintic equals the motion.
    """
    times = [np.array([0.0, motion.duration])]
    for profile in motion.profiles[0]:
        times.append(
            profile.brake.duration + np.concatenate([[0.0], np.cumsum(profile.t)])
        )
        times.append(np.cumsum(profile.brake.t))
    t = np.clip(np.concatenate(times), 0.0, motion.duration)
    return distinct_times(t, MIN_SPAN_S)
