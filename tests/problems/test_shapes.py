"""Clearance of a robot that has a shape: capsules ask for more than the pieces of its links, which decide."""

from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from cnpgen.kernels.symbolic.convex_distances import segment_distance
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.link_clearance import SelfClearance
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.shape.link_pairs import segment_distances
from cnpgen.robots.solid import place_obstacles
from tests.conftest import some
from tests.examples.shaped_robot import KINDS, write_problem
from tests.problems.test_constraint_derivatives import differences
from tests.problems.test_constraints import Bench

CLEARANCES = {
    "obstacles": RobotClearance(tolerance=1e-4, distance=0.02),
    "itself": SelfClearance(tolerance=1e-4),
}
OBSTACLE_POSES = np.array([0.3, 0.9])


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(load_problem(write_problem(tmp_path_factory.mktemp("crane"))))


def symbolic(
    bench: Bench,
    constraint: Constraint,
    form: str,
    obstacle_poses: np.ndarray = OBSTACLE_POSES,
) -> tuple[ca.Function, Condition]:
    """Return the smallest margin of the symbolic form as a function of q; the form's condition."""
    (q_sx, q), zero = symbols("q", bench.robot.n), [0.0] * bench.robot.n
    state = SymbolicState(
        bench.robot,
        q,
        zero,
        zero,
        obstacle_poses.tolist(),
        bench.problem.obstacle,
        None,
    )
    found = (
        constraint.symbolic_at(state, "goal")
        if form == "symbolic_at"
        else getattr(constraint, form)(state)
    )
    (condition,) = found
    return ca.Function(
        "clearance", [q_sx], [ca.mmin(ca.vertcat(*condition.g) - condition.lower)]
    ), condition


def states(bench: Bench, count: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    return random.uniform(
        bench.robot.position_lower, bench.robot.position_upper, (count, bench.robot.n)
    )


def clearance(bench: Bench, constraint: Constraint, q: np.ndarray) -> float:
    """Return the smallest margin of the measured form [m]."""
    (condition,) = constraint.measured(bench.state(q, obstacle_poses=OBSTACLE_POSES))
    return float(np.min(np.array(condition.g) - condition.lower))


@pytest.mark.parametrize("name", CLEARANCES)
@pytest.mark.parametrize(
    "form", some(["symbolic", "penalized", "symbolic_at"], 1, "slow")
)
def test_what_capsules_clear_is_clear(bench, name, form):
    """Of pairs of links whose capsules are no use, the solvers' forms know nothing."""
    function, condition = symbolic(bench, CLEARANCES[name], form)
    assert condition.sufficient
    clear = 0
    for q in states(bench, 400, seed=1):
        if float(function(q)) >= 0 and (name == "obstacles" or form == "symbolic_at"):
            clear += 1
            assert clearance(bench, CLEARANCES[name], q) > -1e-9
    assert clear > 50 or (name == "itself" and form != "symbolic_at")


@pytest.mark.slow
@pytest.mark.parametrize("form", ["symbolic", "penalized"])
def test_what_capsules_clear_of_obstacles_of_every_kind_is_clear(tmp_path, form):
    bench = Bench(load_problem(write_problem(tmp_path, obstacles=KINDS)))
    constraint, obstacle_poses = (
        CLEARANCES["obstacles"],
        place_obstacles(bench.problem.obstacle),
    )
    function, condition = symbolic(bench, constraint, form, obstacle_poses)
    assert condition.sufficient
    assert len(constraint.solved(bench.world)[0].g) == len(condition.g)
    clear = 0
    for q in states(bench, 300, seed=1):
        if float(function(q)) >= 0:
            clear += 1
            (measured,) = constraint.measured(
                bench.state(q, obstacle_poses=obstacle_poses)
            )
            assert min(measured.g) >= constraint.distance
    assert clear > 30


@pytest.mark.parametrize("name", CLEARANCES)
def test_capsules_are_no_further_off_than_their_overhangs(bench, name):
    """Parts with a distance above both overhangs have disjoint capsules."""
    function, _ = symbolic(bench, CLEARANCES[name], "symbolic_at")
    most = 2 * max(capsule.overhang for capsule in bench.robot.shape.capsules)
    far = [
        q
        for q in states(bench, 400, seed=2)
        if clearance(bench, CLEARANCES[name], q) > most
    ]
    assert all(float(function(q)) > 0 for q in far)


@pytest.mark.parametrize("name", CLEARANCES)
def test_a_met_and_a_violated_case(bench, name):
    met = np.array([1.57, -0.2, 0.4, 0.0])
    violated = {
        "obstacles": np.array([0.0, 0.3, 0.0, 0.0]),
        "itself": np.array([0.0, 0.6, 2.3, 0.0]),
    }[name]
    assert clearance(bench, CLEARANCES[name], met) > 0.01
    assert clearance(bench, CLEARANCES[name], violated) < -0.01


def test_the_distance_that_is_asked_for_is_kept(bench):
    for q in states(bench, 20, seed=3):
        near, far = (
            clearance(bench, RobotClearance(tolerance=0.0, distance=d), q)
            for d in (0.0, 0.05)
        )
        assert near - far == pytest.approx(0.05)


@cache
def _distance() -> tuple[ca.Function, ca.Function]:
    points = [symbols(name, 3) for name in "abcd"]
    (a, b, c, d), columns = (
        [scalars for _, scalars in points],
        [column for column, _ in points],
    )
    distance = segment_distance((a, b), (c, d), freeze=lambda value: value)
    gradient = ca.densify(ca.jacobian(distance, ca.vertcat(*columns)))
    return ca.Function("distance", columns, [distance]), ca.Function(
        "gradient", columns, [gradient]
    )


def segments(count: int) -> list[list[np.ndarray]]:
    random = np.random.default_rng(5)
    return [list(points) for points in random.uniform(-1, 1, (count, 4, 3))]


def test_the_distance_of_segments_is_that_of_their_closest_points():
    shares = np.linspace(0, 1, 101)
    for a, b, c, d in segments(200):
        one, other = a + np.outer(shares, b - a), c + np.outer(shares, d - c)
        nearest = np.linalg.norm(one[:, None] - other[None], axis=2).min()
        found = float(_distance()[0](a, b, c, d))
        assert nearest - 0.02 < found < nearest + 1e-6
        assert found == pytest.approx(
            float(segment_distances(*(x[None] for x in (a, b, c, d)))[0]), abs=1e-6
        )


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 1]], 1.0),  # parallel
        ([[0, 0, 0], [1, 0, 0], [2, 0, 1], [3, 0, 1]], np.sqrt(2)),
        ([[0, 0, 0], [0, 0, 0], [0, 3, -1], [0, 3, 1]], 3.0),  # a point
        ([[0, 0, 0], [0, 0, 0], [1, 1, 1], [1, 1, 1]], np.sqrt(3)),
        ([[0, 0, 0], [2, 0, 0], [1, -1, 0], [1, 1, 0]], 0.0),  # they cross
    ],
)
def test_segments_in_special_positions(points: Any, expected: float):
    assert float(_distance()[0](*points)) == pytest.approx(expected, abs=2e-6)


def test_the_gradient_of_the_distance_is_that_of_its_differences():
    def value(*points: np.ndarray) -> np.ndarray:
        return np.array(_distance()[0](*points)).ravel()

    for points in segments(40):
        expected = differences(value, points)
        np.testing.assert_allclose(
            np.array(_distance()[1](*points)), expected, atol=1e-6
        )


def test_a_problem_with_a_shape_is_judged_by_its_pieces_along_a_path(
    tmp_path: Path, bench: Bench
):
    """At the state where the capsules are deepest, the measured form of a path says what that of a state says."""
    from cnpgen.world.path import PathWorld

    path = np.linspace(*states(bench, 2, seed=8), 60).T
    world = PathWorld(bench.robot, bench.problem.obstacle)
    world.set_path(path, 0 * path, 0 * path, OBSTACLE_POSES)
    for constraint in CLEARANCES.values():
        (condition,) = constraint.measured(world)
        least = min(float(np.min(each)) for each in condition.g)
        assert least - condition.lower[0] == pytest.approx(
            min(clearance(bench, constraint, q) for q in path.T), abs=1e-8
        )
