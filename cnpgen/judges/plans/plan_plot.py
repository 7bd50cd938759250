"""Plots of one plan: joints relative to their limits over time, the tip over the table or among the obstacles."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.judges.plans.condition_curves import ConditionCurve, condition_curves
from cnpgen.judges.plans.verdict import Margin, Verdict
from cnpgen.problems.constraints.joint import MotorTorques, motor_conditions
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.obstacle_shapes.convex_solid import Solid
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.robots.solid import place_obstacles
from cnpgen.store.files.figure_file import new_figure, save_figure
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.forward_kinematics import ForwardKinematics
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure


TABLE_HEIGHT = "table height"  # drawn with the tip
PLOT_SAMPLES = 1000  # in time
DRAWN_STATES = 7  # at which the arm and the object are drawn
MAX_NAMED_CURVES = 6  # more names would cover each other
MAX_LEGEND_CHARACTERS = 115  # that fit above the curves
_START = "tab:blue"
_BETWEEN = "0.55"
_GOAL = "tab:red"
_LIMIT = "0.25"
_BOX = "0.85"


def plot_plan(
    problem: Problem,
    robot: Robot,
    motion: Motion,
    index: int,
    path: str | Path,
    *,
    scene: Scene | None = None,
    note: str = "",
    verdict: Verdict | None = None,
) -> None:
    """Draw one of N motions: joints relative to their limits, other conditions with their bounds, and the tip.

    States at which a condition is violated are marked, and so are the violations of the
    verdict. An existing image file, ``.png``, ``.pdf`` or ``.svg``, is overwritten.
    Obstacles are by default those of the motion's ends. The note is additional text of
    the title.

    Raises:
        UsageError: There is no such plan, or it cannot be evaluated.
        MachineError: matplotlib is missing, or the file cannot be written.
    """
    if not 0 <= index < len(motion):
        raise UsageError(f"there is no plan {index}, expected 0 to {len(motion) - 1}")
    one = motion[index : index + 1]
    margins = (
        []
        if verdict is None
        else [margin for margin in verdict.margins.values() if not margin.ok]
    )
    with np.errstate(all="ignore"):
        world, s, t = along(
            problem, robot, one, index, extra_times=[margin.time for margin in margins]
        )
    title = f"{problem.name}, plan {index}: {t[-1]:.3f} s" + (
        f"\n{note}" if note else ""
    )
    draw_path(
        problem, world, s, t, Path(path), scene=scene, title=title, margins=margins
    )


def draw_path(
    problem: Problem,
    world: PathWorld,
    s: Array,
    t: Array,
    path: Path,
    *,
    scene: Scene | None,
    title: str,
    margins: Sequence[Margin],
) -> None:
    """Draw joints, conditions and tip of a path at phases s and times t [s], shape (K,), and violations."""
    with np.errstate(all="ignore"):
        if scene is None:
            ends = world.tip_position[:, :1].T, world.tip_position[:, -1:].T
            scene = scene_of(problem, *ends, world.tip_velocity[:, -1:].T)
        world.set_path(world.q, world.dq, world.ddq, scene.poses[0], world.jerk)
    curves = [
        curve
        for curve in condition_curves(problem, world, s)
        if curve.name != TABLE_HEIGHT
    ]
    columns = [1.15, 0.85, 1.0] if curves else [1.15, 1.0]
    figure = new_figure(20 if curves else 15, 9)
    figure.suptitle(title)
    joints, *conditions, tip = figure.subfigures(
        1, len(columns), width_ratios=columns, squeeze=False
    )[0]
    _draw_joints(joints, world, t, margins)
    if curves:
        _draw_conditions(conditions[0], curves, t, margins)
    table = problem.first(Table)
    if table is None:
        _draw_views(tip, problem, world, scene.bodies())
    else:
        _draw_over_table(tip, table, world, s, t)
    _draw_legend(tip)
    save_figure(figure, path)


def _draw_legend(tip: "SubFigure") -> None:
    """Name every kind of line of the tip's views once."""
    named = {
        name: item
        for axis in tip.axes
        for item, name in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    tip.legend(
        named.values(),
        named.keys(),
        loc="outside lower center",
        ncols=len(named),
        fontsize=8,
    )


def along(
    problem: Problem,
    robot: Robot,
    motion: Motion,
    index: int,
    *,
    samples: int = PLOT_SAMPLES,
    extra_times: Sequence[float] = (),
    scene: Scene | None = None,
) -> tuple[PathWorld, Array, Array]:
    """Place the robot at K times of one motion, uniformly spaced but for extra ones [s].

    The index is that of error messages. Obstacles, by default those of the problem,
    matter for distances only. Return the world, phases, and times [s], shape (K,) each.
    A motion that cannot be evaluated raises UsageError.
    """
    if not motion.runs_forward()[0]:
        raise UsageError(
            f"plan {index} cannot be drawn: its rate ds/dt is not positive everywhere"
        )
    t = plot_times(float(motion.duration()[0]), samples, extra_times)
    s = motion.phase_at(t[None])[0]
    states = motion.at(s)
    q, dq, ddq = (values[0].T for values in (states.q, states.dq, states.ddq))
    if not np.all(np.isfinite([q, dq, ddq])):
        raise UsageError(f"plan {index} cannot be drawn: its values are not finite")
    world = PathWorld(robot, problem.obstacle, problem.object_size)
    jerk = states.jerk[0].T if problem.uses_jerk else None
    poses = place_obstacles(problem.obstacle) if scene is None else scene.poses[0]
    world.set_path(q, dq, ddq, poses, jerk)
    return world, s, t


def plot_times(duration: float, samples: int, extra: Sequence[float]) -> Array:
    """Return uniformly spaced times and extra ones within the duration [s], ascending."""
    return np.union1d(
        np.linspace(0, duration, samples), np.clip(np.array(extra, float), 0, duration)
    )


def shares_of_limits(world: PathWorld) -> dict[str, Array]:
    """Return q, dq, ddq, torque and, if constrained, jerk as fractions of their limits, each of shape (n, K)."""
    # Positions relative to the center of the range, so that both limits are at 100 %.
    robot = world.robot
    factors = world.parameters.values
    center = (robot.position_upper + robot.position_lower) / 2
    half = (robot.position_upper - robot.position_lower) / 2
    return {
        "position": (world.q - center[:, None]) / half[:, None],
        "velocity": world.dq
        / (factors.get("velocity_factor", 1.0) * robot.velocity_limit[:, None]),
        "acceleration": world.ddq
        / (factors.get("acceleration_factor", 1.0) * robot.acceleration_limit[:, None]),
        **(
            {}
            if world.jerk is None
            else {"jerk": world.jerk / robot.jerk_limit[:, None]}
        ),
        **_torque_shares(world),
    }


def _torque_shares(world: PathWorld) -> dict[str, Array]:
    """Return the limited torques at the joints and, with drives, the larger bound of those at the motors."""
    robot = world.robot
    drive = world.robot.drive
    joint = {"torque": world.torque / robot.torque_limit[:, None]}
    if drive is None:
        return joint
    shares = joint if drive.limits_joint else {}
    if not drive.motor_rows:
        return shares
    for condition in motor_conditions(
        robot, drive, MotorTorques(world.dq, world.motor_torque)
    ):
        name = condition.name.removeprefix("highest ").removeprefix("lowest ")
        share = np.array(condition.g) / condition.upper[:, None]
        joints = [robot.joint_names.index(part) for part in condition.parts]
        values = shares.setdefault(name, np.zeros_like(world.dq))
        for row, value in zip(joints, share, strict=True):
            values[row] = np.where(
                np.abs(value) > np.abs(values[row]), value, values[row]
            )
    return shares


def _draw_joints(
    figure: "SubFigure", world: PathWorld, t: Array, margins: Sequence[Margin]
) -> None:
    """Draw the quantities of ``shares_of_limits`` of every joint over time."""
    robot = world.robot
    shares = shares_of_limits(world)
    axes = figure.subplots(len(shares), 1, sharex=True)
    for axis, (name, share) in zip(axes, shares.items(), strict=True):
        for values, joint in zip(share, robot.joint_names, strict=True):
            axis.plot(t, 100 * values, linewidth=1.2, label=joint)
        _draw_limits(axis, float(np.nanmax(np.abs(share), initial=0.0)))
        for margin in margins:
            if margin.name in {f"joint {name}", f"highest {name}", f"lowest {name}"}:
                k = int(np.abs(t - margin.time).argmin())
                value = 100 * share[robot.joint_names.index(margin.part), k]
                _mark(axis, margin.time, float(np.clip(value, *axis.get_ylim())))
        axis.set_ylabel(f"{name} [% of limit]", fontsize=9)
    axes[-1].set_xlabel("t [s]")
    axes[-1].set_xlim(t[0], t[-1])
    # With space between entries.
    columns = max(1, MAX_LEGEND_CHARACTERS // (max(map(len, robot.joint_names)) + 8))
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=min(robot.n, columns),
        fontsize=8,
    )


def _draw_conditions(
    figure: "SubFigure",
    curves: list[ConditionCurve],
    t: Array,
    margins: Sequence[Margin],
) -> None:
    """Draw the values of conditions over time, with their bounds and violations."""
    for axis, curve in zip(
        figure.subplots(len(curves), 1, sharex=True, squeeze=False)[:, 0],
        curves,
        strict=True,
    ):
        _draw_values(axis, curve, t)
        for margin in margins:
            if margin.name == curve.name:
                k = int(np.abs(t - margin.time).argmin())
                violation = np.maximum(
                    curve.lower[k] - curve.values[:, k],
                    curve.values[:, k] - curve.upper[k],
                )
                _mark(axis, margin.time, float(curve.values[violation.argmax(), k]))
        axis.set_ylabel(f"{curve.label}\n[{curve.unit}]", fontsize=9)
        axis.grid(axis="x", color="0.9", linewidth=0.6)
    axis.set_xlabel("t [s]")
    axis.set_xlim(t[0], t[-1])


def _draw_values(axis: "Axes", curve: ConditionCurve, t: Array) -> None:
    """Draw the values of one condition, and shade the area outside its bounds."""
    for values, part in zip(curve.values, curve.parts, strict=True):
        color = None if part else "black"
        label = part or None
        axis.plot(t, values, linewidth=1.2, color=color, label=label)
        if len(curve.parts) <= MAX_NAMED_CURVES:
            at = (t[0], values[0])
            axis.annotate(part, at, (2, 3), textcoords="offset points", fontsize=8)
    # A bound of which the values stay far away is drawn, too.
    low, high = axis.get_ylim()
    for bound, side in ((curve.lower, -1), (curve.upper, 1)):
        if np.isfinite(bound).all():
            axis.plot(t, bound, color=_LIMIT, linewidth=1, linestyle="--")
            reach = bound + side * 1.5 * curve.tolerance
            low = min(low, float(reach.min()))
            high = max(high, float(reach.max()))
            outside = bound + side * 1e6
            axis.fill_between(
                t, bound, outside, color="tab:red", alpha=0.08, linewidth=0
            )
    axis.set_ylim(low, high)
    violated = np.where(curve.violated, curve.values, np.nan)
    axis.plot(t, violated.T, color=_GOAL, linewidth=2.5, label="_violated")


def _mark(axis: "Axes", time: float, value: float) -> None:
    """Mark a violation."""
    axis.plot(
        [time],
        [value],
        "x",
        color=_GOAL,
        markersize=9,
        markeredgewidth=2,
        label="violation",
    )


def _draw_limits(axis: "Axes", largest: float) -> None:
    """Draw lines at the limits and shade the area outside them."""
    height = 100 * min(max(1.15, 1.1 * largest), 10.0)
    axis.set_ylim(-height, height)
    for side in (-1, 1):
        axis.axhline(100 * side, color=_LIMIT, linewidth=1, linestyle="--")
        axis.axhspan(
            100 * side, height * side, color="tab:red", alpha=0.08, linewidth=0
        )
    axis.axhline(0, color="0.8", linewidth=0.6, zorder=0)
    axis.grid(axis="x", color="0.9", linewidth=0.6)


def _draw_over_table(
    figure: "SubFigure", table: Table, world: PathWorld, s: Array, t: Array
) -> None:
    """Draw the tip from above in the rectangle, and its height over time in the valid band."""
    from matplotlib.patches import Rectangle

    above, beside = figure.subplots(2, 1, height_ratios=[1.5, 1.0])
    x, y, z = world.parameters.on_table(world.tip_position)
    low, high = table.bounds_of(world.parameters.values)
    sizes = high[0] - low[0], high[1] - low[1]
    above.add_patch(Rectangle(low, *sizes, fill=False, edgecolor=_LIMIT, zorder=0))
    _draw_tip_path(above, x, y)
    above.set_aspect("equal")
    above.margins(0.08)
    above.set(
        xlabel="x [m]", ylabel="y [m]", title="tip over the table, one dot per 20 ms"
    )
    ticks = np.arange(0.0, t[-1], 0.02)
    above.plot(
        np.interp(ticks, t, x), np.interp(ticks, t, y), ".", color="black", markersize=4
    )
    off_table = table.measured(cast(World, world))[1]
    band = 1e3 * (
        table.allowed(off_table)
        + table.bound_relaxation(off_table, s, world.tip_position[:, 0])
    )
    beside.fill_between(
        t, -band, band, color="tab:green", alpha=0.12, linewidth=0, label="valid"
    )
    height = 1e3 * (z - table.z)
    beside.plot(t, height, color="black", linewidth=1.2)
    violated = np.where(np.abs(height) > band, height, np.nan)
    beside.plot(t, violated, color=_GOAL, linewidth=2.5, label="_violated")
    beside.set(xlabel="t [s]", ylabel="z above the table [mm]", xlim=(t[0], t[-1]))
    beside.grid(color="0.9", linewidth=0.6)


def _draw_views(
    figure: "SubFigure", problem: Problem, world: PathWorld, solids: list[Solid]
) -> None:
    """Draw arm, object and obstacles in two views: from the side with the largest tip motion, and from above."""
    from matplotlib.patches import Polygon

    corners = world.object_corners() if problem.object else None
    side = int(np.ptp(world.tip_position[1]) >= np.ptp(world.tip_position[0]))
    colors = [_BETWEEN] * (DRAWN_STATES - 2) + [_START, _GOAL]
    indices = np.linspace(0, world.q.shape[1] - 1, DRAWN_STATES).round().astype(int)
    # The ends are drawn last, in front.
    indices = np.concatenate([indices[1:-1], indices[[0, -1]]])
    links = [_links(problem, world, k) for k in indices]
    for axis, (across, up), title in zip(
        figure.subplots(2, 1), ((side, 2), (1, 0)), ("side", "top"), strict=True
    ):
        for solid in solids:
            outline = _outline(
                (solid.position + solid.corners)[:, [across, up]], solid.radius
            )
            axis.add_patch(Polygon(outline, facecolor=_BOX, edgecolor=_LIMIT, zorder=0))
            axis.update_datalim(outline)
        for k, points, color in zip(indices, links, colors, strict=True):
            _draw_body(
                axis,
                points,
                None if corners is None else corners[..., k],
                (across, up),
                color,
            )
        _draw_tip_path(axis, world.tip_position[across], world.tip_position[up])
        axis.set_aspect("equal")
        axis.set(
            xlabel=f"{'xyz'[across]} [m]",
            ylabel=f"{'xyz'[up]} [m]",
            title=f"{title} view",
        )
        if up == 2:
            # The part of the base below the floor is cut off.
            axis.set_ylim(bottom=max(axis.get_ylim()[0], -0.25))


def _links(problem: Problem, world: PathWorld, k: int) -> list[tuple[Array, float]]:
    """Return the parts of links, or segments, at one state: corners in the world [m], shape (V, 3), and radius [m]."""
    robot = world.robot
    if robot.shape is None:
        return [
            (segment, problem.arm_radius or 0.0) for segment in world.segments()[..., k]
        ]
    rotations, positions = ForwardKinematics(robot.model).poses(world.q[:, k : k + 1])
    places = (
        (piece, robot.shape.joints[piece.link]) for piece in robot.shape.convex_parts
    )
    return [
        (
            piece.vertices @ rotations[joint, :, :, 0].T + positions[joint, :, 0],
            piece.radius,
        )
        for piece, joint in places
    ]


def _draw_body(
    axis: "Axes",
    links: list[tuple[Array, float]],
    corners: Array | None,
    plane: tuple[int, int],
    color: str,
) -> None:
    """Draw the outlines of the arm's links and of the held object at one state."""
    from matplotlib.collections import PolyCollection

    between = color == _BETWEEN
    style: dict[str, Any] = {
        "color": color,
        "linewidth": 0.5 if between else 1.2,
        "alpha": 0.5 if between else 0.9,
    }
    for points, radius in links:
        outline = _outline(points[:, list(plane)], radius)
        axis.plot(*outline.T, **style)
        area = PolyCollection(
            [outline], facecolors=color, alpha=0.03 if between else 0.12, linewidths=0
        )
        axis.add_collection(area)
    if corners is not None:
        axis.plot(
            *_hull(corners[:, list(plane)]).T,
            **style | {"linewidth": 2 * style["linewidth"]},
        )


def _outline(points: Array, radius: float) -> Array:
    """Compute the outline of the hull of points in the plane, extended by a radius, shape (V, 2) -> (m, 2)."""
    if not radius:
        return points if len(points) == 2 else _hull(points)
    angles = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    circle = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return _hull((points[:, None] + circle).reshape(-1, 2))


def _hull(points: Array) -> Array:
    """Compute the closed convex hull of points in the plane, shape (n, 2) -> (m, 2)."""
    from scipy.spatial import ConvexHull

    corners = points[ConvexHull(points).vertices]
    return np.concatenate([corners, corners[:1]])


def _draw_tip_path(axis: "Axes", a: Array, b: Array) -> None:
    axis.plot(a, b, color="black", linewidth=1.4)
    axis.plot(a[0], b[0], "o", color=_START, label="start")
    axis.plot(a[-1], b[-1], "s", color=_GOAL, label="goal")
