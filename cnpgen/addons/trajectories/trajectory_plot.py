"""Plot of a sampled trajectory, in the form of the plots of plans."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.documents import AnyPath
from cnpgen.judges.plans.plan_plot import PLOT_SAMPLES, draw_path, plot_times
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.robots.solid import place_obstacles
from cnpgen.world.path import PathWorld


def plot_trajectory(
    problem: Problem,
    robot: Robot,
    trajectory: Trajectory,
    path: AnyPath,
    *,
    title: str,
    margins: Sequence[Margin] = (),
) -> None:
    """Draw a sampled trajectory as ``plot_plan`` draws plans, by the interpolation that its derivatives determine.

    Violations to mark are given as margins.
    """
    times = [margin.time for margin in margins]
    with np.errstate(all="ignore"):
        world, s, t, scene = along_trajectory(
            problem, robot, trajectory, extra_times=times
        )
    draw_path(
        problem, world, s, t, Path(path), scene=scene, title=title, margins=margins
    )


def along_trajectory(
    problem: Problem,
    robot: Robot,
    trajectory: Trajectory,
    *,
    samples: int = PLOT_SAMPLES,
    extra_times: Sequence[float] = (),
) -> tuple[PathWorld, Array, Array, Scene]:
    """Place the robot along a trajectory as ``along``, among obstacles by its ends, which are returned, too.

    Accelerations and jerks of positions alone are nan: a line between samples has none.
    """
    t = plot_times(trajectory.duration, samples, extra_times)
    share = t / trajectory.duration
    phase_of = trajectory.phase_of()
    q, dq, ddq = (np.ascontiguousarray(values.T) for values in trajectory.states(t))
    jerk = np.ascontiguousarray(trajectory.jerks(t).T) if problem.uses_jerk else None
    if trajectory.dq is None:
        ddq = np.full_like(q, np.nan)
        jerk = None if jerk is None else ddq
    world = PathWorld(robot, problem.obstacle, problem.object_size)
    world.set_path(q, dq, ddq, place_obstacles(problem.obstacle), jerk)
    tip = world.tip_position.T
    velocity = world.tip_velocity.T
    parameters = None if trajectory.parameters is None else trajectory.parameters[None]
    poses = trajectory.obstacle_poses
    scene = scene_of(
        problem,
        tip[:1],
        tip[-1:],
        velocity[-1:],
        parameters,
        obstacle_poses=None if poses is None else poses[None],
    )
    world.set_path(q, dq, ddq, scene.poses[0], jerk)
    return world, share if phase_of is None else phase_of(share), t, scene
