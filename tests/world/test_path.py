"""Many states at once are what the one-state world says of each, and distances that are skipped hide nothing."""

import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.interpolate import BSpline

from cnpgen.errors import RecipeError
from cnpgen.problems.load import load_problem
from cnpgen.problems.problem import Problem
from cnpgen.problems.robot import load_robot
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.motion import Motion
from cnpgen.world.path import PathWorld
from cnpgen.world.state import World
from tests.examples.chains import chain

PROBLEMS = {name: load_problem(name) for name in ("airhockey", "heavy-object")}
ROBOTS = {name: load_robot(problem) for name, problem in PROBLEMS.items()}
PLANS = json.loads((Path(__file__).parents[1] / "data" / "plans.json").read_text())


def wandering(robot: Robot, *, seed: int, count: int = 150) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smooth random joint motions, shape (n, count) each; their derivatives are as large as the limits."""
    random, s = np.random.default_rng(seed), np.linspace(0, 1, count)
    control = random.uniform(robot.position_lower, robot.position_upper, (9, robot.n))
    curve = BSpline(np.concatenate([[0] * 4, np.linspace(0, 1, 6), [1] * 4]), control[:9], 4)
    dq, ddq = (random.uniform(-1, 1, (robot.n, count)) for _ in range(2))
    return curve(s).T, dq * robot.velocity_limit[:, None], ddq * robot.acceleration_limit[:, None]


def one_by_one(problem: Problem, robot: Robot, path: tuple[np.ndarray, ...], tops: np.ndarray) -> list[World]:
    """The same states, each in a world of its own."""
    worlds = []
    for q, dq, ddq in zip(*(values.T for values in path), strict=True):
        world = World(robot, problem.obstacle, problem.object_size)
        world.set_state(q.copy(), dq.copy(), ddq.copy(), tops)
        worlds.append(world)
    return worlds


@pytest.fixture(scope="module", params=["airhockey", "heavy-object"])
def both(request: pytest.FixtureRequest) -> tuple[PathWorld, list[World]]:
    problem, robot = PROBLEMS[request.param], ROBOTS[request.param]
    path, tops = wandering(robot, seed=1), np.full(len(problem.obstacle), 0.3)
    world = PathWorld(robot, problem.obstacle, problem.object_size)
    world.set_path(*path, tops)
    return world, one_by_one(problem, robot, path, tops)


@pytest.mark.parametrize(
    "what", ["q", "dq", "ddq", "torque", "tip_position", "tip_rotation", "tip_velocity", "tip_acceleration"]
)
def test_every_quantity_is_that_of_the_one_state_world(both, what):
    world, worlds = both
    expected = np.stack([getattr(one, what) for one in worlds], axis=-1)
    found = getattr(world, what)
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_the_tip_velocity_at_one_state_is_that_of_all(both):
    world, _ = both
    for k in (0, 7, -1):
        np.testing.assert_array_equal(world.tip_velocity_at(k), world.tip_velocity[:, k])


def test_measured_constraints_are_those_of_every_single_state(both):
    """All but the distances, of which only the smallest is exact."""
    world, worlds = both
    problem = PROBLEMS["heavy-object" if world.robot.n == 7 else "airhockey"]
    for constraint in problem.constraint:
        one = [constraint.measured(state) for state in worlds]
        for index, condition in enumerate(constraint.measured(world)):
            expected = np.array([conditions[index].g for conditions in one]).T
            found = np.array(condition.g)
            assert found.shape == expected.shape
            if condition.name in ("robot clearance", "object contact"):
                assert found.min() == pytest.approx(expected.min(), abs=1e-9)
                assert np.all(found <= expected + 1e-9)
            else:
                np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_an_object_is_needed_to_measure_its_distances():
    with pytest.raises(RecipeError, match="no \\[object\\]"):
        PathWorld(
            ROBOTS["airhockey"], PROBLEMS["airhockey"].obstacle, PROBLEMS["airhockey"].object_size
        ).object_distances()


def test_without_obstacles_there_are_no_distances():
    world = PathWorld(ROBOTS["airhockey"], PROBLEMS["airhockey"].obstacle, PROBLEMS["airhockey"].object_size)
    world.set_path(*wandering(world.robot, seed=2), np.zeros(0))
    assert world.segment_distances() == []


def test_states_that_are_not_finite_have_no_distances():
    world = PathWorld(ROBOTS["heavy-object"], PROBLEMS["heavy-object"].obstacle, PROBLEMS["heavy-object"].object_size)
    q, dq, ddq = wandering(world.robot, seed=3, count=5)
    q[2, 3] = np.nan
    world.set_path(q, dq, ddq, np.full(2, 0.3))
    assert np.isnan([*world.segment_distances(), *world.object_distances()]).all()


# --- distances --------------------------------------------------------------------------------------------------------


def brute_force(world: PathWorld, problem: Problem, tops: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    one = World(world.robot, problem.obstacle, problem.object_size)
    segments, objects = [], []
    for state in zip(world.q.T, world.dq.T, world.ddq.T, strict=True):
        one.set_state(*(values.copy() for values in state), tops)
        segments.append(one.segment_distances())
        objects.append(one.object_distances())
    return np.array(segments).T, np.array(objects).T


def assert_nothing_is_hidden(found: list[np.ndarray], expected: np.ndarray) -> None:
    values = np.array(found)
    assert values.shape == expected.shape
    assert values.min() == pytest.approx(expected.min(), abs=1e-9)
    assert np.all(values <= expected + 1e-9)
    where = np.unravel_index(np.argmin(values), values.shape)
    assert values[where] == pytest.approx(expected[where], abs=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_skipping_agrees_with_brute_force_on_random_motions(seed):
    """Random motions run through the pedestals as often as they stay clear of them."""
    problem, world = (
        PROBLEMS["heavy-object"],
        PathWorld(ROBOTS["heavy-object"], PROBLEMS["heavy-object"].obstacle, PROBLEMS["heavy-object"].object_size),
    )
    tops = np.random.default_rng(seed).uniform(-0.3, 0.6, 2)
    world.set_path(*wandering(world.robot, seed=10 + seed, count=400), tops)
    segments, objects = brute_force(world, problem, tops)
    assert_nothing_is_hidden(world.segment_distances(), segments)
    assert_nothing_is_hidden(world.object_distances(), objects)


def test_a_path_that_is_not_exact_measures_only_where_bounds_do_not_show_enough():
    """Its distances are bounds that are enough, where there are such, and those of an exact path elsewhere."""
    problem = PROBLEMS["heavy-object"]
    world, tops = PathWorld(ROBOTS["heavy-object"], problem.obstacle, problem.object_size), np.full(2, -0.3)
    states = wandering(world.robot, seed=12, count=400)
    told = {}
    for exact in (True, False):
        world.set_path(*states, tops, exact=exact)
        for what in ("segment", "object"):
            distances = getattr(world, f"{what}_distances")
            least = np.min(getattr(world, f"{what}_pairs")().bounds)
            told[what, exact] = [np.array(distances(enough)) for enough in (least - 1e-3, least + 1e-3)]
    for what in ("segment", "object"):
        (known, _), (rough, measured) = told[what, True], told[what, False]
        assert (rough <= known + 1e-9).all()
        assert rough.min() < known.min() - 1e-3
        np.testing.assert_array_equal(measured, known)


def test_skipping_agrees_with_brute_force_on_a_plan_that_slides_along_a_pedestal():
    problem, plan = PROBLEMS["heavy-object"], PLANS["dragging"]
    motion = Motion(np.array([plan["path"]]), np.array([plan["rate"]]))
    states = motion.at(np.linspace(0, 1, 700))
    world, tops = (
        PathWorld(ROBOTS["heavy-object"], problem.obstacle, problem.object_size),
        np.array([plan["start_xyz"][2], plan["goal_xyz"][2]]) - 0.15,
    )
    world.set_path(states.q[0].T, states.dq[0].T, states.ddq[0].T, tops)
    segments, objects = brute_force(world, problem, tops)
    assert_nothing_is_hidden(world.segment_distances(), segments)
    assert_nothing_is_hidden(world.object_distances(), objects)


def test_nearly_all_states_are_skipped(monkeypatch: pytest.MonkeyPatch):
    problem, plan = PROBLEMS["heavy-object"], PLANS["transport"]
    states = Motion(np.array([plan["path"]]), np.array([plan["rate"]])).at(np.linspace(0, 1, 1500))
    world = PathWorld(ROBOTS["heavy-object"], problem.obstacle, problem.object_size)
    tops = np.array([plan["start_xyz"][2], plan["goal_xyz"][2]]) - 0.15
    world.set_path(states.q[0].T, states.dq[0].T, states.ddq[0].T, tops)
    calls = []
    for name in ("object_apart", "segment_apart"):
        measure = getattr(world._scene, name)
        monkeypatch.setattr(world._scene, name, lambda *where, measure=measure: (calls.append(1), measure(*where))[1])
    world.object_distances()
    world.segment_distances()
    assert 2 <= len(calls) < 100


def test_a_path_is_forgotten_when_the_next_one_is_set():
    world = PathWorld(ROBOTS["airhockey"], PROBLEMS["airhockey"].obstacle, PROBLEMS["airhockey"].object_size)
    first, second = wandering(world.robot, seed=6), wandering(world.robot, seed=7)
    world.set_path(*first, np.zeros(0))
    before = world.torque, world.tip_velocity
    world.set_path(*second, np.zeros(0))
    assert not np.array_equal(before[0], world.torque)
    assert not np.array_equal(before[1], world.tip_velocity)


# --- the curve that both the refiner and the verdict evaluate ---------------------------------------------------------


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_a_motion_is_scipys_spline_of_its_control_points(label):
    """Knots written out; derivatives in time by finite differences of q(t) with t from integrating ds/dt = r(s)."""
    from scipy.integrate import solve_ivp

    path, rate = np.array(PLANS[label]["path"]), np.array(PLANS[label]["rate"])
    knots = [np.r_[np.zeros(8), np.arange(1, c - 7) / (c - 7), np.ones(8)] for c in (len(path), len(rate))]
    p, r = BSpline(knots[0], path, 7), BSpline(knots[1], rate, 7)
    motion = Motion(path[None], rate[None])
    phase = solve_ivp(
        lambda _, s: r(np.clip(s, 0, 1)),
        (0, 0.9 * motion.duration()[0]),
        [0.0],
        rtol=1e-12,
        atol=1e-14,
        dense_output=True,
    ).sol
    t, h = np.linspace(0.1, 0.8, 30) * motion.duration()[0], 1e-4
    q = [p(phase(t + shift)[0]) for shift in (-2 * h, -h, 0, h, 2 * h)]
    states = motion.at(phase(t)[0])
    np.testing.assert_allclose(states.q[0], q[2], atol=1e-13)
    np.testing.assert_allclose(states.dq[0], (q[0] - 8 * q[1] + 8 * q[3] - q[4]) / (12 * h), atol=1e-7)
    np.testing.assert_allclose(
        states.ddq[0], (-q[0] + 16 * q[1] - 30 * q[2] + 16 * q[3] - q[4]) / (12 * h**2), atol=1e-3
    )
    np.testing.assert_allclose(motion.time_at(np.sort(phase(t)[0]))[0], t, atol=1e-10)


@pytest.mark.parametrize("joints", [1, 2])
def test_arms_of_few_joints_have_a_row_of_torques_for_each(joints: int, tmp_path: Path) -> None:
    robot = load_robot(chain(tmp_path, joints, jerk=False))
    states, data = np.random.default_rng(0).normal(size=(3, joints, 7)), robot.model.createData()
    world = PathWorld(robot, (), None)
    world.set_path(*states, np.zeros(0))
    expected = [pin.rnea(robot.model, data, *(values[:, k].copy() for values in states)) for k in range(7)]
    np.testing.assert_allclose(world.torque, np.transpose(expected), atol=1e-12)
