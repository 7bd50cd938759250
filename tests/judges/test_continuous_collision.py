"""Continuous collision checks: maxima of the depth between samples are found, other margins do not change."""

from importlib import import_module
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.judges.plans.continuous_collision import Intervals, chord_deviation_bounds
from cnpgen.judges.plans.evaluated_trajectory import SplineCurve, evaluate_trajectory
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.pair_distances import PairDistances
from cnpgen.world.path import PathWorld
from tests.conftest import some
from tests.examples.plans import load, perturbed
from tests.examples.shaped_robot import write_problem

judge_module = import_module(
    "cnpgen.judges.plans.judge"
)  # the package has a function of the same name


@pytest.mark.parametrize(
    ("by", "seed"), some([(0.0, 0), (0.005, 3), (0.01, 5), (0.02, 2)], 1, "slow")
)
def test_a_maximum_depth_where_edges_pass_between_samples_is_found(
    by: float, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = perturbed(load("dragging"), by, seed=seed)
    verdict = plan.judged()
    monkeypatch.setattr(
        judge_module, "check_continuous_collision", lambda _, **__: iter(())
    )
    coarse, fine = plan.judged(), plan.judged(step=2e-5)
    deepest = fine.margins["object contact"].violation
    assert deepest - coarse.margins["object contact"].violation > 1e-4
    assert verdict.margins["object contact"].violation == pytest.approx(
        deepest, abs=1e-5
    )
    assert verdict.margins["object contact"].time == pytest.approx(
        fine.margins["object contact"].time, abs=1e-4
    )
    others = [
        {name: margin for name, margin in v.margins.items() if margin.unit != "m"}
        for v in (verdict, coarse)
    ]
    assert others[0] == others[1]
    assert verdict.metrics.to_dict() == coarse.metrics.to_dict()
    assert verdict.paper == coarse.paper
    assert verdict.samples == coarse.samples


@pytest.mark.parametrize(("seed", "step"), [(9, 1e-3), (8, 3e-3)])
def test_a_deciding_maximum_far_from_the_deepest_sample_is_found(
    seed: int, step: float
) -> None:
    """The object touches twice. The contact with the smaller depth at samples is the deeper one between them."""
    plan = perturbed(load("dragging"), 0.02, seed=seed)
    deepest = plan.judged(step=step / 40).margins["object contact"]
    at_samples = plan.judged(step=step).margins["object contact"]
    assert abs(deepest.time - at_samples.time) > 10 * step
    strict = plan.with_constraint(
        "ObjectContact", tolerance=at_samples.violation + 2e-5
    ).judged(step=step)
    found = strict.margins["object contact"]
    assert not found.ok
    assert found.violation == pytest.approx(deepest.violation, abs=2e-5)
    assert found.time == pytest.approx(deepest.time, abs=step)


def intervals(margins: list[float], bounds: list[float]) -> Intervals:
    """Return intervals between samples with margins, and a proven lower bound in each of them."""
    phases, values = np.linspace(0, 1, len(margins)), np.array(margins)
    return Intervals(
        *(np.column_stack([row[:-1], row[1:]]) for row in (phases, values)),
        np.array(bounds),
    )


def test_intervals_next_to_the_smallest_margin_are_divided() -> None:
    assert intervals([5.0, 1.0, 3.0, 3.0], [1.0] * 3).around_minimum().tolist() == [
        True,
        True,
        False,
    ]
    assert intervals([1.0, 2.0, 3.0], [0.0] * 2).around_minimum().tolist() == [
        True,
        False,
    ]
    assert intervals([3.0, 2.0, 1.0], [0.0] * 2).around_minimum().tolist() == [
        False,
        True,
    ]


def test_intervals_with_a_negative_bound_are_divided() -> None:
    assert not intervals([5.0, 1.0, 3.0], [0.0, 1.0]).unresolved().any()
    assert intervals(
        [5.0, 1.0, 3.0, 2.0], [-1e-9, 1.0, -np.inf]
    ).unresolved().tolist() == [True, False, True]


def test_nothing_is_searched_if_a_sample_violates_the_tolerance() -> None:
    assert not intervals([5.0, -0.1, 3.0], [-50.0] * 2).unresolved().any()
    assert not intervals([5.0, np.nan, 3.0], [-50.0] * 2).unresolved().any()


def test_the_intervals_with_the_lowest_bounds_are_chosen_if_there_are_too_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cnpgen.judges.plans.continuous_collision.MAX_INTERVALS", 2)
    found = intervals(
        [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [-1.0, -1.0, -3.0, -1.0, -2.0]
    ).unresolved()
    assert np.flatnonzero(found).tolist() == [2, 4]


@pytest.mark.parametrize(
    ("label", "kind"),
    [("transport", "object"), ("dragging", "object"), ("transport", "robot")],
)
def test_interval_bounds_hold_at_finer_samples(label: str, kind: str) -> None:
    plan = perturbed(load(label), 0.01, seed=1)
    (poses,) = plan.scene.poses
    assert_bounds_hold(plan.problem, plan.robot, plan.motion, poses, kind)


@pytest.mark.parametrize("kind", ["robot", "self"])
def test_interval_bounds_hold_for_the_parts_of_a_robot(
    kind: str, tmp_path: Path
) -> None:
    problem = load_problem(write_problem(tmp_path))
    robot = load_robot(problem)
    path = np.linspace([1.2, -0.3, 0.4, 0.0], [0.4, 0.3, 1.2, 1.0], 15)[None]
    assert_bounds_hold(
        problem, robot, Motion(path, np.ones((1, 20))), np.array([0.3, 0.9]), kind
    )


def assert_bounds_hold(
    problem: Problem, robot: Robot, motion: Motion, poses: np.ndarray, kind: str
) -> None:
    """Check that the lower bounds of intervals hold at every sample of a finer grid."""
    world = PathWorld(robot, problem.obstacle, problem.object_size)
    s, finer = np.linspace(0, 1, 41), np.linspace(0, 1, 40 * 8 + 1)

    def pairs_at(phases: np.ndarray) -> PairDistances:
        states = evaluate_trajectory(motion, phases)
        world.set_path(states.q, states.dq, states.ddq, poses)
        return world.pairs(kind)

    fine = pairs_at(finer)
    distances = np.min(
        [
            [fine.measure(pair, k)[0] for k in range(len(finer))]
            for pair in range(len(fine.bounds))
        ],
        axis=0,
    )
    nearest = np.array([distances[8 * k : 8 * k + 9].min() for k in range(40)])
    pairs, motion_bounds = (
        pairs_at(s),
        world.motion_bounds(np.abs(motion.path[0]).max(axis=0)),
    )
    displacements = motion_bounds @ np.abs(np.diff(world.q, axis=1))
    deviations = chord_deviation_bounds(SplineCurve(motion), s, motion_bounds)
    pairs.smallest()  # its directions are reused
    for least in (np.median(nearest), nearest.min() - 0.03):
        bounds = pairs.interval_bounds(
            np.full(len(pairs.bounds), least), displacements, deviations
        )
        assert (bounds <= nearest - least + 1e-9).all()
        distant = nearest - least > 2 * deviations + 2e-3
        assert distant.any() or least > nearest.min()
        assert (bounds[distant] >= 0).all(), "intervals at a large distance are proven"


def test_a_maximum_at_either_end_is_found() -> None:
    """The largest depth is at the start or at the end of the motion."""
    plan = load("transport")
    for ends in ((0.01, 0.0), (0.0, 0.01)):
        start, goal = (
            xyz + np.array([0, 0, up])
            for xyz, up in zip((plan.start_xyz, plan.goal_xyz), ends, strict=True)
        )
        verdict = type(plan)(
            plan.problem, plan.robot, plan.motion, plan.boundary, start, goal
        ).judged()
        margin = verdict.margins["object contact"]
        assert margin.violation == pytest.approx(0.0095, abs=1e-3)
        assert (margin.phase < 0.5) == (ends[0] > 0)


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_no_point_deviates_from_its_chord_by_more_than_the_bound(label: str) -> None:
    plan = perturbed(load(label), 0.2, seed=3)
    model, robot = plan.robot.model, plan.robot
    data, s, parts = model.createData(), np.linspace(0, 1, 105), 9
    motion_bounds = PathWorld(
        robot, plan.problem.obstacle, plan.problem.object_size
    ).motion_bounds(np.zeros(robot.n))
    bounds = chord_deviation_bounds(SplineCurve(plan.motion), s, motion_bounds)
    points, fraction = [], np.linspace(0, 1, parts)
    finer = np.concatenate([np.linspace(a, b, parts) for a, b in pairwise(s)])
    for q in evaluate_trajectory(plan.motion, finer).q.T:
        pin.framesForwardKinematics(model, data, q.copy())
        points.append(
            [pose.translation.copy() for pose in [*data.oMi, data.oMf[robot.tip_frame]]]
        )
    path = np.array(points).reshape(len(s) - 1, parts, -1, 3)
    chord = path[:, :1] + fraction[:, None, None] * (path[:, -1:] - path[:, :1])
    deviation = np.linalg.norm(path - chord, axis=3).max(axis=(1, 2))
    assert (deviation <= bounds + 1e-15).all()
    assert np.median(bounds / np.maximum(deviation, 1e-12)) < 40


def test_motions_at_rest_and_steps_back_have_no_chord_deviation() -> None:
    plan = load("hit")
    still = plan.changed(
        path=np.repeat(plan.motion.path[:, :1], plan.motion.path.shape[1], axis=1)
    )
    assert (
        np.abs(
            chord_deviation_bounds(
                SplineCurve(still.motion), np.linspace(0, 1, 60), np.ones(6)
            )
        ).max()
        < 1e-15
    )
    assert (
        chord_deviation_bounds(
            SplineCurve(plan.motion), np.array([0.5, 0.51, 0.3, 0.31]), np.ones(6)
        )[1]
        == 0
    )
