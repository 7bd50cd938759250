"""Derivatives of every term of the manifold: against differences of what Pinocchio and Coal measure, and of itself."""

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from cnpgen.problems.problem_file import load_problem
from cnpgen.refine.solver.residuals import stage_jacobian, stage_values
from tests.examples.shipped import PROBLEMS
from tests.problems.test_constraints import (
    KINDS,
    Bench,
    gantry_problem,
    measured_forms,
    values,
)

STEP = 1e-6
PAIRS = [
    ("airhockey", name)
    for name in (
        "joint-position",
        "joint-velocity",
        "joint-acceleration",
        "joint-torque",
        "table",
        "vertical",
    )
]
PAIRS += [
    ("heavy-object", name) for name in KINDS if name not in ("table", "object-contact")
]
"""Problem and kind, where the symbolic form is what is measured; contacts of objects have tests of their own."""


@cache
def bench(problem: str) -> Bench:
    return Bench(load_problem(problem))


@cache
def derivative(problem: str, name: str) -> tuple[ca.Function, ca.Function]:
    """The residuals of a kind on a motion, and their Jacobian in q, dq, ddq and the heights of the obstacles."""
    function, _ = bench(problem).symbolic(KINDS[name])
    inputs = function.sx_in()
    residuals = function(*inputs)[0]
    return (
        ca.Function("g", inputs, [residuals]),
        ca.Function(
            "jacobian",
            inputs,
            [ca.densify(ca.jacobian(residuals, ca.vertcat(*inputs)))],
        ),
    )


def differences(
    function: Any, state: list[np.ndarray], step: float = STEP
) -> np.ndarray:
    """Central differences of a function of a list of vectors, column by column."""
    sizes = np.cumsum([len(part) for part in state])[:-1]
    packed = np.concatenate(state)
    columns = []
    for index in range(len(packed)):
        up, down = packed.copy(), packed.copy()
        up[index] += step
        down[index] -= step
        columns.append(
            (function(*np.split(up, sizes)) - function(*np.split(down, sizes)))
            / (2 * step)
        )
    return np.array(columns).T


@pytest.mark.parametrize(("problem", "name"), PAIRS)
def test_derivatives_are_those_of_what_pinocchio_and_coal_measure(
    problem: str, name: str
) -> None:
    here, random = bench(problem), np.random.default_rng(7)
    _, jacobian = derivative(problem, name)

    def measured(*state: np.ndarray) -> np.ndarray:
        here.world.set_state(*(part.copy() for part in state))
        return values(measured_forms(KINDS[name], here.world)[0])

    nonzero = 0
    for _ in range(8):
        state = here.random_state(random)
        found, expected = np.array(jacobian(*state)), differences(measured, state)
        np.testing.assert_allclose(
            found, expected, rtol=1e-5, atol=2e-4 if name == "robot-clearance" else 1e-6
        )
        nonzero += np.count_nonzero(np.abs(expected) > 1e-3)
    assert nonzero > 30


@pytest.mark.parametrize(
    ("problem", "name"), [*PAIRS, ("heavy-object", "object-contact")]
)
def test_derivatives_are_those_of_the_residuals(problem: str, name: str) -> None:
    here, random = bench(problem), np.random.default_rng(8)
    residuals, jacobian = derivative(problem, name)
    for _ in range(20):
        state = here.random_state(random)
        expected = differences(
            lambda *parts: np.array(residuals(*parts)).ravel(), state
        )
        np.testing.assert_allclose(
            np.array(jacobian(*state)), expected, rtol=1e-6, atol=1e-6
        )


def test_a_robot_inside_an_obstacle_has_a_depth_and_a_gradient() -> None:
    residuals, jacobian = derivative("heavy-object", "robot-clearance")
    q = np.array(
        [0.95, 1.2, 0, -0.4, 0, 0, 0]
    )  # stretched out to the side, through pedestal 2
    state = [q, 0 * q, 0 * q, np.full(2, 0.6)]
    g, found = np.array(residuals(*state)).ravel(), np.array(jacobian(*state))
    deepest, step = int(np.argmin(g)), 1e-7
    assert g[deepest] < -0.05
    assert np.isfinite(found).all()
    for joint in range(7):
        near = [
            np.array(residuals(q + sign * step * np.eye(7)[joint], *state[1:])).ravel()
            for sign in (1, -1)
        ]
        gradient = (near[0] - near[1])[deepest] / (2 * step)
        assert found[deepest, joint] == pytest.approx(gradient, abs=1e-6)
    assert np.abs(found[deepest]).max() > 0.1


@pytest.mark.parametrize("problem", ["airhockey", "heavy-object"])
def test_torque_derivatives_are_pinocchios(problem: str) -> None:
    here, random = bench(problem), np.random.default_rng(9)
    _, jacobian = derivative(problem, "joint-torque")
    model, data, n = here.robot.model, here.robot.model.createData(), here.robot.n
    for _ in range(20):
        state = here.random_state(random)
        by_q, by_dq, by_ddq = pin.computeRNEADerivatives(model, data, *state[:3])
        inertia = np.triu(by_ddq) + np.triu(by_ddq, 1).T
        found = np.array(jacobian(*state))
        for part, expected in zip(
            np.split(found[:, : 3 * n], 3, axis=1), (by_q, by_dq, inertia), strict=True
        ):
            np.testing.assert_allclose(part, expected, rtol=1e-10, atol=1e-10)
        assert not found[:, 3 * n :].any()


def test_an_upright_objects_contact_moves_as_coal_measures_it(tmp_path: Any) -> None:
    """Against Coal where the object is in a pedestal; how it leans is not a question to an upright one."""
    here, random = Bench(gantry_problem(tmp_path)), np.random.default_rng(10)
    function, _ = here.symbolic(KINDS["object-contact"])
    inputs = function.sx_in()
    jacobian = ca.Function(
        "j",
        inputs,
        [ca.densify(ca.jacobian(function(*inputs)[0], ca.vertcat(*inputs)))],
    )
    checked = 0
    while checked < 25:
        q, dq, ddq, obstacle_poses = here.random_state(random)
        q[:2], q[4] = (random.uniform(0.1, 0.7), random.uniform(-0.7, 0.7)), 0.0

        def measured(
            q_: np.ndarray, obstacle_poses_: np.ndarray, rates: Any = (dq, ddq)
        ) -> np.ndarray:
            here.world.set_state(q_.copy(), *rates, obstacle_poses_.copy())
            return values(measured_forms(KINDS["object-contact"], here.world)[0])

        inside = measured(q, obstacle_poses) < -1e-3
        if inside.any():
            found = np.array(jacobian(q, dq, ddq, obstacle_poses))[
                :, [0, 1, 2, 3, -2, -1]
            ]
            expected = differences(measured, [q, obstacle_poses])[
                :, [0, 1, 2, 3, -2, -1]
            ]
            np.testing.assert_allclose(found[inside], expected[inside], atol=2e-3)
            checked += 1


@pytest.mark.parametrize("turn", [0.0, 0.3, 0.785, 1.2])
def test_an_edge_that_enters_between_two_corners_is_seen_exactly(
    tmp_path: Any, turn: float
) -> None:
    """The corner of a pedestal in the side of the object: no corner of the object is in the pedestal."""
    here = Bench(gantry_problem(tmp_path))
    function, _ = here.symbolic(KINDS["object-contact"])
    half = (
        np.array(PROBLEMS["heavy-object"].object.size[:2]) / 2
        if PROBLEMS["heavy-object"].object
        else np.zeros(2)
    )
    corner, depth = np.array([0.2, -0.3]), 0.012  # of pedestal 1
    face = np.array(
        [np.cos(turn), -np.sin(turn)]
    )  # outward normal of the side that the pedestal's corner is in
    q = np.zeros(5)
    q[:2], q[3] = corner - face * (half[0] - depth), -turn
    obstacle_poses = np.array([0.6, -5.0])
    here.world.set_state(q, np.zeros(5), np.zeros(5), obstacle_poses)
    expected = here.world.object_distances()[0]
    (found, _) = np.array(
        function(q, np.zeros(5), np.zeros(5), obstacle_poses)[0]
    ).ravel()
    assert found == pytest.approx(expected, abs=1e-9)
    if 0 < turn < np.pi / 2:
        assert found == pytest.approx(-depth, abs=1e-9)


@pytest.mark.parametrize("problem", ["airhockey", "heavy-object"])
def test_every_term_says_its_name_unit_bounds_and_what_is_called_valid(
    problem: str,
) -> None:
    here = bench(problem)
    names = []
    for constraint in here.problem.constraint:
        for condition in constraint.measured(here.world):
            names.append(condition.name)
            assert condition.unit in {"rad", "rad/s", "rad/s^2", "N m", "m", "1"}
            assert np.all(condition.lower <= condition.upper)
            allowed = constraint.allowed(condition)
            assert allowed.shape == condition.lower.shape
            assert np.all(np.isfinite(allowed) & (allowed > 0))
    assert len(set(names)) == len(names) >= 6


@pytest.mark.slow
@pytest.mark.parametrize("problem", ["airhockey", "heavy-object"])
def test_the_stages_of_a_motion_have_the_derivatives_of_their_values(
    problem: str,
) -> None:
    here, random = bench(problem), np.random.default_rng(11)
    value, both = (
        stage_values(here.robot, here.problem),
        stage_jacobian(here.robot, here.problem),
    )
    n = here.robot.n
    for _ in range(8):
        q, *_, obstacle_poses = here.random_state(random)
        w = np.concatenate(
            [
                q,
                random.normal(size=2 * n),
                random.uniform(0.5, 2, 1),
                random.normal(size=1),
            ]
        )
        g, jacobian = (np.array(part) for part in both(w, obstacle_poses))
        np.testing.assert_allclose(
            g, np.array(value(w, obstacle_poses)), rtol=1e-13, atol=1e-13
        )
        expected = differences(
            lambda at, heights=obstacle_poses: np.array(value(at, heights)).ravel(), [w]
        )
        np.testing.assert_allclose(
            jacobian.reshape(len(w), -1).T, expected, rtol=1e-6, atol=1e-5
        )
