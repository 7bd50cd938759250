"""Compiled RRT-Connect: clear by Coal, at rest within bounds, reproducible, shortened, and absent where no path exists."""

from itertools import pairwise

import casadi
import numpy as np
import pytest

from cnpgen.kernels.collision.collision_checker import (
    CollisionChecker,
    load_collision_library,
)
from cnpgen.kernels.collision.tree_search import (
    RestConditions,
    TreeSettings,
    estimated_duration,
    find_tree_path,
)
from cnpgen.kernels.compiled_kernel import CompiledKernel
from cnpgen.kernels.interpreted_kernel import InterpretedKernel
from cnpgen.kernels.library import KernelLibrary, choose_backend
from cnpgen.kernels.tape import tape_from_function
from cnpgen.problems.load_robot import load_robot
from cnpgen.refine.rrt_connect import WITHOUT_LINKS
from cnpgen.robots.solid import place_obstacles
from tests.conftest import needs_compiled_code
from tests.examples.coal_hulls import CoalHulls
from tests.examples.narrow import BESIDE_WALL, WALL, narrow

pytestmark = needs_compiled_code


@pytest.fixture(scope="module")
def setting(tmp_path_factory):
    problem = narrow(tmp_path_factory.mktemp("wall"), WALL)
    robot = load_robot(problem)
    checker = CollisionChecker(
        load_collision_library(KernelLibrary(*choose_backend("compiled"), "", {})),
        robot,
    )
    checker.place(problem.obstacle, place_obstacles(problem.obstacle))
    return problem, robot, checker


def search(setting, ends=BESIDE_WALL, seed=0, **settings):
    _, robot, checker = setting
    box = robot.position_lower, robot.position_upper
    return find_tree_path(
        checker,
        tuple(ends),
        box,
        robot.velocity_limit,
        TreeSettings(0.0, 0.0, **settings),
        seed=seed,
    )


def along(path: np.ndarray, step: float = 0.01) -> np.ndarray:
    lines = [
        a[:, None]
        + (b - a)[:, None] * np.linspace(0, 1, int(np.abs(b - a).max() / step) + 2)
        for a, b in pairwise(path)
    ]
    return np.concatenate(lines, axis=1)


@pytest.mark.parametrize("margin", [0.0, 0.006])
def test_paths_around_a_wall_are_clear_by_coal(setting, margin):
    problem, robot, _ = setting
    path = search(setting, margin=margin)
    assert len(path) > 2
    np.testing.assert_array_equal(path[[0, -1]], BESIDE_WALL)
    q, poses = along(path), place_obstacles(problem.obstacle)
    distances = CoalHulls(problem, robot).measure(q, poses).min(axis=1)
    away = (
        np.minimum(*(np.abs(q.T - end).max(axis=1) for end in BESIDE_WALL))
        > TreeSettings(0.0, 0.0).margin_ramp
    )
    assert distances.min() > -0.004  # between checked states
    assert distances[away].min() > margin - 0.004
    assert (
        not CoalHulls(problem, robot)
        .clear_states(np.linspace(*BESIDE_WALL, 100).T.copy(), poses)
        .all()
    )


def test_paths_are_reproducible(setting):
    paths = [search(setting, seed=seed) for seed in (0, 0, 1)]
    assert np.array_equal(paths[0], paths[1])
    assert not np.array_equal(paths[0], paths[2])


def test_one_tree_reaches_one_of_several_goals(setting):
    """In a wall, or behind it: paths end exactly in a goal, and Coal finds their states clear."""
    problem, robot, _ = setting
    start, goal = BESIDE_WALL
    goals = np.array([[0.0, -0.1, 0.4, 0.0], goal + 0.2, goal])
    hulls, poses = CoalHulls(problem, robot), place_obstacles(problem.obstacle)
    reached = set[int]()
    for seed in range(6):
        path = search(setting, ends=(start, goals), seed=seed, margin=0.003)
        np.testing.assert_array_equal(path[0], start)
        ends = np.flatnonzero((goals == path[-1]).all(axis=1))
        assert len(ends) == 1
        reached.add(int(ends[0]))
        assert (
            hulls.measure(along(path), poses).min() > -0.004
        )  # between checked states
    assert reached
    assert reached <= {1, 2}
    # One goal in an array of its own gives the same path.
    single = search(setting, ends=(start, goal[None]))
    np.testing.assert_array_equal(single, search(setting, ends=(start, goal)))
    # The fastest clear line needs no tree.
    near = start + np.array([[-0.3, 0, 0, 0], [-0.2, 0.1, 0, 0.1]])
    lines = search(setting, ends=(start, np.concatenate([goals, near])))
    np.testing.assert_array_equal(lines, [start, near[1]])


def test_the_search_ends_with_enough_nodes(setting):
    assert search(setting, max_nodes=3) is None
    assert search(setting, max_nodes=10**9) is not None


def test_shortcuts_reduce_the_estimated_duration(setting):
    velocity = setting[1].velocity_limit
    durations = [
        [
            estimated_duration(search(setting, seed=s, shortcuts=n), velocity)
            for s in range(8)
        ]
        for n in (0, 100)
    ]
    assert np.mean(durations[1]) < np.mean(durations[0])


def test_a_clear_line_is_the_path(setting):
    near = BESIDE_WALL[0] + np.array([[0.0, 0, 0, 0], [-0.2, 0.1, 0, 0.1]])
    np.testing.assert_array_equal(search(setting, ends=near), near)


def test_no_path_leads_into_an_obstacle(setting):
    inside = np.array([BESIDE_WALL[0], [0.0, -0.1, 0.4, 0.0]])
    assert search(setting, ends=inside, max_extensions=300) is None


GATE_WIDTH, GATE_HEIGHT = (
    0.2,
    0.5,
)  # states of a thin wall with q_0 near 0 need a large q_1


@pytest.fixture(scope="module")
def gate(setting):
    """Tape of ``(q, r, scene) -> (distance from the wall, q_2, 1 / r)``, where r is 1 at rest."""
    q, scene = casadi.SX.sym("q", 5), casadi.SX.sym("scene", 1)
    wall = casadi.fmax(casadi.fabs(q[0]) - GATE_WIDTH, q[1] - scene)
    g = casadi.vertcat(wall, q[2], 1 / q[4])
    return tape_from_function(casadi.Function("gate", [q, scene], [casadi.densify(g)]))


def search_at_rest(setting, residuals, seed=0, lower=0.0, scene=GATE_HEIGHT):
    """Search for a path of a robot without link geometry, whose states keep bounds only."""
    _, robot, checker = setting
    rest = RestConditions(
        residuals,
        np.eye(5)[4],
        np.array([scene]),
        np.array([lower, -np.inf, 1.0]),
        np.array([np.inf, 0.6, 1.0]),
    )
    return find_tree_path(
        CollisionChecker(checker.library, robot, WITHOUT_LINKS),
        tuple(BESIDE_WALL),
        (robot.position_lower, robot.position_upper),
        robot.velocity_limit,
        TreeSettings(None, None),
        seed=seed,
        at_rest=rest,
    )


def test_states_at_rest_keep_the_bounds_of_a_kernel(setting, gate):
    compiled = CompiledKernel(gate, choose_backend("compiled")[1])
    path = search_at_rest(setting, compiled)
    assert len(path) > 2
    q = along(path)
    beside = (np.abs(q[0]) > GATE_WIDTH) | (q[1] > GATE_HEIGHT)
    assert (np.abs(q[0, ~beside]) > GATE_WIDTH - 0.03).all()  # between checked states
    assert q[2].max() < 0.63
    np.testing.assert_array_equal(path, search_at_rest(setting, compiled))
    np.testing.assert_array_equal(
        path, search_at_rest(setting, InterpretedKernel(gate))
    )
    assert not np.array_equal(path, search_at_rest(setting, compiled, seed=1))


def test_a_line_within_the_bounds_at_rest_is_the_path(setting, gate):
    residuals = CompiledKernel(gate, choose_backend("compiled")[1])
    path = search_at_rest(setting, residuals, scene=-1.0)
    np.testing.assert_array_equal(path, BESIDE_WALL)


@pytest.mark.parametrize("values", [{"scene": 10.0}, {"scene": np.nan, "lower": 0.1}])
def test_no_path_leads_through_bounds_or_nan(setting, gate, values):
    residuals = CompiledKernel(gate, choose_backend("compiled")[1])
    assert search_at_rest(setting, residuals, **values) is None
