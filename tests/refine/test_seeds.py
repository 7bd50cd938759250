"""Ways round obstacles: free as meshes tell, the same each time, and what solves where straight lines do not."""

from collections.abc import Callable

import numpy as np
import pytest

from cnpgen.problems.problem import Problem
from cnpgen.problems.robot import load_robot
from cnpgen.refine import seeds
from cnpgen.refine.jury import Jury
from cnpgen.refine.polish import refine_task
from cnpgen.refine.seeds import Follow, Space, along_way, find_way, find_ways, go
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.task import Outcome
from cnpgen.trajectory.boundary import assemble
from cnpgen.trajectory.motion import Motion
from tests.conftest import needs_compiler
from tests.examples.meshes import Meshes
from tests.examples.narrow import BESIDE_WALL, WALL, between, narrow, refiner

pytestmark = needs_compiler


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return narrow(tmp_path_factory.mktemp("wall"), WALL)


def space_of(problem: Problem) -> Space:
    tool, task, robot = refiner(problem), between(problem, BESIDE_WALL), load_robot(problem)
    return Space(tool.stage, robot, tool.check.bounds_at_rest(task), task.tops, Hulls(problem, robot))


def until(hit: Callable[[np.ndarray], np.ndarray]) -> Follow:
    """Follow states up to the first one that hits something."""

    def follow(q: np.ndarray) -> np.ndarray:
        hits = hit(q)
        return q[:, : int(np.argmax(hits))] if hits.any() else q

    return follow


def test_a_way_leads_over_a_wall_and_touches_nothing(wall):
    robot, follow = load_robot(wall), space_of(wall).follow
    assert not go(*BESIDE_WALL, follow)[1]
    way = find_way(*BESIDE_WALL, robot, follow, seed=0)
    assert np.array_equal(way[[0, -1]], BESIDE_WALL)
    assert np.abs(np.diff(way, axis=0)).max() < 1.001 * seeds.APART
    meshes = Meshes(wall, robot, wall.path.parent)
    states = np.concatenate([way, (way[1:] + way[:-1]) / 2])  # what was looked at, and what lies between
    assert min(min(meshes.distances(q)) for q in states) > -0.01


def test_a_line_is_free_up_to_the_first_state_that_is_not():
    asked = []

    def follow(q: np.ndarray) -> np.ndarray:
        asked.append(q.shape[1])
        return until(lambda q: q[0] > 1.5)(q)

    states, reached = go(np.zeros(2), np.array([1.4, 1.0]), follow)
    assert reached
    np.testing.assert_array_equal(states[-1], [1.4, 1.0])
    states, reached = go(np.zeros(2), np.array([3.0, 1.0]), follow)
    assert not reached
    assert 1.5 - seeds.APART < states[-1, 0] <= 1.5
    assert max(asked) <= seeds.BLOCK


def test_a_line_ends_where_its_states_leap():
    states, reached = go(np.zeros(2), np.ones(2), lambda q: np.where(q > 0.5, q + 1.0, q))
    assert not reached
    assert 0.5 - seeds.APART < states.max() <= 0.5


def test_where_there_is_no_way_none_is_found(wall, monkeypatch):
    monkeypatch.setattr(seeds, "GROWTHS", 50)
    closed = until(lambda q: np.abs(q[0]) < 0.1)
    assert list(find_ways(*BESIDE_WALL, load_robot(wall), closed)) == []


def test_a_line_that_is_free_is_the_only_way(wall):
    (way,) = find_ways(*BESIDE_WALL, load_robot(wall), lambda q: q)
    np.testing.assert_array_equal(way[[0, -1]], BESIDE_WALL)
    np.testing.assert_allclose(np.diff(way, 2, axis=0), 0, atol=1e-12)


def test_a_way_is_the_same_each_time(wall):
    gate = until(lambda q: (np.abs(q[0]) < 0.1) & (q[1] < 0.5))
    ways = [find_way(*BESIDE_WALL, load_robot(wall), gate, seed=seed) for seed in (0, 0, 1)]
    assert np.array_equal(ways[0], ways[1])
    assert not np.array_equal(ways[0], ways[2])


def test_a_motion_along_a_way_keeps_its_ends(wall):
    robot, task, spec = load_robot(wall), between(wall, BESIDE_WALL), wall.trajectory
    way = np.array([BESIDE_WALL[0], [0.0, -1.0, 0.8, 0.2], BESIDE_WALL[1]])
    interior, rate = along_way(way, task.boundary, robot.velocity_limit, spec)
    motion = Motion(assemble(task.boundary, interior[None], rate[None], spec), rate[None], spec.degree)
    states = motion.at(np.linspace(0, 1, 50))
    assert np.abs(states.q[0, [0, -1]] - BESIDE_WALL).max() < 1e-12
    assert np.abs(states.dq[0, [0, -1]]).max() < 1e-12
    assert np.abs(states.q[0] - way[1]).max(axis=1).min() < 0.1
    assert (np.abs(states.dq) < 1.5 * robot.velocity_limit).all()


@pytest.mark.slow
def test_an_arm_swings_over_a_wall_that_no_other_start_leads_over(wall, monkeypatch):
    robot, tool, task = load_robot(wall), refiner(wall), between(wall, BESIDE_WALL)
    jury = Jury(wall, robot, degree=tool.spec.degree)
    found = refine_task(tool, jury, task)
    assert found.valid
    assert found.outcome in {Outcome.SLOWED, Outcome.RESTARTED}
    meshes = Meshes(wall, robot, wall.path.parent)
    states = Motion(found.path[None], found.rate[None], tool.spec.degree).at(np.linspace(0, 1, 300)).q[0]
    assert min(min(meshes.distances(q)) for q in states) > -1e-4  # what the problem allows
    monkeypatch.setattr(tool, "_around", lambda task, best: iter(()))
    assert not refine_task(tool, jury, task).valid
