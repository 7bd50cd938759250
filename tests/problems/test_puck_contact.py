"""The constraint between mallet and puck: its forms, the geometry of legal contacts, and tip paths around the puck."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest

from cnpgen.errors import RecipeError, UsageError
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.problems.constraints.puck_contact import (
    ADDED_RADIUS_M,
    PUCK_OUT_OF_REACH_M,
    TRAINING_KNEE_M,
    TRAINING_MARGIN_M,
    PuckContact,
)
from cnpgen.problems.obstacles import goal_velocities, scene_of
from cnpgen.problems.problem_file import load_problem
from cnpgen.world.measured_parameters import MeasuredParameters
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.examples.shipped import PROBLEMS, ROBOTS
from tests.refusals import is_refused


@cache
def contact() -> PuckContact:
    found = PROBLEMS["airhockey"].first(PuckContact)
    assert found is not None
    return found


HIT = np.array([np.cos(0.3), np.sin(0.3)])  # direction of the hit
GOAL = np.array([1.0, 0.1])
SCENE = np.array([*GOAL, *(GOAL + 0.07 * HIT)])


def violation(points: np.ndarray) -> np.ndarray:
    """Return the violation [m] of tip positions, shape (K, 2), by the measured form of a stand-in for the world."""

    class Tip:
        tip_position = np.column_stack([points, np.full(len(points), 0.16)]).T
        scene_values = SCENE
        parameters = MeasuredParameters(ROBOTS["airhockey"])

    (condition,) = contact().measured(Tip())
    return condition.lower[0] - condition.g[0]


@pytest.mark.parametrize("form", ["motion", "start"])
def test_symbolic_and_measured_forms_agree(form):
    names = [symbols(name, 6) for name in ("q", "dq", "ddq")] + [
        symbols("obstacle_poses", 4)
    ]
    columns, (q, dq, ddq, values) = (
        [column for column, _ in names],
        [scalars for _, scalars in names],
    )
    state = SymbolicState(ROBOTS["airhockey"], q, dq, ddq, values, (), None)
    (symbolic,) = (
        contact().symbolic(state)
        if form == "motion"
        else contact().symbolic_at(state, "start")
    )
    function, world = ca.Function("g", columns, symbolic.g), World(ROBOTS["airhockey"])
    random, rest = np.random.default_rng(5), np.zeros(6)
    for _ in range(50):
        q_now = ROBOTS["airhockey"].home + random.normal(scale=0.1, size=6)
        world.set_state(q_now, rest, rest, np.empty(0))
        goal = world.tip_position[:2] + random.normal(scale=0.02, size=2)
        values_now = np.concatenate([goal, goal + 0.07 * HIT])
        world.set_state(q_now, rest, rest, values_now)
        (measured,) = (
            contact().solved(world)
            if form == "motion"
            else contact().measured_at(world, "start")
        )
        np.testing.assert_allclose(
            float(function(q_now, rest, rest, values_now)), measured.g[0], atol=1e-9
        )
        np.testing.assert_array_equal(symbolic.lower, measured.lower)
    assert (
        contact().symbolic_at(state, "goal")
        == contact().measured_at(world, "goal")
        == ()
    )


def test_the_training_form_grows_linearly_with_a_large_violation():
    names = [symbols(name, 6) for name in ("q", "dq", "ddq")] + [
        symbols("obstacle_poses", 4)
    ]
    state = SymbolicState(
        ROBOTS["airhockey"], *(scalars for _, scalars in names), (), None
    )
    (penalized,) = contact().penalized(state)
    function, rest = (
        ca.Function("g", [names[0][0], names[3][0]], penalized.g),
        np.zeros(6),
    )
    world = World(ROBOTS["airhockey"])
    world.set_state(ROBOTS["airhockey"].home, rest, rest, np.empty(0))
    tip = world.tip_position[:2]
    violations = []
    for distance in (0.03, 0.06, 0.2):
        puck = np.add(tip, [0.0, distance])
        found = float(
            function(
                ROBOTS["airhockey"].home, np.concatenate([puck - 0.07 * HIT, puck])
            )
        )
        violations.append(max(0.0, penalized.lower[0] - found))
        exact = max(
            0.0, contact().contact_range + ADDED_RADIUS_M + TRAINING_MARGIN_M - distance
        )
        assert violations[-1] == pytest.approx(
            exact / np.sqrt(1 + exact / TRAINING_KNEE_M), abs=3e-4
        )
    assert violations[0] > violations[1] > violations[2] == 0.0
    assert violations[0] ** 2 / violations[1] ** 2 == pytest.approx(
        0.0519 / 0.0219, rel=0.1
    )


def test_a_straight_hit_is_legal_from_any_distance():
    lengths = np.concatenate([np.linspace(0, 0.02, 2001), np.linspace(0.02, 0.5, 100)])
    assert violation(GOAL - lengths[:, None] * HIT).max() <= 1e-12


def test_legal_contacts_are_near_the_goal_and_behind_the_puck():
    offsets = np.stack(
        np.meshgrid(*[np.linspace(-0.02, 0.02, 801)] * 2), axis=-1
    ).reshape(-1, 2)
    points, puck = GOAL + offsets, SCENE[2:]
    legal_contact = (violation(points) <= 0) & (
        np.linalg.norm(points - puck, axis=1) < contact().contact_range
    )
    assert legal_contact.sum() > 100
    from_goal = np.linalg.norm(offsets[legal_contact], axis=1)
    deep = (violation(points) <= contact().tolerance) & (
        np.linalg.norm(points - puck, axis=1) < contact().contact_range - 5e-5
    )
    assert np.linalg.norm(offsets[deep], axis=1).max() <= contact().last
    assert from_goal.max() <= contact().last + 1e-3
    towards = (puck - points[legal_contact]) / np.linalg.norm(
        puck - points[legal_contact], axis=1
    )[:, None]
    assert np.arccos(np.clip(towards @ HIT, -1, 1)).max() < np.deg2rad(4)


def test_an_oblique_approach_and_a_motion_through_the_puck_are_violations():
    for angle, depth in ((0.3, 2e-4), (1.5, 5e-3), (np.pi, 0.05)):
        turn = np.array(
            [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        )
        points = GOAL - np.linspace(0, 0.2, 2001)[:, None] * (turn @ HIT)
        assert violation(points).max() > depth


def test_the_puck_follows_from_the_goal_and_is_out_of_reach_without_a_hit():
    goal, velocity = (
        np.array([[1.0, 0.1, 0.16]] * 2),
        np.array([[0.6, -0.8, 0.0], [0.0, 0.0, 0.0]]),
    )
    scene = scene_of(PROBLEMS["airhockey"], goal, goal, velocity)
    np.testing.assert_allclose(
        scene.poses[0], [1.0, 0.1, 1.0 + 0.07 * 0.6, 0.1 - 0.07 * 0.8]
    )
    np.testing.assert_array_equal(scene.poses[1], PUCK_OUT_OF_REACH_M)
    with is_refused(UsageError, argument="goal_velocity"):
        scene_of(PROBLEMS["airhockey"], goal, goal)


def test_goal_velocities_equal_finite_differences():
    random = np.random.default_rng(2)
    q, dq = (
        ROBOTS["airhockey"].home + random.normal(scale=0.2, size=(5, 6)),
        random.normal(size=(5, 6)),
    )
    world, step = PathWorld(ROBOTS["airhockey"]), 1e-6
    tips = []
    for moved in (q + step * dq, q - step * dq):
        world.set_path(moved.T, moved.T, moved.T, np.empty(0))
        tips.append(world.tip_position.T.copy())
    np.testing.assert_allclose(
        goal_velocities(PROBLEMS["airhockey"], ROBOTS["airhockey"], q, dq),
        (tips[0] - tips[1]) / (2 * step),
        atol=1e-7,
    )


def test_tip_paths_go_around_the_puck_and_end_along_the_hit():
    puck = SCENE[2:]
    for angle in np.linspace(-np.pi, np.pi, 40):
        start = puck + 0.25 * np.array([np.cos(angle), np.sin(angle)])
        paths = contact().initial_tip_paths(SCENE, np.array([*start, 0.16]))
        behind = np.cos(angle - 0.3) < -0.5  # more than 120 degrees from the hit
        assert len(paths) == 0 if behind else len(paths) in {0, 2}
        for path in paths:
            dense = np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(path)])[
                :, :2
            ]
            outside = np.linalg.norm(dense - GOAL, axis=1) > 0.011
            assert (
                np.linalg.norm(dense[outside] - puck, axis=1).min()
                > contact().contact_range - 1e-4
            )
            np.testing.assert_allclose(path[0], [*start, 0.16])
            np.testing.assert_allclose(path[-1, :2], GOAL)
            last = path[-1, :2] - path[-2, :2]
            np.testing.assert_allclose(last / np.linalg.norm(last), HIT, atol=1e-9)
    both = contact().initial_tip_paths(
        SCENE, np.array([*(puck + 0.2 * HIT + 0.01), 0.16])
    )
    lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in both]
    assert len(lengths) == 2
    assert lengths[0] <= lengths[1]


@pytest.mark.parametrize(("old", "new", "expected"), [
    ('contact_distance = "7 cm"', 'contact_distance = "8 cm"', "expected less than the sum of the radii, 0.0798 m"),
    ('contact_distance = "7 cm"', 'contact_distance = "6 cm"', "by less than 'last', 0.01 m"),
])  # fmt: skip
def test_inconsistent_distances_are_refused(tmp_path, old, new, expected):
    text = PROBLEMS["airhockey"].path.read_text(encoding="utf-8").replace(old, new)
    (tmp_path / "problem.toml").write_text(text, encoding="utf-8")
    (tmp_path / "iiwa14_striker.urdf").write_bytes(
        PROBLEMS["airhockey"].urdf_path.read_bytes()
    )
    with pytest.raises(RecipeError, match=expected):
        load_problem(tmp_path / "problem.toml")


def test_a_problem_has_at_most_one_constraint_with_values_of_each_motion(tmp_path):
    twice = replace(
        PROBLEMS["airhockey"], constraint=(*PROBLEMS["airhockey"].constraint, contact())
    )
    assert [key for key, _ in twice.validate()] == ["constraint"]
