"""Pictures of one plan as the judge sees it: joints against limits over time, the tip over the table or in between."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import MachineError, UsageError
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import Solid, place_obstacles, solids_of
from cnpgen.store.files.atomic import machine_error
from cnpgen.trajectory.motion import Motion
from cnpgen.world.path import PathWorld

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

    from cnpgen.world.state import World

Array = NDArray[np.float64]

SAMPLES = 1000
SHOWN = 7  # moments at which the arm and the object are drawn
_START, _BETWEEN, _GOAL, _LIMIT, _BOX = "tab:blue", "0.55", "tab:red", "0.25", "0.85"


def plot_plan(
    problem: Problem,
    robot: Robot,
    motion: Motion,
    index: int,
    path: str | Path,
    *,
    tops: Array | None = None,
    note: str = "",
) -> None:
    """Draw one plan.

    Args:
        problem: The problem.
        robot: Its robot.
        motion: N motions.
        index: Which of them.
        path: Picture file, ``.png``, ``.pdf`` or ``.svg``; replaced if it exists.
        tops: Where the obstacles are, as ``obstacle_tops`` says, shape (numbers,); by default by the motion's ends.
        note: What the title says besides.

    Raises:
        UsageError: There is no such plan, or it has no course that could be drawn.
        MachineError: matplotlib is missing, or the file cannot be written.
    """
    if not 0 <= index < len(motion):
        raise UsageError(f"there is no plan {index}, expected 0 to {len(motion) - 1}")
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MachineError(f"matplotlib cannot be imported ({error}): pip install 'cnpgen[plot]'") from error
    one = Motion(motion.path[index : index + 1], motion.rate[index : index + 1], motion.degree)
    with np.errstate(all="ignore"):
        world, s, t = _along(problem, robot, one, index)
    if tops is None:
        tops = obstacle_tops(problem, world.tip_position[:, 0], world.tip_position[:, -1])
    figure = Figure(figsize=(15, 9), layout="constrained", dpi=110)
    figure.suptitle(f"{problem.name}, plan {index}: {t[-1]:.3f} s" + (f"\n{note}" if note else ""))
    joints, tip = figure.subfigures(1, 2, width_ratios=[1.15, 1.0], squeeze=False)[0]
    _draw_joints(joints, world, t)
    table = next((constraint for constraint in problem.constraint if isinstance(constraint, Table)), None)
    if table is None:
        _draw_views(tip, problem, world, tops)
    else:
        _draw_over_table(tip, table, world, s, t)
    try:
        figure.savefig(path)
    except OSError as error:
        raise machine_error("write", Path(path), error) from error


def _along(problem: Problem, robot: Robot, motion: Motion, index: int) -> tuple[PathWorld, Array, Array]:
    """Place the robot at K moments evenly spaced in time; return the world, phases and times [s], shape (K,) each."""
    if not motion.runs_forward()[0]:
        raise UsageError(f"plan {index} cannot be drawn: its rate ds/dt is not positive everywhere")
    t = np.linspace(0, motion.duration()[0], SAMPLES)
    s = motion.phase_at(t[None])[0]
    states = motion.at(s)
    q, dq, ddq = (values[0].T for values in (states.q, states.dq, states.ddq))
    if not np.all(np.isfinite([q, dq, ddq])):
        raise UsageError(f"plan {index} cannot be drawn: its numbers are not finite")
    world = PathWorld(robot, problem.obstacle, problem.object_size)
    world.set_path(q, dq, ddq, place_obstacles(problem.obstacle))
    return world, s, t


def _draw_joints(figure: "SubFigure", world: PathWorld, t: Array) -> None:
    """Draw q, dq, ddq and torque of every joint as a share of its limits."""
    robot = world.robot
    middle, half = (robot.position_upper + robot.position_lower) / 2, (robot.position_upper - robot.position_lower) / 2
    shares = {
        "position": (world.q - middle[:, None]) / half[:, None],
        "velocity": world.dq / robot.velocity_limit[:, None],
        "acceleration": world.ddq / robot.acceleration_limit[:, None],
        "torque": world.torque / robot.torque_limit[:, None],
    }
    axes = figure.subplots(4, 1, sharex=True)
    for axis, (name, share) in zip(axes, shares.items(), strict=True):
        for values, joint in zip(share, robot.joint_names, strict=True):
            axis.plot(t, 100 * values, linewidth=1.2, label=joint)
        _draw_limits(axis, float(np.nanmax(np.abs(share), initial=0.0)))
        axis.set_ylabel(f"{name} [% of limit]", fontsize=9)
    axes[-1].set_xlabel("t [s]")
    axes[-1].set_xlim(t[0], t[-1])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=robot.n, fontsize=8)


def _draw_limits(axis: "Axes", largest: float) -> None:
    """Draw lines at the limits and shade what lies beyond them."""
    height = 100 * min(max(1.15, 1.1 * largest), 10.0)
    axis.set_ylim(-height, height)
    for side in (-1, 1):
        axis.axhline(100 * side, color=_LIMIT, linewidth=1, linestyle="--")
        axis.axhspan(100 * side, height * side, color="tab:red", alpha=0.08, linewidth=0)
    axis.axhline(0, color="0.8", linewidth=0.6, zorder=0)
    axis.grid(axis="x", color="0.9", linewidth=0.6)


def _draw_over_table(figure: "SubFigure", table: Table, world: PathWorld, s: Array, t: Array) -> None:
    """Draw the tip from above in the rectangle, and its height over time in the band that is called valid."""
    above, beside = figure.subplots(2, 1, height_ratios=[1.5, 1.0])
    x, y, z = world.tip_position
    _draw_rectangle(above, (table.x.low, table.x.high), (table.y.low, table.y.high), fill=False)
    _draw_course(above, x, y)
    above.set_aspect("equal")
    above.margins(0.08)
    above.set(xlabel="x [m]", ylabel="y [m]", title="tip over the table, dots 20 ms apart")
    every = np.arange(0.0, t[-1], 0.02)
    above.plot(np.interp(every, t, x), np.interp(every, t, y), ".", color="black", markersize=4)
    height = table.measured(cast("World", world))[1]
    band = 1e3 * (table.allowed(height) + table.funnel(height, s, world.tip_position[:, 0]))
    beside.fill_between(t, -band, band, color="tab:green", alpha=0.12, linewidth=0, label="called valid")
    beside.plot(t, 1e3 * (z - table.z), color="black", linewidth=1.2)
    beside.set(xlabel="t [s]", ylabel="z above the table [mm]", xlim=(t[0], t[-1]))
    beside.legend(fontsize=8)
    beside.grid(color="0.9", linewidth=0.6)


def _draw_views(figure: "SubFigure", problem: Problem, world: PathWorld, tops: Array) -> None:
    """Draw arm, object and obstacles from the side (y-z) and from above (x-y)."""
    solids = solids_of(problem.obstacle, tops)
    segments, corners = world.segments(), world.object_corners() if problem.object else None
    colours = [_BETWEEN] * (SHOWN - 2) + [_START, _GOAL]
    moments = np.linspace(0, world.q.shape[1] - 1, SHOWN).round().astype(int)
    moments = np.concatenate([moments[1:-1], moments[[0, -1]]])  # the ends are drawn last, on top
    for axis, (across, up), title in zip(figure.subplots(2, 1), ((1, 2), (1, 0)), ("side", "top"), strict=True):
        for solid in solids:
            _draw_solid(axis, solid, (across, up))
        for k, colour in zip(moments, colours, strict=True):
            _draw_body(axis, segments[..., k], None if corners is None else corners[..., k], (across, up), colour)
        _draw_course(axis, world.tip_position[across], world.tip_position[up])
        axis.set_aspect("equal")
        axis.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]", title=f"{title} view")
        axis.set_ylim(bottom=max(axis.get_ylim()[0], -0.25))


def _draw_body(axis: "Axes", segments: Array, corners: Array | None, plane: tuple[int, int], colour: str) -> None:
    """Draw the arm's skeleton and the outline of what it holds, at one moment."""
    style: dict[str, Any] = {"color": colour, "linewidth": 0.8 if colour == _BETWEEN else 1.6, "alpha": 0.8}
    for segment in segments[:, :, list(plane)]:
        axis.plot(*segment.T, "-o", markersize=3, **style)
    if corners is not None:
        axis.plot(*_hull(corners[:, list(plane)]).T, **style)


def _hull(points: Array) -> Array:
    """Convex hull of points in the plane, closed, shape (n, 2) -> (m, 2)."""
    from scipy.spatial import ConvexHull

    corners = points[ConvexHull(points).vertices]
    return np.concatenate([corners, corners[:1]])


def _draw_course(axis: "Axes", a: Array, b: Array) -> None:
    axis.plot(a, b, color="black", linewidth=1.4)
    axis.plot(a[0], b[0], "o", color=_START, label="start")
    axis.plot(a[-1], b[-1], "s", color=_GOAL, label="goal")
    axis.legend(fontsize=8, loc="best")


def _draw_solid(axis: "Axes", solid: Solid, plane: tuple[int, int]) -> None:
    """Draw the shadow of an obstacle."""
    from matplotlib.patches import Polygon

    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    round_it = solid.radius * np.column_stack([np.cos(angles), np.sin(angles)])
    shadow = (solid.position + solid.corners)[:, None, list(plane)] + round_it
    outline = _hull(shadow.reshape(-1, 2))
    axis.add_patch(Polygon(outline, facecolor=_BOX, edgecolor=_LIMIT, zorder=0))
    axis.update_datalim(outline)


def _draw_rectangle(axis: "Axes", across: tuple[float, float], up: tuple[float, float], *, fill: bool) -> None:
    from matplotlib.patches import Rectangle

    corner, width, height = (across[0], up[0]), across[1] - across[0], up[1] - up[0]
    axis.add_patch(Rectangle(corner, width, height, fill=fill, facecolor=_BOX, edgecolor=_LIMIT, zorder=0))
