"""Plot of a sampled trajectory, in the form of the plots of plans."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cnpgen.judges.plans.plan_plot import PLOT_SAMPLES, draw_path
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import place_obstacles
from cnpgen.trajectory.sampled_trajectory import Trajectory
from cnpgen.world.path import PathWorld


def plot_trajectory(
    problem: Problem,
    robot: Robot,
    trajectory: Trajectory,
    path: str | Path,
    *,
    title: str,
    margins: Sequence[Margin] = (),
) -> None:
    """Draw a sampled trajectory as ``plot_plan`` draws plans, by the interpolation that its derivatives determine.

    Args:
        problem: The problem.
        robot: Its robot.
        trajectory: The trajectory.
        path: Image file, ``.png``, ``.pdf`` or ``.svg``; overwritten if it exists.
        title: Title of the figure.
        margins: Violations to mark.

    Raises:
        MachineError: matplotlib is missing, or the file cannot be written.
    """
    times = np.clip([margin.time for margin in margins], 0, trajectory.duration)
    t = np.union1d(np.linspace(0, trajectory.duration, PLOT_SAMPLES), times)
    world = PathWorld(robot, problem.obstacle, problem.object_size)
    q, dq, ddq = (np.ascontiguousarray(values.T) for values in trajectory.states(t))
    jerk = np.ascontiguousarray(trajectory.jerks(t).T) if problem.uses_jerk else None
    parameters = np.empty(0) if trajectory.parameters is None else trajectory.parameters
    with np.errstate(all="ignore"):
        world.set_path(q, dq, ddq, np.append(place_obstacles(problem.obstacle), parameters), jerk)
    draw_path(problem, world, t / trajectory.duration, t, Path(path), scene=None, title=title, margins=margins)
