"""Joint-space paths around obstacles: free of collisions by meshes, reproducible, and needed by some tasks."""

from collections.abc import Callable

import numpy as np
import pytest

from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.refine import attempts, rrt_connect
from cnpgen.refine.initial_guesses import fit_to_path
from cnpgen.refine.rrt_connect import (
    Follow,
    RestSpace,
    find_path,
    find_paths,
    follow_line,
)
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import Outcome
from cnpgen.trajectory.boundary import assemble
from cnpgen.trajectory.spline_motion import Motion
from tests.conftest import needs_compiler
from tests.examples.meshes import Meshes
from tests.examples.narrow import BESIDE_WALL, WALL, between, narrow, refiner

pytestmark = needs_compiler


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return narrow(tmp_path_factory.mktemp("wall"), WALL)


def space_of(problem: Problem) -> RestSpace:
    return refiner(problem).rest_space(between(problem, BESIDE_WALL))


def until(collides: Callable[[np.ndarray], np.ndarray]) -> Follow:
    """Follow states up to the first one that collides."""

    def follow(q: np.ndarray) -> np.ndarray:
        collisions = collides(q)
        return q[:, : int(np.argmax(collisions))] if collisions.any() else q

    return follow


def test_a_path_over_a_wall_is_free_of_collisions(wall):
    robot, follow = load_robot(wall), space_of(wall).follow
    assert not follow_line(*BESIDE_WALL, follow)[1]
    path = find_path(*BESIDE_WALL, robot, follow, seed=0)
    assert np.array_equal(path[[0, -1]], BESIDE_WALL)
    assert np.abs(np.diff(path, axis=0)).max() < 1.001 * rrt_connect.STATE_SPACING
    meshes = Meshes(wall, robot, wall.path.parent)
    states = np.concatenate(
        [path, (path[1:] + path[:-1]) / 2]
    )  # the checked states, and their midpoints
    assert min(min(meshes.distances(q)) for q in states) > -0.01


def test_a_line_is_free_up_to_the_first_state_that_is_not():
    sizes = []

    def follow(q: np.ndarray) -> np.ndarray:
        sizes.append(q.shape[1])
        return until(lambda q: q[0] > 1.5)(q)

    states, reached = follow_line(np.zeros(2), np.array([1.4, 1.0]), follow)
    assert reached
    np.testing.assert_array_equal(states[-1], [1.4, 1.0])
    states, reached = follow_line(np.zeros(2), np.array([3.0, 1.0]), follow)
    assert not reached
    assert 1.5 - rrt_connect.STATE_SPACING < states[-1, 0] <= 1.5
    assert max(sizes) <= rrt_connect.STATES_PER_CHECK


def test_a_line_ends_where_its_states_are_not_close():
    states, reached = follow_line(
        np.zeros(2), np.ones(2), lambda q: np.where(q > 0.5, q + 1.0, q)
    )
    assert not reached
    assert 0.5 - rrt_connect.STATE_SPACING < states.max() <= 0.5


def test_no_path_is_found_if_there_is_none(wall, monkeypatch):
    monkeypatch.setattr(rrt_connect, "MAX_EXTENSIONS", 50)
    closed = until(lambda q: np.abs(q[0]) < 0.1)
    assert list(find_paths(*BESIDE_WALL, load_robot(wall), closed)) == []


def test_a_valid_line_is_the_only_path(wall):
    (path,) = find_paths(*BESIDE_WALL, load_robot(wall), lambda q: q)
    np.testing.assert_array_equal(path[[0, -1]], BESIDE_WALL)
    np.testing.assert_allclose(np.diff(path, 2, axis=0), 0, atol=1e-12)


def test_a_path_is_reproducible(wall):
    gate = until(lambda q: (np.abs(q[0]) < 0.1) & (q[1] < 0.5))
    paths = [
        find_path(*BESIDE_WALL, load_robot(wall), gate, seed=seed) for seed in (0, 0, 1)
    ]
    assert np.array_equal(paths[0], paths[1])
    assert not np.array_equal(paths[0], paths[2])


def test_a_motion_along_a_path_meets_the_boundary_conditions(wall):
    robot, task, spec = load_robot(wall), between(wall, BESIDE_WALL), wall.trajectory
    path = np.array([BESIDE_WALL[0], [0.0, -1.0, 0.8, 0.2], BESIDE_WALL[1]])
    interior, rate = fit_to_path(path, task.boundary, robot.velocity_limit, spec)
    motion = Motion(
        assemble(task.boundary, interior[None], rate[None], spec),
        rate[None],
        spec.degree,
    )
    states = motion.at(np.linspace(0, 1, 50))
    assert np.abs(states.q[0, [0, -1]] - BESIDE_WALL).max() < 1e-12
    assert np.abs(states.dq[0, [0, -1]]).max() < 1e-12
    assert np.abs(states.q[0] - path[1]).max(axis=1).min() < 0.1
    assert (np.abs(states.dq) < 1.5 * robot.velocity_limit).all()


@pytest.mark.slow
def test_an_arm_moves_over_a_wall_that_no_other_guess_avoids(wall, monkeypatch):
    robot, tool, task = load_robot(wall), refiner(wall), between(wall, BESIDE_WALL)
    checker = PlanChecker(wall, robot, degree=tool.spec.degree)
    found = refine_task(tool, checker, task)
    assert found.valid
    assert found.outcome in {
        Outcome.TIME_SCALED,
        Outcome.RESTARTED,
        Outcome.SOLVED_FINE,
    }
    meshes = Meshes(wall, robot, wall.path.parent)
    states = (
        Motion(found.path[None], found.rate[None], tool.spec.degree)
        .at(np.linspace(0, 1, 300))
        .q[0]
    )
    assert (
        min(min(meshes.distances(q)) for q in states) > -1e-4
    )  # what the problem allows
    monkeypatch.setattr(
        attempts, "along_tree_paths", lambda refiner, task, best: iter(())
    )
    assert not refine_task(tool, checker, task).valid
