"""The scene of a page: the robot, and one or more views of it with obstacles, curves and the verdict."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.cli.view.view_bodies import Body, capsule_bodies, robot_bodies, tube, wrapped
from cnpgen.cli.view.view_verdict import view_verdict
from cnpgen.judges.plans.condition_curves import ConditionCurve, condition_curves
from cnpgen.judges.plans.plan_plot import along, shares_of_limits
from cnpgen.judges.plans.verdict import Reason, Verdict
from cnpgen.judges.trajectories.trajectory_plot import along_trajectory
from cnpgen.judges.trajectories.trajectory_verdict import TrajectoryVerdict
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.puck_contact import PUCK_OUT_OF_REACH_M, PuckContact
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.obstacles import scene_of, table_frame_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import PARKED_POSITION_M, Scene
from cnpgen.robots.shape.hull import CUBE
from cnpgen.robots.solid import pose_width
from cnpgen.trajectory.sampled_trajectory import Trajectory
from cnpgen.world.forward_kinematics import ForwardKinematics
from cnpgen.world.path import PathWorld

Array = NDArray[np.float64]

FRAMES_PER_MOTION = 240
MIN_DRAWN_HEIGHT_M = 0.1  # of obstacles without a lower end, which are drawn down to the floor
DRAWN_TABLE_M = 5e-3  # thickness of a drawn table
TIP_PATH_RADIUS_M = 4e-3
TRIAD_LENGTH_M, TRIAD_RADIUS_M = 0.12, 4e-3  # axes of a drawn frame
PUCK_HEIGHT_M, MALLET_HEIGHT_M = 0.012, 0.05
DISC_CORNERS = 48


@dataclass(frozen=True)
class View:
    """A plan, a sample or a configuration of the robot.

    Attributes:
        title: Title.
        labels: Label of each of the K frames: its time, "start" or "goal".
        times: Times of the frames [s], shape (K,); 0, 1, ... without a motion.
        q: Joint positions [rad], shape (n, K).
        poses: Poses of the joints, the universe first and the tip last, shape (K, joints, 4, 4).
        world: Obstacles, the table and the puck.
        path: Path of the tip, of a motion.
        shares: Quantity -> share of the limits, shape (n, K); empty without a motion.
        conditions: Curves of the other conditions; empty without a motion.
        verdict: The verdict for JSON; None without a motion.
    """

    title: str
    labels: tuple[str, ...]
    times: Array
    q: Array
    poses: Array
    world: tuple[Body, ...]
    path: tuple[Body, ...]
    shares: dict[str, Array]
    conditions: tuple[ConditionCurve, ...]
    verdict: dict[str, Any] | None


@dataclass(frozen=True)
class ViewScene:
    """The content of a page.

    Attributes:
        robot: The robot.
        bodies: Bodies of the robot.
        kind: Their kind: "meshes", "convex parts" or "line".
        capsules: Capsules around its links.
        held: The held object, in the tip's frame.
        mallet: The mallet, relative to the position of the tip.
        triad: Axes of a frame, in the tip's frame.
        views: The views, one or more.
        first_row: Row of the first view.
        n_rows: Number of rows that the source has.
    """

    robot: Robot
    bodies: tuple[Body, ...]
    kind: str
    capsules: tuple[Body, ...]
    held: tuple[Body, ...]
    mallet: tuple[Body, ...]
    triad: tuple[Body, ...]
    views: tuple[View, ...]
    first_row: int = 0
    n_rows: int = 1


def scene_of_problem(problem: Problem, robot: Robot) -> ViewScene:
    """Show a robot in its base configuration."""
    q = robot.base[:, None]
    tip = _poses(robot, q)[:, -1, :3, 3]
    scene = scene_of(problem, tip, tip, np.zeros((1, 3)))
    view = _still(problem, robot, f"{problem.name}: base configuration", q, ("base",), scene)
    return _scene(problem, robot, [view], with_meshes=True)


def scene_of_plans(
    problem: Problem,
    robot: Robot,
    plans: Plans,
    titles: Sequence[str],
    verdicts: Sequence[Verdict | None],
    *,
    with_meshes: bool,
) -> ViewScene:
    """Show motions or, of rows without a plan, which have no verdict, their starts and goals."""
    scene = plans.scene
    views = [
        _view(problem, robot, plans[i : i + 1], titles[i], verdicts[i], scene[i : i + 1]) for i in range(len(plans))
    ]
    return _scene(problem, robot, views, with_meshes=with_meshes)


def scene_of_trajectories(
    problem: Problem,
    robot: Robot,
    trajectories: Sequence[Trajectory],
    titles: Sequence[str],
    verdicts: Sequence[TrajectoryVerdict],
) -> ViewScene:
    """Show sampled trajectories, by the interpolation that their derivatives determine."""
    views = []
    for trajectory, title, verdict in zip(trajectories, titles, verdicts, strict=True):
        margins = {name: entry.margin for name, entry in verdict.conditions.items()}
        extra = [margin.time for margin in margins.values() if not margin.ok]
        with np.errstate(all="ignore"):
            world, s, times, scene = along_trajectory(
                problem, robot, trajectory, samples=FRAMES_PER_MOTION, extra_times=extra
            )
            shown = Verdict(Reason.OK if verdict.valid else str(verdict), margins)
            views.append(_moving(problem, robot, world, s, times, scene, title, shown))
    return _scene(problem, robot, views, with_meshes=True)


def _view(  # noqa: PLR0917 - all of them are shown
    problem: Problem, robot: Robot, plan: Plans, title: str, verdict: Verdict | None, scene: Scene
) -> View:
    """Show one motion, or its start and goal if there is none or it cannot be evaluated."""
    if verdict is None or not verdict.margins:
        boundary = plan.boundary
        q = np.array([boundary.start_q[0], boundary.goal_q[0]]).T
        rejected = None if verdict is None else {"valid": False, "reason": str(verdict.reason), "causes": ()}
        return _still(problem, robot, title, q, ("start", "goal"), scene, rejected)
    extra = [margin.time for margin in verdict.margins.values() if not margin.ok]
    world, s, times = along(problem, robot, plan.motion, 0, samples=FRAMES_PER_MOTION, extra_times=extra, scene=scene)
    return _moving(problem, robot, world, s, times, scene, title, verdict)


def _moving(  # noqa: PLR0917 - all of them are shown
    problem: Problem,
    robot: Robot,
    world: PathWorld,
    s: Array,
    times: Array,
    scene: Scene,
    title: str,
    verdict: Verdict,
) -> View:
    """Show one motion at phases s and times [s], shape (K,)."""
    curves = condition_curves(problem, world, s, scene.bodies())
    poses = _poses(robot, world.q)
    return View(
        title=title,
        labels=tuple(f"{time:.3f} s" for time in times),
        times=times,
        q=world.q,
        poses=poses,
        world=tuple(_world(problem, scene)),
        path=(tube("path of the tip", poses[:, -1, :3, 3], TIP_PATH_RADIUS_M),),
        shares=shares_of_limits(world),
        conditions=tuple(curves),
        verdict=view_verdict(verdict, curves, times, poses, robot.joint_names),
    )


def _still(  # noqa: PLR0917 - all of them are shown
    problem: Problem,
    robot: Robot,
    title: str,
    q: Array,
    labels: tuple[str, ...],
    scene: Scene,
    verdict: dict[str, Any] | None = None,
) -> View:
    """Show configurations without a motion."""
    times, world = np.arange(float(len(labels))), tuple(_world(problem, scene))
    return View(title, labels, times, q, _poses(robot, q), world, (), {}, (), verdict)


def _scene(problem: Problem, robot: Robot, views: list[View], *, with_meshes: bool) -> ViewScene:
    bodies, kind = robot_bodies(problem, robot, with_meshes=with_meshes)
    size, contact, tip = problem.object_size, problem.first(PuckContact), robot.n + 1
    disc = None if contact is None else _disc_corners(np.zeros(3), contact.mallet_radius, MALLET_HEIGHT_M)
    return ViewScene(
        robot=robot,
        bodies=tuple(bodies),
        kind=kind,
        capsules=tuple(capsule_bodies(robot)),
        held=() if size is None else (wrapped("object", tip, CUBE * np.array(size), 0.0),),
        mallet=() if disc is None else (wrapped("mallet", tip, disc, 0.0),),
        triad=tuple(
            wrapped(f"axis {name}", tip, np.array([np.zeros(3), TRIAD_LENGTH_M * axis]), TRIAD_RADIUS_M)
            for name, axis in zip("xyz", np.eye(3), strict=True)
        ),
        views=tuple(views),
    )


def _poses(robot: Robot, q: Array) -> Array:
    """Return the poses of all joints and of the tip at K states, shape (K, n + 2, 4, 4)."""
    n = robot.n
    rotations, positions = ForwardKinematics(robot.model).poses(q)
    poses = np.zeros((q.shape[1], n + 2, 4, 4))
    for joint, (rotation, position) in enumerate(zip(rotations, positions, strict=True)):
        poses[:, joint, :3, :3], poses[:, joint, :3, 3] = rotation.transpose(2, 0, 1), position.T
    poses[..., 3, 3] = 1.0
    poses[:, -1] = poses[:, n] @ robot.model.frames[robot.tip_frame].placement.homogeneous
    return poses


def _world(problem: Problem, scene: Scene) -> Iterator[Body]:
    """Draw obstacles, a table and a puck."""
    for obstacle, solid in zip(scene.obstacles, scene.bodies(), strict=True):
        if solid.position[2] <= PARKED_POSITION_M[2]:  # the plan has fewer obstacles than the problem
            continue
        if obstacle.upright and obstacle.height is None:
            bottom = min(0.0, solid.high[2] - MIN_DRAWN_HEIGHT_M)
            yield wrapped(obstacle.name, 0, _corners(np.array([*solid.low[:2], bottom]), solid.high), 0.0)
        else:
            yield wrapped(obstacle.name, 0, solid.position + solid.corners, solid.radius)
    contact, table = problem.first(PuckContact), problem.first(Table)
    if table is not None:
        values = scene.poses[0, problem.scene_width - len(problem.parameters) :]
        low, high = table.bounds_of(dict(zip(problem.parameters.names, values.tolist(), strict=True)))
        corners = _corners(np.array([*low, table.z - DRAWN_TABLE_M]), np.array([*high, table.z]))
        yield wrapped("table", 0, _on_table(problem, scene, corners), 0.0)
    if contact is not None:
        x, y = scene.poses[0, pose_width(scene.obstacles) :][2:4]
        if x < PUCK_OUT_OF_REACH_M:
            corners = _disc_corners(np.array([x, y, table.z if table else 0.0]), contact.puck_radius, PUCK_HEIGHT_M)
            yield wrapped("puck", 0, _on_table(problem, scene, corners), 0.0)


def _on_table(problem: Problem, scene: Scene, corners: Array) -> Array:
    """Return corners in the frame of the table in the world frame [m], shape (V, 3)."""
    parameters = np.repeat(scene.poses[:1, problem.scene_width - len(problem.parameters) :], len(corners), axis=0)
    frame = table_frame_of(problem, parameters)
    return corners if frame is None else frame.to_world(corners)


def _disc_corners(bottom: Array, radius: float, height: float) -> Array:
    """Return the corners of an upright disc on a point [m], shape (V, 3)."""
    angles = np.arange(DISC_CORNERS) * 2 * np.pi / DISC_CORNERS
    circle = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.zeros(DISC_CORNERS)])
    return np.asarray(bottom + np.concatenate([circle, circle + np.array([0, 0, height])]))


def _corners(low: Array, high: Array) -> Array:
    return np.asarray((low + high) / 2 + CUBE * (high - low))
