"""Contacts between two moments: peaks of depth are found, and nothing else changes."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from cnpgen.judges.plans.bow import bows
from cnpgen.judges.plans.closer import Intervals
from cnpgen.judges.plans.course import course
from cnpgen.problems.load import load_problem
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.problem import Problem
from cnpgen.problems.robot import load_robot
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.motion import Motion
from cnpgen.world.pairs import PairDistances
from cnpgen.world.path import PathWorld
from tests.conftest import some
from tests.examples.plans import bent, load
from tests.examples.shaped_robot import write_problem

judge_module = import_module("cnpgen.judges.plans.judge")  # the package has a function of the same name


@pytest.mark.parametrize(("by", "seed"), some([(0.0, 0), (0.005, 3), (0.01, 5), (0.02, 2)], 1, "slow"))
def test_where_edges_pass_each_other_between_two_moments_the_peak_is_found(
    by: float, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = bent(load("dragging"), by, seed=seed)
    found = plan.judged()
    monkeypatch.setattr(judge_module, "look_closer", lambda _, **__: iter(()))
    coarse, fine = plan.judged(), plan.judged(step=2e-5)
    deepest = fine.margins["object contact"].excess
    assert deepest - coarse.margins["object contact"].excess > 1e-4
    assert found.margins["object contact"].excess == pytest.approx(deepest, abs=1e-5)
    assert found.margins["object contact"].time == pytest.approx(fine.margins["object contact"].time, abs=1e-4)
    others = [{name: margin for name, margin in v.margins.items() if margin.unit != "m"} for v in (found, coarse)]
    assert others[0] == others[1]
    assert found.metrics.to_dict() == coarse.metrics.to_dict()
    assert found.paper == coarse.paper
    assert found.samples == coarse.samples


@pytest.mark.parametrize(("seed", "step"), [(9, 1e-3), (8, 3e-3)])
def test_a_peak_far_from_the_deepest_moment_is_found_where_it_decides(seed: int, step: float) -> None:
    """The object touches twice; where it is a little less deep at the moments, it is deeper between them."""
    plan = bent(load("dragging"), 0.02, seed=seed)
    deepest = plan.judged(step=step / 40).margins["object contact"]
    moments = plan.judged(step=step).margins["object contact"]
    assert abs(deepest.time - moments.time) > 10 * step
    strict = plan.with_constraint("ObjectContact", tolerance=moments.excess + 2e-5).judged(step=step)
    found = strict.margins["object contact"]
    assert not found.ok
    assert found.excess == pytest.approx(deepest.excess, abs=2e-5)
    assert found.time == pytest.approx(deepest.time, abs=step)


def between(room: list[float], least: list[float]) -> Intervals:
    """Intervals between moments at which there is so much room; in each of them so much is certain."""
    moments, values = np.linspace(0, 1, len(room)), np.array(room)
    return Intervals(*(np.column_stack([each[:-1], each[1:]]) for each in (moments, values)), np.array(least))


def test_intervals_beside_the_deepest_moment_are_divided() -> None:
    assert between([5.0, 1.0, 3.0, 3.0], [1.0] * 3).deepest().tolist() == [True, True, False]
    assert between([1.0, 2.0, 3.0], [0.0] * 2).deepest().tolist() == [True, False]
    assert between([3.0, 2.0, 1.0], [0.0] * 2).deepest().tolist() == [False, True]


def test_intervals_that_could_hide_more_than_is_allowed_are_divided() -> None:
    assert not between([5.0, 1.0, 3.0], [0.0, 1.0]).hiding().any()
    assert between([5.0, 1.0, 3.0, 2.0], [-1e-9, 1.0, -np.inf]).hiding().tolist() == [True, False, True]


def test_where_more_than_is_allowed_is_exceeded_anyway_nothing_is_searched() -> None:
    assert not between([5.0, -0.1, 3.0], [-50.0] * 2).hiding().any()
    assert not between([5.0, np.nan, 3.0], [-50.0] * 2).hiding().any()


def test_of_more_intervals_than_can_be_looked_into_those_that_hide_most_are_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cnpgen.judges.plans.closer.MOST", 2)
    found = between([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [-1.0, -1.0, -3.0, -1.0, -2.0]).hiding()
    assert np.flatnonzero(found).tolist() == [2, 4]


@pytest.mark.parametrize(("label", "kind"), [("transport", "object"), ("dragging", "object"), ("transport", "segment")])
def test_what_is_certain_between_two_moments_holds_at_moments_between(label: str, kind: str) -> None:
    plan = bent(load(label), 0.01, seed=1)
    (tops,) = obstacle_tops(plan.problem, plan.start_xyz, plan.goal_xyz)
    assert_certain(plan.problem, plan.robot, plan.motion, tops, kind)


@pytest.mark.parametrize("kind", ["shape", "self"])
def test_it_holds_for_the_pieces_of_a_robot(kind: str, tmp_path: Path) -> None:
    problem = load_problem(write_problem(tmp_path))
    robot = load_robot(problem)
    path = np.linspace([1.2, -0.3, 0.4, 0.0], [0.4, 0.3, 1.2, 1.0], 15)[None]
    assert_certain(problem, robot, Motion(path, np.ones((1, 20))), np.array([0.3, 0.9]), kind)


def assert_certain(problem: Problem, robot: Robot, motion: Motion, tops: np.ndarray, kind: str) -> None:
    """By as much as the nearest body is certain to be away all the way, it is away at every moment of a finer grid."""
    world = PathWorld(robot, problem.obstacle, problem.object_size)
    s, finer = np.linspace(0, 1, 41), np.linspace(0, 1, 40 * 8 + 1)

    def pairs_at(phases: np.ndarray) -> PairDistances:
        states = course(motion, phases)
        world.set_path(states.q, states.dq, states.ddq, tops)
        return getattr(world, f"{kind}_pairs")()

    every = pairs_at(finer)
    room = np.min([[every.measure(pair, k)[0] for k in range(len(finer))] for pair in range(len(every.bounds))], axis=0)
    nearest = np.array([room[8 * k : 8 * k + 9].min() for k in range(40)])
    pairs, reach = pairs_at(s), world.reach(np.abs(motion.path[0]).max(axis=0))
    ways, leave = reach @ np.abs(np.diff(world.q, axis=1)), bows(motion, s, reach)
    pairs.smallest()  # what it found is used
    for least in (np.median(nearest), nearest.min() - 0.03):
        certain = pairs.between(np.full(len(pairs.bounds), least), ways, leave)
        assert (certain <= nearest - least + 1e-9).all()
        clearly = nearest - least > 2 * leave + 2e-3
        assert clearly.any() or least > nearest.min()
        assert (certain[clearly] >= 0).all(), "what is clearly away is found to be"


def test_a_peak_at_either_end_is_no_trouble() -> None:
    """The object stands deepest at its very start, or at its very end."""
    plan = load("transport")
    for ends in ((0.01, 0.0), (0.0, 0.01)):
        start, goal = (
            xyz + np.array([0, 0, up]) for xyz, up in zip((plan.start_xyz, plan.goal_xyz), ends, strict=True)
        )
        verdict = type(plan)(plan.problem, plan.robot, plan.motion, plan.boundary, start, goal).judged()
        margin = verdict.margins["object contact"]
        assert margin.excess == pytest.approx(0.0095, abs=1e-3)
        assert (margin.phase < 0.5) == (ends[0] > 0)
