"""Plots of plans: their contents, image formats, and errors for plans that cannot be drawn."""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from cnpgen.errors import MachineError, UsageError
from cnpgen.judges.plans.plan_plot import plot_plan
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.scene import Scene
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.trajectory.spline_motion import Motion
from tests.conftest import some
from tests.examples.jerk_limits import jerk_limited_plan
from tests.examples.obstacles import KINDS, draw_obstacle
from tests.examples.plans import Plan, load, perturbed, reference_trajectory
from tests.examples.shaped_robot import write_problem
from tests.refusals import is_refused

if TYPE_CHECKING:
    from matplotlib.figure import Figure

again = pytest.mark.extended  # the same claim for the other of two plans


def draw(plan: Plan, path: Path, index: int = 0) -> None:
    plot_plan(plan.problem, plan.robot, plan.motion, index, path)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> "Iterator[list[Figure]]":
    """Figures that would have been saved."""
    from matplotlib.figure import Figure

    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path: figures.append(self))
    return figures


def axes_of(figure: "Figure") -> dict[str, Any]:
    """Return axes by their title or the label of their y axis."""
    axes = [axis for part in figure.subfigs for axis in part.axes]
    return {axis.get_title() or axis.get_ylabel(): axis for axis in axes}


def bounding_box(patch: Any) -> Any:
    """Return the bounding box of a patch."""
    return patch.get_path().get_extents(patch.get_patch_transform())


def test_jerks_are_drawn_if_they_are_limited(
    tmp_path: Path, drawn: "list[Figure]"
) -> None:
    plan = jerk_limited_plan("hit")
    draw(plan, tmp_path / "a.png")
    draw(load("hit"), tmp_path / "b.png")
    limited, free = (axes_of(figure) for figure in drawn)
    assert "jerk [% of limit]" in limited
    assert "jerk [% of limit]" not in free
    seen = limited["jerk [% of limit]"].lines[0]
    t = reference_trajectory(plan)
    share = (
        100 * np.interp(seen.get_xdata(), t.t, t.jerk[:, 0]) / plan.robot.jerk_limit[0]
    )
    np.testing.assert_allclose(seen.get_ydata(), share, atol=0.01 * np.abs(share).max())


@pytest.mark.parametrize(
    ("label", "suffix"),
    [
        *some([("hit", "png"), ("transport", "pdf"), ("hit", "svg")], 1, "slow"),
        *(
            pytest.param(*each, marks=again)
            for each in (("transport", "png"), ("hit", "pdf"), ("transport", "svg"))
        ),
    ],
)
def test_a_plan_is_drawn(label, suffix, tmp_path):
    draw(load(label), tmp_path / f"plan.{suffix}")
    assert (tmp_path / f"plan.{suffix}").stat().st_size > 10_000


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_joints_are_drawn_relative_to_their_limits_over_time(label, drawn):
    plan = load(label)
    draw(plan, Path("plan.png"))
    axes, seen = axes_of(drawn[0]), reference_trajectory(plan, 2001)
    shares = {
        "velocity": seen.dq / plan.robot.velocity_limit,
        "acceleration": seen.ddq / plan.robot.acceleration_limit,
        "torque": seen.tau / plan.robot.torque_limit,
    }
    for name, share in shares.items():
        lines = axes[f"{name} [% of limit]"].get_lines()
        for line, values, joint in zip(
            lines, share.T, plan.robot.joint_names, strict=False
        ):
            assert line.get_label() == joint
            expected = np.interp(line.get_xdata(), seen.t, values)
            np.testing.assert_allclose(line.get_ydata(), 100 * expected, atol=0.5)
    position = np.array(
        [
            line.get_ydata()
            for line in axes["position [% of limit]"].get_lines()[: plan.robot.n]
        ]
    )
    center, half = (
        plan.robot.position_upper + plan.robot.position_lower,
        plan.robot.position_upper - plan.robot.position_lower,
    )
    np.testing.assert_allclose(
        position[:, 0], 100 * (2 * seen.q[0] - center) / half, atol=1e-9
    )


def test_the_tip_is_drawn_over_the_table_with_the_valid_height(drawn):
    plan = load("hit")
    draw(plan, Path("plan.png"))
    axes, seen = axes_of(drawn[0]), reference_trajectory(plan, 2001)
    above, beside = (
        axes["tip over the table, one dot per 20 ms"],
        axes["z above the table [mm]"],
    )
    assert above.patches[0].get_bbox().bounds == pytest.approx((0.6, -0.45, 1.4, 0.9))
    x, y = above.get_lines()[0].get_data()
    np.testing.assert_allclose([x[-1], y[-1]], seen.tip[-1, :2], atol=1e-9)
    t, z = beside.get_lines()[0].get_data()
    np.testing.assert_allclose(
        z, 1e3 * (np.interp(t, seen.t, seen.tip[:, 2]) - 0.16), atol=1e-3
    )
    low, high = beside.collections[0].get_datalim(beside.transData).intervaly
    assert high == -low == pytest.approx(1 + 1e3 * abs(seen.tip[0, 2] - 0.16))


def test_a_transport_is_drawn_from_the_side_and_from_above(drawn):
    plan = load("transport")
    draw(plan, Path("plan.png"))
    axes, seen = axes_of(drawn[0]), reference_trajectory(plan, 2001)
    poses = [plan.start_xyz[0, 2] - 0.15, plan.goal_xyz[0, 2] - 0.15]
    assert [
        bounding_box(patch).y1 for patch in axes["side view"].patches
    ] == pytest.approx(poses)
    assert [bounding_box(patch).bounds for patch in axes["top view"].patches] == [
        pytest.approx((-0.6, 0.2, 0.3, 0.4)),
        pytest.approx((0.3, 0.2, 0.3, 0.4)),
    ]
    for view, (across, up) in (("side view", (1, 2)), ("top view", (1, 0))):
        goal = next(
            line for line in axes[view].get_lines() if line.get_label() == "goal"
        )
        np.testing.assert_allclose(
            np.ravel(goal.get_data()), seen.tip[-1, [across, up]], atol=1e-9
        )


def test_the_arm_of_a_transport_is_as_wide_as_its_capsules(drawn):
    plan = load("transport")
    draw(plan, Path("plan.png"))
    for view in ("side view", "top view"):
        areas = axes_of(drawn[0])[view].collections
        assert len(areas) == 7 * len(plan.robot.capsule_axes)
        for area in areas:
            points = area.get_paths()[0].vertices
            inside = 2 * 0.14 * np.cos(np.pi / 32)
            assert (
                np.ptp(points, axis=0).min() >= inside
            )  # a circle of 14 cm at either end


def test_the_view_from_above_shows_the_whole_arm(drawn):
    draw(load("transport"), Path("plan.png"))
    axis = axes_of(drawn[0])["top view"]
    points = np.concatenate([area.get_paths()[0].vertices for area in axis.collections])
    for limits, values in zip(
        (axis.get_xlim(), axis.get_ylim()), points.T, strict=True
    ):
        assert limits[0] <= values.min()
        assert values.max() <= limits[1]


@pytest.mark.slow
def test_an_arm_with_link_geometry_is_drawn_by_its_parts(drawn, tmp_path):
    problem = load_problem(write_problem(tmp_path))
    robot = load_robot(problem)
    path, rate = np.tile(robot.home, (1, 15, 1)), np.ones((1, 20))
    path[0, 7] += 0.3
    plot_plan(problem, robot, Motion(path, rate, 7), 0, Path("plan.png"))
    areas = axes_of(drawn[0])["top view"].collections
    assert len(areas) == 7 * len(robot.shape.convex_parts)
    base = areas[0].get_paths()[0].vertices
    np.testing.assert_allclose(
        [base.min(axis=0), base.max(axis=0)], [[-0.15, -0.15], [0.15, 0.15]], atol=1e-9
    )


@pytest.mark.parametrize("label", some(["hit", "transport"], 1, "slow"))
def test_legends_are_complete_and_do_not_overlap_axes(label, drawn):
    plan = load(label)
    long = replace(
        plan.robot,
        joint_names=tuple(
            f"a_rather_long_name_of_joint_{i}" for i in range(plan.robot.n)
        ),
    )
    vars(long).update(model=plan.robot.model)  # with the original joint names
    plot_plan(plan.problem, long, plan.motion, 0, Path("plan.png"))
    figure = drawn[0]
    figure.draw_without_rendering()
    axes = [axis.get_window_extent() for part in figure.subfigs for axis in part.axes]
    legends = [
        legend.get_window_extent() for part in figure.subfigs for legend in part.legends
    ]
    assert len(legends) == 2
    for legend in legends:
        assert figure.bbox.x0 <= legend.x0 < legend.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= legend.y0 < legend.y1 <= figure.bbox.y1
        assert not any(legend.overlaps(axis) for axis in axes)
    assert not any(axis.get_legend() for part in figure.subfigs for axis in part.axes)


def test_obstacles_are_drawn_at_the_poses_of_the_task_and_the_note_is_in_the_title(
    drawn,
):
    plan = load("transport")
    plot_plan(
        plan.problem,
        plan.robot,
        plan.motion,
        0,
        Path("plan.png"),
        scene=Scene(tuple(plan.problem.obstacle), np.array([[0.1, 0.2]])),
        note="not valid",
    )
    assert [
        bounding_box(patch).y1 for patch in axes_of(drawn[0])["side view"].patches
    ] == pytest.approx([0.1, 0.2])
    assert (
        drawn[0].get_suptitle()
        == f"heavy-object, plan 0: {plan.motion.duration()[0]:.3f} s\nnot valid"
    )


@pytest.mark.parametrize(
    ("label", "by"),
    [
        *some([("hit", 1.0), ("transport", 1e3), ("hit", 1e150)], 0, "slow"),
        *(
            pytest.param(*each, marks=again)
            for each in (("transport", 1.0), ("hit", 1e3), ("transport", 1e150))
        ),
    ],
)
def test_a_plan_outside_its_limits_is_drawn(label, by, tmp_path):
    draw(perturbed(load(label), by), tmp_path / "plan.png")


@pytest.mark.slow
def test_a_plan_without_motion_is_drawn(tmp_path):
    plan = load("transport")
    draw(plan.changed(path=0 * plan.motion.path), tmp_path / "plan.png")


@pytest.mark.slow
def test_a_problem_without_a_table_and_obstacles_is_drawn(tmp_path):
    plan = load("hit")
    problem = replace(plan.problem, constraint=plan.problem.constraint[:4])
    draw(replace(plan, problem=problem), tmp_path / "plan.png")


@pytest.mark.parametrize("index", [-1, 1])
def test_an_index_out_of_range_raises_an_error(index, tmp_path):
    with is_refused(UsageError):
        draw(load("hit"), tmp_path / "plan.png", index)


def test_a_plan_that_cannot_be_evaluated_raises_an_error(tmp_path):
    plan = load("hit")
    with is_refused(UsageError):
        draw(plan.changed(rate=-plan.motion.rate), tmp_path / "plan.png")
    with is_refused(UsageError):
        draw(plan.changed(path=plan.motion.path * np.nan), tmp_path / "plan.png")


def test_a_folder_that_cannot_be_created_raises_an_error(tmp_path):
    (tmp_path / "file").write_text("a file")
    with is_refused(MachineError):
        draw(load("hit"), tmp_path / "file" / "plan.png")


def test_the_error_without_matplotlib_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with is_refused(MachineError):
        draw(load("hit"), tmp_path / "plan.png")


def test_obstacles_of_every_kind_are_drawn_at_their_poses(drawn):
    plan, random = load("transport"), np.random.default_rng(1)
    obstacles = tuple(draw_obstacle(kind, random) for kind in KINDS)
    plot_plan(
        replace(plan.problem, obstacle=obstacles),
        plan.robot,
        plan.motion,
        0,
        Path("plan.png"),
    )
    axes, poses = axes_of(drawn[0]), place_obstacles(obstacles)
    for title, up in (("side view", 2), ("top view", 0)):
        boxes = [bounding_box(patch) for patch in axes[title].patches]
        for solid, found in zip(solids_of(obstacles, poses), boxes, strict=True):
            np.testing.assert_allclose(
                [found.min, found.max],
                [solid.low[[1, up]], solid.high[[1, up]]],
                atol=2e-3,
            )


def marks(axis: Any) -> list[tuple[float, float]]:
    """Return the marked violations of an axis."""
    return [
        tuple(np.ravel(line.get_data()))
        for line in axis.get_lines()
        if line.get_label() == "violation"
    ]


def test_violations_of_joints_and_conditions_are_marked_at_their_times(
    drawn: "list[Figure]",
) -> None:
    plan = perturbed(load("transport"), 0.2)
    verdict = plan.judged()
    plot_plan(
        plan.problem,
        plan.robot,
        plan.motion,
        0,
        Path("plan.png"),
        scene=plan.scene,
        verdict=verdict,
    )
    axes = axes_of(drawn[0])
    titles = {
        "joint velocity": "velocity [% of limit]",
        "tilt": "tilt\n[deg]",
        "object contact": "object contact\n[mm]",
        "robot clearance": "robot clearance\n[mm]",
    }
    violated = {name for name in titles if not verdict.margins[name].ok}
    assert {"joint velocity", "tilt", "object contact"} <= violated
    for name, title in titles.items():
        margin, marked = verdict.margins[name], marks(axes[title])
        assert [time for time, _ in marked] == (
            [pytest.approx(margin.time)] if name in violated else []
        )
    (tilt,) = marks(axes["tilt\n[deg]"])
    assert tilt[1] == pytest.approx(np.degrees(verdict.margins["tilt"].value), rel=1e-3)
    (outside,) = (
        line
        for line in axes["tilt\n[deg]"].get_lines()
        if line.get_label() == "_violated"
    )
    assert np.nanmin(outside.get_ydata()) > 1.8


def test_a_valid_plan_has_no_marks(drawn: "list[Figure]") -> None:
    plan = load("hit")
    plot_plan(
        plan.problem,
        plan.robot,
        plan.motion,
        0,
        Path("plan.png"),
        scene=plan.scene,
        verdict=plan.judged(),
    )
    axes = axes_of(drawn[0])
    assert "puck distance\n[mm]" in axes
    assert not any(marks(axis) for axis in axes.values())
