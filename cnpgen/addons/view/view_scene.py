"""The scene of a page: the robot, and one or more views of it with obstacles, curves and the verdict."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.trajectory_plot import along_trajectory
from cnpgen.addons.trajectories.trajectory_verdict import TrajectoryVerdict
from cnpgen.addons.view.view_bodies import (
    Body,
    capsule_bodies,
    extent,
    planned_joints,
    robot_bodies,
    tube,
    wrapped,
)
from cnpgen.arrays import Array
from cnpgen.documents import JsonObject, Names
from cnpgen.judges.plans.condition_curves import (
    ConditionCurve,
    condition_curves,
    plot_unit,
)
from cnpgen.judges.plans.plan_plot import along, shares_of_limits
from cnpgen.judges.plans.verdict import Margin, Reason, Verdict
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.puck_contact import PUCK_OUT_OF_REACH_M, PuckContact
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.obstacles import scene_of, table_frame_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import PARKED_POSITION_M, Scene
from cnpgen.robots.shape.hull import CUBE
from cnpgen.world.forward_kinematics import ForwardKinematics
from cnpgen.world.path import PathWorld

FRAMES_PER_MOTION = 240
NOT_MEASURED = -np.inf  # violation of a condition that samples do not determine
# Of obstacles without a lower end, which are drawn down to the floor.
MIN_DRAWN_HEIGHT_M = 0.1
DRAWN_TABLE_M = 5e-3  # thickness of a drawn table
TIP_PATH_RADIUS_M = 4e-3
TRIAD_LENGTH_M, TRIAD_RADIUS_M = 0.12, 4e-3  # axes of a drawn frame
DRAWN_PUCK_HEIGHT_M = 0.012
DRAWN_MALLET_HEIGHT_M = 0.05
DISC_CORNERS = 48
SHARE_DIGITS = 4  # of shares of limits
CURVE_DIGITS = 5  # significant ones of conditions
_NOTES = {  # kind of the robot's bodies -> remark
    "meshes": "",
    "convex parts": "drawn with the convex parts of its collision geometry",
    "line": "drawn as the line through its joints' origins",
}


@dataclass(frozen=True)
class View:
    """A plan, a sample or a configuration of the robot, with the names that the script of the page has."""

    title: str
    labels: Sequence[str]  # of each of the K frames: its time, "start" or "goal"
    times: Sequence[float]  # times of the frames [s]; 0, 1, ... without a motion
    q: Array  # joint positions [rad], shape (K, n)
    # Transposed poses of the joints, the universe first and the tip last, shape (K,
    # joints, 4, 4).
    poses: Array
    world: Sequence[Body]  # obstacles, the table and the puck
    path: Sequence[Body] = ()  # path of the tip, of a motion
    # Quantities with their shares of the limits; empty without a motion.
    curves: Sequence[JsonObject] = ()
    # Curves of the other conditions; empty without a motion.
    conditions: Sequence[JsonObject] = ()
    verdict: JsonObject | None = None  # None without a motion


@dataclass(frozen=True)
class ViewScene:
    """The content of a page, with the names that its script has."""

    note: str  # remark about the bodies of the robot
    # Placements, axes and limits of the planned joints.
    joints: Sequence[JsonObject]
    tip: Sequence[float]  # pose of the tip in the frame of the last joint, by columns
    joints_and_tip: int  # number of poses of a frame
    robot: Sequence[Body]
    capsules: Sequence[Body]  # around the links of the robot
    held: Sequence[Body]  # the held object, in the tip's frame
    mallet: Sequence[Body]  # the mallet, relative to the position of the tip
    triad: Sequence[Body]  # axes of a frame, in the tip's frame
    centre: Sequence[float]  # centre of the box around the robot [m]
    size: float  # diagonal of the box [m]
    views: Sequence[View]  # one or more
    first_row: int = 0  # row of the first view
    n_rows: int = 1  # number of rows that the source has


def scene_of_problem(problem: Problem, robot: Robot) -> ViewScene:
    """Show a robot in its base configuration."""
    q = robot.home[:, None]
    tip = _poses(robot, q)[:, -1, :3, 3]
    scene = scene_of(problem, tip, tip, np.zeros((1, 3)))
    view = _still(
        problem, robot, f"{problem.name}: base configuration", q, ("base",), scene
    )
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
        _view(
            problem, robot, plans[i : i + 1], titles[i], verdicts[i], scene[i : i + 1]
        )
        for i in range(len(plans))
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
        margins = {
            name: entry.margin
            if entry.is_measured
            else replace(entry.margin, violation=NOT_MEASURED)
            for name, entry in verdict.conditions.items()
        }
        # Violations between the frames get frames of their own.
        extra = [margin.time for margin in margins.values() if not margin.ok]
        with np.errstate(all="ignore"):
            world, s, times, scene = along_trajectory(
                problem, robot, trajectory, samples=FRAMES_PER_MOTION, extra_times=extra
            )
            shown = Verdict(Reason.OK if verdict.valid else str(verdict), margins)
            views.append(_moving(problem, robot, world, s, times, scene, title, shown))
    return _scene(problem, robot, views, with_meshes=True)


def _view(  # noqa: PLR0917 - all of them are shown
    problem: Problem,
    robot: Robot,
    plan: Plans,
    title: str,
    verdict: Verdict | None,
    scene: Scene,
) -> View:
    """Show one motion, or its start and goal if there is none or it cannot be evaluated."""
    if verdict is None or not verdict.margins:
        boundary = plan.boundary
        q = np.array([boundary.start_q[0], boundary.goal_q[0]]).T
        rejected = (
            None
            if verdict is None
            else {"valid": False, "reason": str(verdict.reason), "causes": ()}
        )
        return _still(problem, robot, title, q, ("start", "goal"), scene, rejected)
    extra = [margin.time for margin in verdict.margins.values() if not margin.ok]
    world, s, times = along(
        problem,
        robot,
        plan.motion,
        0,
        samples=FRAMES_PER_MOTION,
        extra_times=extra,
        scene=scene,
    )
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
    curves = condition_curves(problem, world, s)
    shares = shares_of_limits(world)
    poses = _poses(robot, world.q)
    return View(
        title=title,
        labels=[f"{time:.3f} s" for time in times],
        times=times.tolist(),
        q=world.q.T,
        # Three.js reads matrices by columns.
        poses=poses.swapaxes(2, 3),
        world=list(_world(problem, scene)),
        path=[tube("path of the tip", poses[:, -1, :3, 3], TIP_PATH_RADIUS_M)],
        curves=[
            {"name": name, "shares": share.round(SHARE_DIGITS).tolist()}
            for name, share in shares.items()
            # Of positions alone, accelerations and torques are nan.
            if np.isfinite(share).any()
        ],
        conditions=[
            _condition(curve) for curve in curves if np.isfinite(curve.values).any()
        ],
        verdict=_verdict(verdict, curves, times, poses, robot.joint_names),
    )


def _verdict(
    verdict: Verdict,
    curves: Sequence[ConditionCurve],
    times: Array,
    poses: Array,
    joints: Sequence[str],
) -> JsonObject:
    """Return a verdict for JSON, its margins located in time and space, the largest violation first.

    The poses of the joints, the universe first and the tip last, have shape (K, joints,
    4, 4), the times [s] (K,).
    """
    by_name = {curve.name: curve for curve in curves}
    margins = sorted(verdict.margins.values(), key=lambda margin: -margin.severity)
    causes = []
    for margin in margins:
        # The nearest frame shows the margin.
        frame = int(np.abs(times - margin.time).argmin())
        point = _point(
            margin, by_name.get(margin.name), poses[frame], frame, joints
        ).tolist()
        name = f"{margin.name} {margin.part}".strip()
        text = _margin_text(margin)
        causes.append(
            {
                "name": name,
                "text": text,
                "frame": frame,
                "ok": margin.ok,
                "point": point,
            }
        )
    return {"valid": verdict.valid, "reason": str(verdict.reason), "causes": causes}


def _margin_text(margin: Margin) -> str:
    """Return a margin as text in the units of plots."""
    if margin.violation == NOT_MEASURED:
        return "not measured: the samples do not determine it"
    factor, unit = plot_unit(margin.unit)
    side = "outside" if margin.violation > 0 else "inside"
    amount = factor * abs(margin.violation)
    tolerance = factor * margin.tolerance
    return f"{amount:.3g} {unit} {side}, tolerance {tolerance:.3g} {unit}"


def _point(
    margin: Margin,
    curve: ConditionCurve | None,
    poses: Array,
    frame: int,
    joints: Sequence[str],
) -> Array:
    """Return the place of a margin [m], shape (3,): between the closest points, at the joint, or at the tip."""
    if curve is not None and curve.points is not None:
        return np.asarray(curve.points[frame].mean(axis=0))
    if margin.part in joints:
        return poses[1 + list(joints).index(margin.part), :3, 3]
    return poses[-1, :3, 3]


def _condition(curve: ConditionCurve) -> JsonObject:
    """Return a curve; bounds that do not exist are None."""
    return {
        "name": curve.label,
        "unit": curve.unit,
        "parts": curve.parts,
        "values": [_rounded(values) for values in curve.values],
        "lower": _rounded(curve.lower) if np.isfinite(curve.lower).all() else None,
        "upper": _rounded(curve.upper) if np.isfinite(curve.upper).all() else None,
        "tolerance": curve.tolerance,
        "violated": np.flatnonzero(curve.violated).tolist(),
        "points": curve.points,
        "pairs": curve.pairs,
    }


def _rounded(values: Array) -> list[float | None]:
    """Return values with ``CURVE_DIGITS`` significant digits, None for those that are not finite."""
    return [
        float(f"{value:.{CURVE_DIGITS}g}") if np.isfinite(value) else None
        for value in values.tolist()
    ]


def _still(  # noqa: PLR0917 - all of them are shown
    problem: Problem,
    robot: Robot,
    title: str,
    q: Array,
    labels: Names,
    scene: Scene,
    verdict: JsonObject | None = None,
) -> View:
    """Show configurations without a motion."""
    times = [float(frame) for frame in range(len(labels))]
    poses = _poses(robot, q).swapaxes(2, 3)
    return View(
        title, labels, times, q.T, poses, list(_world(problem, scene)), verdict=verdict
    )


def _scene(
    problem: Problem, robot: Robot, views: list[View], *, with_meshes: bool
) -> ViewScene:
    bodies, kind = robot_bodies(problem, robot, with_meshes=with_meshes)
    size = problem.object_size
    contact = problem.first(PuckContact)
    tip = robot.n + 1
    disc = (
        None
        if contact is None
        else _disc_corners(np.zeros(3), contact.mallet_radius, DRAWN_MALLET_HEIGHT_M)
    )
    # The index after the last joint is that of the tip.
    held = [] if size is None else [wrapped("object", tip, CUBE * np.array(size), 0.0)]
    joints, placement = planned_joints(robot)
    low, high = extent((*bodies, *held), views[0].poses[[0, -1]])
    axes = {
        f"axis {'xyz'[k]}": np.array([np.zeros(3), TRIAD_LENGTH_M * np.eye(3)[k]])
        for k in range(3)
    }
    return ViewScene(
        note=_NOTES[kind],
        joints=joints,
        tip=placement,
        joints_and_tip=tip + 1,
        robot=bodies,
        capsules=capsule_bodies(robot),
        held=held,
        mallet=[] if disc is None else [wrapped("mallet", tip, disc, 0.0)],
        triad=[
            wrapped(name, tip, ends, TRIAD_RADIUS_M, smooth=True)
            for name, ends in axes.items()
        ],
        centre=((low + high) / 2).tolist(),
        size=float(np.linalg.norm(high - low)),
        views=views,
    )


def _poses(robot: Robot, q: Array) -> Array:
    """Return the poses of all joints and of the tip at K states, shape (K, n + 2, 4, 4)."""
    n = robot.n
    rotations, positions = ForwardKinematics(robot.model).poses(q)
    poses = np.zeros((q.shape[1], n + 2, 4, 4))
    for joint, (rotation, position) in enumerate(
        zip(rotations, positions, strict=True)
    ):
        poses[:, joint, :3, :3] = rotation.transpose(2, 0, 1)
        poses[:, joint, :3, 3] = position.T
    poses[..., 3, 3] = 1.0
    # The pose of the tip is that of the last joint times a fixed placement.
    poses[:, -1] = (
        poses[:, n] @ robot.model.frames[robot.tip_frame].placement.homogeneous
    )
    return poses


def _world(problem: Problem, scene: Scene) -> Iterator[Body]:
    """Draw obstacles, a table and a puck."""
    for obstacle, solid in zip(scene.obstacles, scene.bodies(), strict=True):
        if solid.position[2] <= PARKED_POSITION_M[2]:
            # The plan has fewer obstacles than the problem.
            continue
        if obstacle.upright and obstacle.height is None:
            # Obstacles without a lower end are drawn from the floor, or from below
            # their top.
            bottom = min(0.0, solid.high[2] - MIN_DRAWN_HEIGHT_M)
            yield wrapped(
                obstacle.name,
                0,
                _corners(np.array([*solid.low[:2], bottom]), solid.high),
                0.0,
            )
        else:
            yield wrapped(
                obstacle.name, 0, solid.position + solid.corners, solid.radius
            )
    contact = problem.first(PuckContact)
    table = problem.first(Table)
    if table is not None:
        values = scene.poses[0, problem.scene_columns.parameters]
        low, high = table.bounds_of(
            dict(zip(problem.parameters.names, values.tolist(), strict=True))
        )
        corners = _corners(
            np.array([*low, table.z - DRAWN_TABLE_M]), np.array([*high, table.z])
        )
        yield wrapped("table", 0, _on_table(problem, scene, corners), 0.0)
    if contact is not None:
        x, y = scene.poses[0, problem.scene_columns.constraint][2:4]
        if x < PUCK_OUT_OF_REACH_M:
            corners = _disc_corners(
                np.array([x, y, table.z if table else 0.0]),
                contact.puck_radius,
                DRAWN_PUCK_HEIGHT_M,
            )
            yield wrapped("puck", 0, _on_table(problem, scene, corners), 0.0)


def _on_table(problem: Problem, scene: Scene, corners: Array) -> Array:
    """Return corners in the frame of the table in the world frame [m], shape (V, 3)."""
    parameters = np.repeat(
        scene.poses[:1, problem.scene_columns.parameters],
        len(corners),
        axis=0,
    )
    frame = table_frame_of(problem, parameters)
    return corners if frame is None else frame.to_world(corners)


def _disc_corners(bottom: Array, radius: float, height: float) -> Array:
    """Return the corners of an upright disc on a point [m], shape (V, 3)."""
    angles = np.arange(DISC_CORNERS) * 2 * np.pi / DISC_CORNERS
    circle = np.column_stack(
        [radius * np.cos(angles), radius * np.sin(angles), np.zeros(DISC_CORNERS)]
    )
    return np.asarray(
        bottom + np.concatenate([circle, circle + np.array([0, 0, height])])
    )


def _corners(low: Array, high: Array) -> Array:
    return (low + high) / 2 + CUBE * (high - low)
