"""Many states at once agree with the one-state world, and no smallest distance is skipped."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import scipy

from cnpgen.errors import RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.examples.chains import chain
from tests.examples.shipped import PROBLEMS, ROBOTS
from tests.refusals import is_refused


@cache
def stored_plans() -> Any:
    return json.loads((Path(__file__).parents[1] / "data" / "plans.json").read_text())


def wandering(
    robot: Robot, *, seed: int, count: int = 150
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw smooth random joint motions, shape (n, count) each, with derivatives as large as the limits."""
    random, s = np.random.default_rng(seed), np.linspace(0, 1, count)
    control = random.uniform(robot.position_lower, robot.position_upper, (9, robot.n))
    curve = scipy.interpolate.BSpline(
        np.concatenate([[0] * 4, np.linspace(0, 1, 6), [1] * 4]), control[:9], 4
    )
    dq, ddq = (random.uniform(-1, 1, (robot.n, count)) for _ in range(2))
    return (
        curve(s).T,
        dq * robot.velocity_limit[:, None],
        ddq * robot.acceleration_limit[:, None],
    )


def one_by_one(
    problem: Problem, robot: Robot, path: tuple[np.ndarray, ...], poses: np.ndarray
) -> list[World]:
    """Return a separate world for every state."""
    worlds = []
    for q, dq, ddq in zip(*(values.T for values in path), strict=True):
        world = World(robot, problem.obstacle, problem.object_size)
        world.set_state(q.copy(), dq.copy(), ddq.copy(), poses)
        worlds.append(world)
    return worlds


@pytest.fixture(scope="module", params=["airhockey", "heavy-object"])
def both(request: pytest.FixtureRequest) -> tuple[PathWorld, list[World]]:
    problem, robot = PROBLEMS[request.param], ROBOTS[request.param]
    path, poses = wandering(robot, seed=1), np.full(len(problem.obstacle), 0.3)
    world = PathWorld(robot, problem.obstacle, problem.object_size)
    world.set_path(*path, poses)
    return world, one_by_one(problem, robot, path, poses)


@pytest.mark.parametrize(
    "name",
    [
        "q",
        "dq",
        "ddq",
        "torque",
        "tip_position",
        "tip_rotation",
        "tip_velocity",
        "tip_acceleration",
    ],
)
def test_every_quantity_agrees_with_the_one_state_world(both, name):
    world, worlds = both
    expected = np.stack([getattr(state, name) for state in worlds], axis=-1)
    found = getattr(world, name)
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_the_tip_velocity_at_one_state_agrees_with_that_of_all(both):
    world, _ = both
    for k in (0, 7, -1):
        np.testing.assert_array_equal(
            world.tip_velocity_at(k), world.tip_velocity[:, k]
        )


def test_measured_constraints_agree_with_those_of_single_states(both):
    """Of distances only the smallest is exact."""
    world, worlds = both
    problem = PROBLEMS["heavy-object" if world.robot.n == 7 else "airhockey"]
    for constraint in problem.constraint:
        one = [constraint.measured(state) for state in worlds]
        for index, condition in enumerate(constraint.measured(world)):
            expected = np.array([conditions[index].g for conditions in one]).T
            found = np.array(condition.g)
            assert found.shape == expected.shape
            if condition.name in (
                "robot clearance",
                "object contact",
                "object clearance",
            ):
                assert found.min() == pytest.approx(expected.min(), abs=1e-9)
                assert np.all(found <= expected + 1e-9)
            else:
                np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_object_distances_without_an_object_raise_an_error():
    with is_refused(RecipeError):
        PathWorld(
            ROBOTS["airhockey"],
            PROBLEMS["airhockey"].obstacle,
            PROBLEMS["airhockey"].object_size,
        ).object_distances()


def test_without_obstacles_there_are_no_distances():
    world = PathWorld(
        ROBOTS["airhockey"],
        PROBLEMS["airhockey"].obstacle,
        PROBLEMS["airhockey"].object_size,
    )
    world.set_path(*wandering(world.robot, seed=2), np.zeros(0))
    assert world.segment_distances() == []


def test_states_that_are_not_finite_have_no_distances():
    world = PathWorld(
        ROBOTS["heavy-object"],
        PROBLEMS["heavy-object"].obstacle,
        PROBLEMS["heavy-object"].object_size,
    )
    q, dq, ddq = wandering(world.robot, seed=3, count=5)
    q[2, 3] = np.nan
    world.set_path(q, dq, ddq, np.full(2, 0.3))
    assert np.isnan([*world.segment_distances(), *world.object_distances()]).all()


# --- distances --------------------------------------------------------------------------------------------------------


def brute_force(
    world: PathWorld, problem: Problem, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    one = World(world.robot, problem.obstacle, problem.object_size)
    segments, objects = [], []
    for state in zip(world.q.T, world.dq.T, world.ddq.T, strict=True):
        one.set_state(*(values.copy() for values in state), poses)
        segments.append(one.segment_distances())
        objects.append(one.object_distances())
    return np.array(segments).T, np.array(objects).T


def assert_smallest_is_exact(found: list[np.ndarray], expected: np.ndarray) -> None:
    values = np.array(found)
    assert values.shape == expected.shape
    assert values.min() == pytest.approx(expected.min(), abs=1e-9)
    assert np.all(values <= expected + 1e-9)
    where = np.unravel_index(np.argmin(values), values.shape)
    assert values[where] == pytest.approx(expected[where], abs=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_the_search_agrees_with_brute_force_on_random_motions(seed):
    """About half of the random motions collide with the pedestals."""
    problem, world = (
        PROBLEMS["heavy-object"],
        PathWorld(
            ROBOTS["heavy-object"],
            PROBLEMS["heavy-object"].obstacle,
            PROBLEMS["heavy-object"].object_size,
        ),
    )
    poses = np.random.default_rng(seed).uniform(-0.3, 0.6, 2)
    world.set_path(*wandering(world.robot, seed=10 + seed, count=400), poses)
    segments, objects = brute_force(world, problem, poses)
    assert_smallest_is_exact(world.segment_distances(), segments)
    assert_smallest_is_exact(world.object_distances(), objects)


def test_a_path_that_is_not_exact_measures_only_if_bounds_are_not_sufficient():
    """Its distances are bounds once these are sufficient; a smaller one is exact, as that of an exact path."""
    problem = PROBLEMS["heavy-object"]
    world, poses = (
        PathWorld(ROBOTS["heavy-object"], problem.obstacle, problem.object_size),
        np.full(2, -0.3),
    )
    states = wandering(world.robot, seed=12, count=400)
    for what in ("segment", "object"):
        world.set_path(*states, poses, exact=True)
        known = np.array(getattr(world, f"{what}_distances")(0.0))
        world.set_path(*states, poses, exact=False)
        distances = getattr(world, f"{what}_distances")
        least = np.min(world.pairs("robot" if what == "segment" else what).bounds)
        bounds, raised, measured = (
            np.array(distances(sufficient))
            for sufficient in (least - 1e-3, least + 1e-3, known.min() + 1e-3)
        )
        for found in (bounds, raised):
            assert (found <= known + 1e-9).all()
        assert bounds.min() < known.min() - 1e-3
        assert raised.min() >= least + 1e-3
        np.testing.assert_array_equal(measured, known)


def test_the_search_agrees_with_brute_force_on_a_plan_that_slides_along_a_pedestal():
    problem, plan = PROBLEMS["heavy-object"], stored_plans()["dragging"]
    motion = Motion(np.array([plan["path"]]), np.array([plan["rate"]]))
    states = motion.at(np.linspace(0, 1, 700))
    world, poses = (
        PathWorld(ROBOTS["heavy-object"], problem.obstacle, problem.object_size),
        np.array([plan["start_xyz"][2], plan["goal_xyz"][2]]) - 0.15,
    )
    world.set_path(states.q[0].T, states.dq[0].T, states.ddq[0].T, poses)
    segments, objects = brute_force(world, problem, poses)
    assert_smallest_is_exact(world.segment_distances(), segments)
    assert_smallest_is_exact(world.object_distances(), objects)


def test_nearly_all_states_are_not_measured(monkeypatch: pytest.MonkeyPatch):
    problem, plan = PROBLEMS["heavy-object"], stored_plans()["transport"]
    states = Motion(np.array([plan["path"]]), np.array([plan["rate"]])).at(
        np.linspace(0, 1, 1500)
    )
    world = PathWorld(ROBOTS["heavy-object"], problem.obstacle, problem.object_size)
    poses = np.array([plan["start_xyz"][2], plan["goal_xyz"][2]]) - 0.15
    world.set_path(states.q[0].T, states.dq[0].T, states.ddq[0].T, poses)
    calls = []
    for name in ("object_distance", "segment_distance"):
        measure = getattr(world._collisions, name)
        monkeypatch.setattr(
            world._collisions,
            name,
            lambda *where, measure=measure: (calls.append(1), measure(*where))[1],
        )
    world.object_distances()
    world.segment_distances()
    assert 2 <= len(calls) < 100


def test_setting_a_path_discards_the_previous_one():
    world = PathWorld(
        ROBOTS["airhockey"],
        PROBLEMS["airhockey"].obstacle,
        PROBLEMS["airhockey"].object_size,
    )
    first, second = wandering(world.robot, seed=6), wandering(world.robot, seed=7)
    world.set_path(*first, np.zeros(0))
    before = world.torque, world.tip_velocity
    world.set_path(*second, np.zeros(0))
    assert not np.array_equal(before[0], world.torque)
    assert not np.array_equal(before[1], world.tip_velocity)


# --- the curve that the refiner and the verdict evaluate ---------------------------------------------------------


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_a_motion_equals_scipys_spline_of_its_control_points(label):
    """Use explicit knots, and finite differences of q(t) with t from integrating ds/dt = r(s)."""
    from scipy.integrate import solve_ivp

    path, rate = (
        np.array(stored_plans()[label]["path"]),
        np.array(stored_plans()[label]["rate"]),
    )
    knots = [
        np.r_[np.zeros(8), np.arange(1, c - 7) / (c - 7), np.ones(8)]
        for c in (len(path), len(rate))
    ]
    p, r = (
        scipy.interpolate.BSpline(knots[0], path, 7),
        scipy.interpolate.BSpline(knots[1], rate, 7),
    )
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
    np.testing.assert_allclose(
        states.dq[0], (q[0] - 8 * q[1] + 8 * q[3] - q[4]) / (12 * h), atol=1e-7
    )
    np.testing.assert_allclose(
        states.ddq[0],
        (-q[0] + 16 * q[1] - 30 * q[2] + 16 * q[3] - q[4]) / (12 * h**2),
        atol=1e-3,
    )
    np.testing.assert_allclose(motion.time_at(np.sort(phase(t)[0]))[0], t, atol=1e-10)


@pytest.mark.parametrize("joints", [1, 2])
def test_arms_of_few_joints_have_a_row_of_torques_for_each(
    joints: int, tmp_path: Path
) -> None:
    robot = load_robot(chain(tmp_path, joints, jerk=False))
    states, data = (
        np.random.default_rng(0).normal(size=(3, joints, 7)),
        robot.model.createData(),
    )
    world = PathWorld(robot, (), None)
    world.set_path(*states, np.zeros(0))
    expected = [
        pin.rnea(robot.model, data, *(values[:, k].copy() for values in states))
        for k in range(7)
    ]
    np.testing.assert_allclose(world.torque, np.transpose(expected), atol=1e-12)
