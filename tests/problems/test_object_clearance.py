"""Clearance of the held object from the links: both forms against trimeshes of Coal, defaults, and errors."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import coal
import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import RecipeError
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.problems.constraints.link_clearance import ObjectClearance
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.shape.convex_part import link_convex_parts
from cnpgen.robots.shape.hull import coal_hull
from cnpgen.robots.solid import place_obstacles
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.examples.shipped import PROBLEMS, ROBOTS
from tests.refusals import is_refused

CLEARANCE = ObjectClearance(distance=0.01, tolerance=0.0)
CHECKED_LINKS = [f"link_{number}" for number in range(7)]


def random_states(count: int) -> np.ndarray:
    return np.random.default_rng(5).uniform(
        ROBOTS["heavy-object"].position_lower,
        ROBOTS["heavy-object"].position_upper,
        (count, ROBOTS["heavy-object"].n),
    )


def distance_of_coal(q: np.ndarray) -> float:
    """The smallest distance of the object from the links' parts, by frames of Pinocchio and shapes of Coal."""
    model, data = (
        ROBOTS["heavy-object"].model,
        ROBOTS["heavy-object"].model.createData(),
    )
    pin.framesForwardKinematics(model, data, q)
    tip, box = (
        data.oMf[model.getFrameId("object")],
        coal.Box(*PROBLEMS["heavy-object"].object_size),
    )
    distances = []
    for part in link_convex_parts(ROBOTS["heavy-object"].urdf_text):
        if part.link in CHECKED_LINKS:
            pose = data.oMf[model.getFrameId(part.link)]
            request, result = coal.DistanceRequest(), coal.DistanceResult()
            transforms = [
                coal.Transform3s(each.rotation, each.translation)
                for each in (pose, tip)
            ]
            coal.distance(
                coal_hull(part.vertices),
                transforms[0],
                box,
                transforms[1],
                request,
                result,
            )
            distances.append(result.min_distance - part.radius)
    return min(distances)


def test_measured_distances_are_those_of_coal() -> None:
    world, zero, overlapping = (
        World(
            ROBOTS["heavy-object"],
            PROBLEMS["heavy-object"].obstacle,
            PROBLEMS["heavy-object"].object_size,
        ),
        np.zeros(ROBOTS["heavy-object"].n),
        0,
    )
    states, path = (
        random_states(300),
        PathWorld(
            ROBOTS["heavy-object"],
            PROBLEMS["heavy-object"].obstacle,
            PROBLEMS["heavy-object"].object_size,
        ),
    )
    poses = place_obstacles(PROBLEMS["heavy-object"].obstacle)
    smallest = []
    for q in states:
        world.set_state(q, zero, zero, poses)
        (condition,) = CLEARANCE.measured(world)
        smallest.append(min(condition.g))
        expected = distance_of_coal(q)
        overlapping += expected < 0
        if expected > 1e-6:
            assert smallest[-1] == pytest.approx(expected, abs=1e-6)
        else:
            assert smallest[-1] <= 1e-6
    assert overlapping > 10
    path.set_path(states.T.copy(), 0 * states.T, 0 * states.T, poses)
    met = CLEARANCE.met(path, 0.0)
    np.testing.assert_array_equal(met, np.array(smallest) >= CLEARANCE.distance)
    assert 10 < met.sum() < len(met)


def test_capsules_of_solvers_are_conservative_and_close() -> None:
    columns = [symbols(name, ROBOTS["heavy-object"].n) for name in ("q", "dq", "ddq")]
    (q, dq, ddq), obstacle_poses = (
        [scalars for _, scalars in columns],
        [0.0] * len(PROBLEMS["heavy-object"].obstacle),
    )
    state = SymbolicState(
        ROBOTS["heavy-object"],
        q,
        dq,
        ddq,
        obstacle_poses,
        PROBLEMS["heavy-object"].obstacle,
        PROBLEMS["heavy-object"].object_size,
    )
    (condition,) = CLEARANCE.symbolic(state)
    assert condition.sufficient
    margins = ca.Function(
        "margins", [columns[0][0]], [ca.vertcat(*condition.g) - condition.lower]
    )
    states = random_states(300)
    bound = np.array([float(ca.mmin(margins(each))) for each in states])
    exact = np.array([distance_of_coal(each) for each in states]) - CLEARANCE.distance
    assert np.all(bound[exact < 0] < 0)
    free = exact > 0.01
    assert free.sum() > 100
    assert (
        np.mean(bound[free] > 0) > 0.97
    )  # close: most free states are free for solvers, too


def test_gradients_of_capsules_agree_with_differences() -> None:
    columns = [symbols(name, ROBOTS["heavy-object"].n) for name in ("q", "dq", "ddq")]
    (q, dq, ddq), obstacle_poses = (
        [scalars for _, scalars in columns],
        [0.0] * len(PROBLEMS["heavy-object"].obstacle),
    )
    state = SymbolicState(
        ROBOTS["heavy-object"],
        q,
        dq,
        ddq,
        obstacle_poses,
        PROBLEMS["heavy-object"].obstacle,
        PROBLEMS["heavy-object"].object_size,
    )
    g = ca.vertcat(*CLEARANCE.symbolic(state)[0].g)
    value = ca.Function("g", [columns[0][0]], [g])
    jacobian = ca.Function(
        "j", [columns[0][0]], [ca.densify(ca.jacobian(g, columns[0][0]))]
    )
    close = []
    for at in random_states(40):
        steps = 1e-6 * np.eye(ROBOTS["heavy-object"].n)
        differences = np.hstack(
            [np.array(value(at + step) - value(at - step)) / 2e-6 for step in steps]
        )
        close.append(
            np.isclose(np.array(jacobian(at)), differences, rtol=1e-4, atol=1e-5).all()
        )
    assert (
        np.mean(close) >= 0.95
    )  # a step across an edge of the object changes the closest feature


def problem_text(tmp_path: Path, old: str, new: str) -> Path:
    text = PROBLEMS["heavy-object"].path.read_text()
    assert old in text
    (tmp_path / "iiwa14_object.urdf").write_text(
        PROBLEMS["heavy-object"].urdf_path.read_text()
    )
    (tmp_path / "problem.toml").write_text(text.replace(old, new))
    return tmp_path / "problem.toml"


CONSTRAINT = '[[constraint]]\nuse = "object-clearance"'


def test_a_held_object_stays_clear_of_links_by_default(tmp_path: Path) -> None:
    text = PROBLEMS["heavy-object"].path.read_text()
    path = problem_text(tmp_path, text[text.index(CONSTRAINT) :], "")
    assert isinstance(load_problem(path).constraint[-1], ObjectClearance)
    stripped = (tmp_path / "iiwa14_object.urdf").read_text()
    while "<collision>" in stripped:
        head, tail = stripped.split("<collision>", 1)
        stripped = head + tail.split("</collision>", 1)[1]
    (tmp_path / "iiwa14_object.urdf").write_text(stripped)
    assert load_problem(path).first(ObjectClearance) is None  # no geometry to check


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'touch_links = ["link_7"]',
            'touch_links = ["link_77"]',
            "no link 'link_77' has collision geometry.*link_7",
        ),
        (
            '[object]\nsize = "[0.2, 0.2, 0.3] m"',
            '[object]\nsize = "[0.2, 0.6, 0.3] m"',
            "overlaps link_5, link_6 in",
        ),
    ],
)
def test_mistakes_name_the_links(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    problem: Problem = load_problem(problem_text(tmp_path, old, new))
    with pytest.raises(RecipeError, match=message):
        load_robot(problem)


def test_the_constraint_needs_an_object(tmp_path: Path) -> None:
    text = PROBLEMS["heavy-object"].path.read_text()
    start, end = text.index("[object]"), text.index("[[obstacle]]")
    path = problem_text(tmp_path, text[start:end], "")
    with is_refused(RecipeError):
        load_problem(path)


def test_penetration_is_never_within_the_tolerance() -> None:
    assert replace(CLEARANCE, distance=0.0, tolerance=0.05).effective_tolerance == 1e-4
