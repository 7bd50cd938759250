"""Check of the plans in rows of a certified dataset: their verdicts and stored durations."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.judge import judge
from cnpgen.judges.rows.verify import OBSTACLE_POSES
from cnpgen.problems.obstacles import goal_velocities, scene_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion


@dataclass(frozen=True)
class PlanCheck:
    """Number of plans in rows of a certified dataset, number of valid ones, and error messages of one line."""

    judged: int = 0
    valid: int = 0
    problems: tuple[str, ...] = ()


def check_plans(problem: Problem, robot: Robot, columns: Mapping[str, NDArray[Any]]) -> PlanCheck:
    """Judge the plans in columns of a certified dataset, field -> values; rows of other datasets have none."""
    if "path_control_points" not in columns:
        return PlanCheck()
    rows, spec = len(columns["start_q"]), problem.trajectory
    path = columns["path_control_points"].reshape(rows, spec.path_control_points, robot.n)
    motion = Motion(path, columns["rate_control_points"], spec.degree)
    boundary = Boundary.from_batch(columns, None)
    velocity = goal_velocities(problem, robot, boundary.goal_q, boundary.goal_dq)
    poses = columns.get(OBSTACLE_POSES)
    scene = scene_of(
        problem, columns["start_xyz"], columns["goal_xyz"], velocity, boundary.parameters, obstacle_poses=poses
    )
    verdicts = judge(problem, robot, motion, boundary, scene, columns["goal_xyz"])
    invalid = [(row, verdict.reason) for row, verdict in enumerate(verdicts) if not verdict.valid]
    problems = []
    if invalid:
        row, reason = invalid[0]
        problems.append(f"{len(invalid)} of {rows} plans are not valid, the first one is that of row {row}: {reason}")
    if not np.allclose(columns["duration"], motion.duration(), rtol=1e-9, atol=0):
        problems.append("stored durations differ from those of the plans")
    return PlanCheck(rows, rows - len(invalid), tuple(problems))
