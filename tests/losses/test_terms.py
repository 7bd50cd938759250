"""Parts of the step losses: signed distances, the paper's published forms, Huber's function of conditions."""

from functools import cache
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from cnpgen.addons.paper.published_conditions import published_conditions
from cnpgen.kernels.interpreted_kernel import InterpretedGridKernel
from cnpgen.kernels.symbolic.convex_distances import signed_segment_box_distance
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import FrozenState, SymbolicState
from cnpgen.kernels.tape import GridSpec, tape_from_function
from cnpgen.losses.integrand import constraint_term
from cnpgen.problems.constraints.constraint import Condition
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.solid import place_obstacles
from tests.examples.losses import huber
from tests.examples.plans import PROBLEMS, ROBOTS
from tests.kernels.symbolic.test_symbolic_state import (
    HIGH,
    LOW,
    box_bounds,
    coal_segment_separation,
    segments,
)

Array = np.ndarray


# --- signed distances -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def signed() -> dict[str, ca.Function]:
    """Return the distance of both ends, its gradient with a constant closest point, and its full gradient."""
    (first_sx, first), (second_sx, second) = symbols("first", 3), symbols("second", 3)
    ends, constant = ca.vertcat(first_sx, second_sx), ca.SX.sym("constant")
    values: list[Any] = []
    frozen = signed_segment_box_distance(
        first, second, box_bounds(), freeze=lambda t: values.append(t) or constant
    )
    plain = signed_segment_box_distance(first, second, box_bounds(), freeze=lambda t: t)
    gradient = ca.substitute(ca.gradient(frozen, ends), constant, values[0])
    return {
        "distance": ca.Function("distance", [ends], [plain]),
        "gradient": ca.Function("gradient", [ends], [gradient]),
    }


def ends_of(kind: str) -> Array:
    return np.array([np.concatenate(pair) for pair in segments(kind)])


@pytest.mark.parametrize(
    "kind", ["random", "parallel to an edge", "touching the top", "of no length"]
)
def test_outside_the_signed_distance_agrees_with_coal(signed, kind):
    for ends in ends_of(kind):
        expected = coal_segment_separation(ends[:3], ends[3:])
        found = float(signed["distance"](ends))
        assert (
            found == pytest.approx(expected, abs=2e-6)
            if expected > 1e-6
            else found <= 2e-6
        )


def depth_of(points: Array) -> Array:
    """Return the depth of points inside the box, negative outside."""
    return np.minimum(points - LOW, HIGH - points).min(axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["inside", "random"])
def test_inside_the_signed_distance_is_minus_the_depth_of_the_overlap_midpoint(
    signed, kind
):
    seen = 0
    for ends in ends_of(kind):
        along = np.linspace(0, 1, 20_001)[:, None]
        points = ends[:3] + along * (ends[3:] - ends[:3])
        within = np.flatnonzero(depth_of(points) > 0)
        if len(within) < 2:
            continue
        center = points[(within[0] + within[-1]) // 2]
        length = np.linalg.norm(ends[3:] - ends[:3])
        assert float(signed["distance"](ends)) == pytest.approx(
            -depth_of(center), abs=2e-4 * max(length, 0.1)
        )
        seen += 1
    assert seen > 20


def test_the_signed_distance_is_continuous_where_a_segment_enters_a_box(signed):
    random = np.random.default_rng(0)
    for _ in range(60):
        outside = random.uniform(LOW - 0.5, LOW - 0.1, (2, 3))
        inside = random.uniform(LOW, HIGH, (2, 3))
        steps = np.linspace(0, 1, 4001)[:, None]
        path = outside.ravel() + steps * (inside - outside).ravel()
        values = np.array(signed["distance"].map(len(path))(path.T)).ravel()
        speed = np.linalg.norm(inside - outside, axis=1).max()
        assert np.abs(np.diff(values)).max() < 30 * speed / 4000
        assert values[0] > 0 > values[-1]


@pytest.mark.parametrize("kind", ["random", "inside"])
def test_the_gradient_with_a_frozen_closest_point_agrees_with_finite_differences(
    signed, kind
):
    for ends in ends_of(kind):
        found = np.array(signed["gradient"](ends)).ravel()
        shifted = (
            ends[:, None] + 1e-6 * np.concatenate([np.eye(6), -np.eye(6)], axis=1)
        ).T
        values = np.array(signed["distance"].map(12)(shifted.T)).ravel()
        expected = (values[:6] - values[6:]) / 2e-6
        np.testing.assert_allclose(found, expected, atol=2e-4)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_axis_parallel_segment_in_the_center_of_a_box_has_its_depth_and_a_gradient(
    signed, axis, dtype
):
    ends = np.repeat((LOW + HIGH)[None] / 2, 2, axis=0)
    ends[:, axis] += [-0.05, 0.02]
    grid = GridSpec(("point",), ("point",))
    found = {}
    for name in ("distance", "gradient"):
        kernel = InterpretedGridKernel(
            tape_from_function(signed[name], grid=grid, dtype=dtype)
        )
        out = np.zeros((kernel.tape.outputs[0], 1, 1), dtype)
        kernel(ends.reshape(6, 1, 1).astype(dtype), out=[out])
        found[name] = out.ravel()
    assert found["distance"] == pytest.approx([-depth_of(ends.mean(axis=0))], abs=1e-5)
    assert np.isfinite(found["gradient"]).all()
    assert np.abs(found["gradient"]).max() > 0.1


# --- published forms --------------------------------------------------------------------------------------------------


def state_of(problem: str) -> tuple[Any, Any, FrozenState]:
    robot, chosen = ROBOTS[problem], PROBLEMS[problem]
    (q_sx, q), (poses_sx, obstacle_poses) = (
        symbols("q", robot.n),
        symbols("obstacle_poses", len(chosen.obstacle)),
    )
    zero = [0.0] * robot.n
    size = chosen.object.size if chosen.object is not None else None
    return (
        q_sx,
        poses_sx,
        FrozenState(robot, q, zero, zero, obstacle_poses, chosen.obstacle, size),
    )


@cache
def published_function(kind: str) -> ca.Function:
    q_sx, poses_sx, state = state_of("heavy-object")
    (condition,) = published_conditions(constraint_of(kind), state)
    assert condition.lower.tolist() == condition.upper.tolist() == [0.0]
    return ca.Function("value", [q_sx, poses_sx], [condition.g[0]])


def published_value(kind: str, q: Array) -> float:
    return float(published_function(kind)(q, HEIGHTS))


def constraint_of(kind: str) -> Any:
    (constraint,) = [
        each
        for each in PROBLEMS["heavy-object"].constraint
        if type(each).__name__ == kind
    ]
    return constraint


def poses(q: Array) -> tuple[list[Array], Array, Array]:
    """Return joint origins and the position and rotation of the tip, by Pinocchio."""
    robot = ROBOTS["heavy-object"]
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    tip = data.oMf[robot.model.getFrameId(robot.tip)]
    origins = [data.oMi[i].translation.copy() for i in range(1, robot.n + 1)]
    return (
        [*origins, tip.translation.copy()],
        tip.translation.copy(),
        tip.rotation.copy(),
    )


def configurations() -> list[Array]:
    robot, random = ROBOTS["heavy-object"], np.random.default_rng(5)
    return list(
        random.uniform(robot.position_lower, robot.position_upper, (300, robot.n))
    )


def test_obstacles_with_a_pose_have_no_published_form() -> None:
    problem, robot = PROBLEMS["heavy-object"], ROBOTS["heavy-object"]
    ball = Obstacle(name="ball", kind="sphere", position=(0.4, 0.1, 0.5), radius=0.1)
    (q_sx, q), zero = symbols("q", robot.n), [0.0] * robot.n
    obstacle_poses = place_obstacles([ball]).tolist()
    state = SymbolicState(
        robot, q, zero, zero, obstacle_poses, (ball,), problem.object_size
    )
    for kind in ("RobotClearance", "ObjectContact"):
        constraint = constraint_of(kind)
        (one,), (other,) = (
            published_conditions(constraint, state),
            constraint.penalized(state),
        )
        values = ca.Function("both", [q_sx], [ca.vertcat(*one.g), ca.vertcat(*other.g)])
        for value, expected in (values(each) for each in configurations()[:5]):
            np.testing.assert_array_equal(np.array(value), np.array(expected))


HEIGHTS = np.array([0.25, 0.6])


def pedestals() -> list[tuple[Array, Array]]:
    boxes = PROBLEMS["heavy-object"].obstacle
    return [
        (np.array([b.x.low, b.y.low, -np.inf]), np.array([b.x.high, b.y.high, top]))
        for b, top in zip(boxes, HEIGHTS, strict=True)
    ]


def test_the_published_orientation_loss_is_one_minus_r22():
    for q in configurations():
        assert published_value("Vertical", q) == pytest.approx(
            1 - poses(q)[2][2, 2], abs=1e-12
        )


def points_on_the_arm(q: Array) -> Array:
    """Return the ends of the capsule axes, each once, and points between them with a spacing of at most 10 cm."""
    origins = poses(q)[0]
    pairs = [(origins[a], origins[b]) for a, b in ROBOTS["heavy-object"].capsule_axes]
    lines = [
        np.linspace(a, b, int(np.ceil(np.linalg.norm(b - a) / 0.1 - 1e-9)) + 1)
        for a, b in pairs
    ]
    return np.concatenate([lines[0], *(line[1:] for line in lines[1:])])  # one chain


def test_the_published_robot_loss_is_a_sum_over_points_with_a_spacing_of_10_cm():
    radius, counted = constraint_of("RobotClearance").radius, 0
    for q in configurations():
        points = points_on_the_arm(q)
        assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() <= 0.1 + 1e-9
        violation = [
            np.maximum(np.maximum(low - points, points - high), 0)
            for low, high in pedestals()
        ]
        expected = np.maximum(
            radius - np.linalg.norm(violation, axis=2).min(axis=0), 0
        ).sum()
        counted += expected > 0
        assert published_value("RobotClearance", q) == pytest.approx(expected, abs=3e-5)
    assert counted > 10


def test_the_published_object_loss_sums_the_depths_of_its_corners():
    depth, half = (
        constraint_of("ObjectContact").depth,
        np.array(PROBLEMS["heavy-object"].object.size) / 2,
    )
    signs, counted = np.array(list(product((-1, 1), repeat=3))), 0
    for q in configurations():
        _, center, rotation = poses(q)
        corners = center + (half * signs) @ rotation.T
        inside = [
            np.minimum(corners - low, high - corners).min(axis=1) - depth
            for low, high in pedestals()
        ]
        expected = np.maximum(inside, 0).sum()
        counted += expected > 0
        assert published_value("ObjectContact", q) == pytest.approx(expected, abs=1e-9)
    assert counted > 10


def test_constraints_without_a_published_form_are_penalized_as_by_default():
    _, _, state = state_of("airhockey")
    for constraint in PROBLEMS["airhockey"].constraint:
        names = [
            condition.name for condition in published_conditions(constraint, state)
        ]
        assert names == [condition.name for condition in constraint.penalized(state)]


# --- Huber ------------------------------------------------------------------------------------------------------------

BOUNDS = {
    "equality": (0.3, 0.3),
    "above": (-np.inf, 0.3),
    "below": (-0.4, np.inf),
    "both": (-0.4, 0.3),
    "none": (-np.inf, np.inf),
}


@pytest.mark.parametrize("kind", BOUNDS)
@pytest.mark.parametrize("tolerance_kind", ["limit", "position"])
@pytest.mark.parametrize("relaxation", [None, 0.15])
def test_the_loss_of_a_condition_is_the_paper_s_huber_of_relu_with_its_derivative(
    kind, tolerance_kind, relaxation
):
    low, high = BOUNDS[kind]
    x, factor, inset = ca.SX.sym("x"), ca.SX.sym("factor"), ca.SX.sym("inset")
    condition = Condition(
        "x", "1", [x], np.array([low]), np.array([high]), tolerance_kind
    )
    term = constraint_term([condition], factor, inset, [relaxation])
    ((g, derivative),) = term.parts
    assert g is x
    function = ca.Function(
        "term", [x, factor, inset], [term.value, derivative, ca.gradient(term.value, x)]
    )
    values = np.linspace(-3, 3, 601) + 1e-3
    found = [
        np.array(result).ravel()
        for result in function.map(601)(values, np.full(601, 0.9), np.full(601, 0.05))
    ]
    if kind != "equality":
        low, high = tightened(low, high, tolerance_kind)
    extra = 0.0 if relaxation is None else relaxation
    violation = np.maximum(low - extra - values, 0) + np.maximum(
        values - high - extra, 0
    )
    np.testing.assert_allclose(found[0], huber(violation), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(found[1], found[2], rtol=1e-12, atol=1e-14)


def tightened(low: float, high: float, tolerance_kind: str) -> tuple[float, float]:
    """Shrink limits by 10 % toward their center, single ones toward zero; move other bounds inwards by 0.05."""
    if tolerance_kind == "position":
        return low + 0.05, high - 0.05
    if np.isfinite(low) and np.isfinite(high):
        center, half = (low + high) / 2, (high - low) / 2
        return center - 0.9 * half, center + 0.9 * half
    return low * 0.9, high * 0.9


def test_frozen_values_are_symbols_and_plain_states_freeze_nothing():
    _, _, state = state_of("airhockey")
    x = ca.SX.sym("x")
    symbol = state.freeze(2 * x)
    assert symbol.is_symbolic()
    assert state.frozen[0][0] is symbol
    plain = SymbolicState(
        state.robot,
        state.q,
        state.dq,
        state.ddq,
        state.obstacle_poses,
        state.obstacles,
        None,
    )
    assert plain.freeze(x) is x
