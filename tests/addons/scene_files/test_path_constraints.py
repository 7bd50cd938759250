"""Path constraints of requests hold along the whole motion, checked here by kinematics of the tests' own."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import cnpgen
from cnpgen.addons.scene_files.link_constraints import (
    EULER,
    ROTATION_VECTOR,
    LinkOrientation,
    LinkPosition,
)
from cnpgen.errors import UsageError
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.pipelines.resting_states import RestingStates
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_record import as_problem, open_problem, record_problem
from cnpgen.problems.scenes.placement import placed_scene
from cnpgen.problems.scenes.quaternions import roll_pitch_yaw
from cnpgen.problems.scenes.requested_problem import requested_problem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.scenes import SceneError, solve_scenes
from cnpgen.world.path import PathWorld
from cnpgen.world.pose_ik import PoseKinematics, solve_pose_ik
from cnpgen.world.world import World
from tests.addons.scene_files.test_requests import (
    GOAL,
    JOINTS,
    START,
    UPRIGHT,
    box,
    request,
    scene_of,
)
from tests.examples.example_robots import needs_robots

pytestmark = needs_robots

Array = NDArray[np.float64]
HAND = "panda_hand"
ROUNDING = 2e-6  # rad or m, the tolerance of the verdict and that of the ends


def link_poses(urdf: str, link: str, q: Array) -> tuple[Rotation, Array]:
    """Return the poses of a link at states (K, 7) by the transforms of the URDF's joints."""
    parents = {
        joint.find("child").get("link"): joint  # type: ignore[union-attr]
        for joint in ElementTree.fromstring(urdf).findall("joint")
    }
    chain = []
    while link in parents:
        chain.append(parents[link])
        link = chain[-1].find("parent").get("link", "")  # type: ignore[union-attr]
    turn, position = Rotation.identity(len(q)), np.zeros((len(q), 3))
    for joint in reversed(chain):
        origin = joint.find("origin")
        at: dict[str, str] = {} if origin is None else dict(origin.attrib)
        xyz, rpy = (
            np.array(at.get(key, "0 0 0").split(), float) for key in ("xyz", "rpy")
        )
        position = position + turn.apply(xyz)
        turn *= Rotation.from_euler("xyz", rpy)
        if joint.get("name") in JOINTS:
            axis = np.array(joint.find("axis").get("xyz", "").split(), float)  # type: ignore[union-attr]
            angle = q[:, JOINTS.index(joint.get("name", ""))]
            turn *= Rotation.from_rotvec(angle[:, None] * axis)
    return turn, position


def orientation_violation(
    turn: Rotation, wanted: Rotation, limits: Any, parametrization: str
) -> Array:
    """Return the largest violation of MoveIt's orientation constraint [rad], negative inside."""
    relative = wanted.inv() * turn
    euler = parametrization == EULER
    angles = relative.as_euler("XYZ") if euler else relative.as_rotvec()
    violation = np.abs(angles) - np.array(limits)
    free = [np.pi, np.pi / 2 if euler else np.pi, np.pi]  # the second is at most pi / 2
    return np.asarray(violation[:, np.array(limits) < free].max(axis=1))


def region_violation(region: Obstacle, points: Array) -> Array:
    """Return the distances of points outside of a region at rest in its axes [m], negative inside."""
    turn = Rotation.from_euler("xyz", region.rotation)
    p = turn.inv().apply(points - np.array(region.position))
    if region.kind == "box":
        return np.asarray((np.abs(p) - np.array(region.size) / 2).max(axis=1))
    if region.kind == "sphere":
        return np.asarray(np.linalg.norm(p, axis=1) - region.radius)
    round_face = np.hypot(p[:, 0], p[:, 1]) - region.radius
    return np.maximum(round_face, np.abs(p[:, 2]) - (region.length or 0) / 2)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot(cnpgen.load_problem("panda"))


def random_states(robot: Robot, count: int, seed: int) -> Array:
    random = np.random.default_rng(seed)
    return random.uniform(robot.position_lower, robot.position_upper, (count, 7))


def measured_violation(constraint: Constraint, world: World) -> Any:
    """Return the largest violation that a measured form has at one state or at many."""
    worst = -np.inf
    for condition in constraint.measured(world):
        for g, low, high in zip(
            condition.g, condition.lower, condition.upper, strict=True
        ):
            worst = np.maximum(worst, np.maximum(low - g, g - high))
    return worst


def symbolic_values(constraint: Constraint, robot: Robot, q: Array) -> Array:
    """Return the smallest value of the symbolic form at states (K, 7), positive inside."""
    columns, state = SymbolicState.of_symbols(robot, (), None, 0)
    (condition,) = constraint.symbolic(state)
    smallest = ca.mmin(ca.vertcat(*condition.g))
    function = ca.Function("g", columns, [smallest, ca.jacobian(smallest, columns[0])])
    values, slopes = zip(*(function(state, 0, 0, []) for state in q), strict=True)
    assert np.isfinite(np.array([np.array(slope) for slope in slopes])).all()
    return np.array([float(value) for value in values])


ORIENTATIONS = [
    (EULER, (0.6, 0.7, 0.8)),
    (EULER, (1.0, 1.2, np.pi)),
    (EULER, (2.5, 2.0, 1.0)),
    (EULER, (np.pi, 0.9, 2.0)),
    (ROTATION_VECTOR, (0.4, 0.8, 1.2)),
    (ROTATION_VECTOR, (0.9, 0.9, np.pi)),
    (ROTATION_VECTOR, (2.5, 1.0, np.pi)),
]


@pytest.mark.parametrize(("parametrization", "limits"), ORIENTATIONS)
@pytest.mark.parametrize("link", [HAND, "panda_link4"])
def test_both_forms_of_an_orientation_are_those_of_the_message(
    robot, parametrization, limits, link
):
    wanted = Rotation.from_euler("xyz", [2.0, 0.4, -1.1])
    constraint = LinkOrientation(
        link=link,
        rpy=roll_pitch_yaw(wanted.as_matrix()),
        limits=limits,
        parametrization=parametrization,
    )
    q = random_states(robot, 300, 3)
    urdf = cnpgen.load_problem("panda").urdf_text
    expected = orientation_violation(
        link_poses(urdf, link, q)[0], wanted, limits, parametrization
    )
    path, still = PathWorld(robot), np.zeros((7, len(q)))
    path.set_path(q.T.copy(), still, still, np.empty(0))
    along = measured_violation(constraint, path)  # type: ignore[arg-type]
    np.testing.assert_allclose(along, expected, atol=1e-9)
    world = World(robot)
    for state, value in zip(q[:5], expected, strict=False):
        world.set_state(state, np.zeros(7), np.zeros(7), np.empty(0))
        assert measured_violation(constraint, world) == pytest.approx(value, abs=1e-9)
    inside = symbolic_values(constraint, robot, q)
    clear = np.abs(expected) > 1e-5
    assert ((inside > 0) == (expected < 0))[clear].all()
    assert (expected < 0).sum() > 2
    assert (expected > 0).sum() > 20


REGIONS = {
    "box": Obstacle(name="a", position=(0.3, 0, 0.5), size=(0.8, 0.9, 0.7), rotation=(0.1, 0.5, 1)),
    "sphere": Obstacle(name="b", kind="sphere", position=(0.2, 0.1, 0.6), radius=0.5),
    "cylinder": Obstacle(
        name="c", kind="cylinder", position=(-0.2, 0, 0.6), radius=0.5, length=0.7, rotation=(1.2, 0, 0)
    ),
}  # fmt: skip


@pytest.mark.parametrize("kinds", [["box"], ["sphere"], ["cylinder"], [*REGIONS]])
@pytest.mark.parametrize("link", [HAND, "panda_link4"])
def test_both_forms_of_a_position_are_those_of_the_message(robot, kinds, link):
    offset = (0.02, -0.05, 0.1)
    regions = tuple(REGIONS[kind] for kind in kinds)
    constraint = LinkPosition(link=link, offset=offset, region=regions)
    q = random_states(robot, 300, 4)
    turn, origin = link_poses(cnpgen.load_problem("panda").urdf_text, link, q)
    points = origin + turn.apply(offset)
    violations = [region_violation(region, points) for region in regions]
    expected = np.min(violations, axis=0)
    path, still = PathWorld(robot), np.zeros((7, len(q)))
    path.set_path(q.T.copy(), still, still, np.empty(0))
    along = measured_violation(constraint, path)  # type: ignore[arg-type]
    np.testing.assert_allclose(along, expected, atol=1e-9)
    inside = symbolic_values(constraint, robot, q)
    clear = np.abs(expected) > 1e-9
    assert ((inside > 0) == (expected < 0))[clear].all()
    assert (expected < 0).any()
    assert (expected > 0).any()


def orientation(limits: Any, robot: Robot, **changes: Any) -> dict[str, Any]:
    """Return a constraint to the orientation of the hand at the start."""
    turn, _ = link_poses(
        cnpgen.load_problem("panda").urdf_text, HAND, np.array([START], float)
    )
    entry = {
        "header": {"frame_id": "panda_link0"},
        "link_name": HAND,
        "orientation": turn.as_quat()[0].tolist(),
        "weight": 1.0,
    }
    for axis, limit in zip("xyz", limits, strict=True):
        entry[f"absolute_{axis}_axis_tolerance"] = limit
    return {"orientation_constraints": [entry | changes]}


def position(
    primitives: list[dict[str, Any]], places: Any, **changes: Any
) -> dict[str, Any]:
    """Return a constraint of the origin of the hand to one of several regions."""
    poses = [{"position": list(place), "orientation": UPRIGHT} for place in places]
    entry = {
        "header": {"frame_id": "panda_link0"},
        "link_name": HAND,
        "constraint_region": {"primitives": primitives, "primitive_poses": poses},
    }
    return {"position_constraints": [entry | changes]}


def hand_at(q: Any) -> Array:
    urdf = cnpgen.load_problem("panda").urdf_text
    _, positions = link_poses(urdf, HAND, np.atleast_2d(np.array(q, float)))
    return positions


def states_of(solved: Any) -> Array:
    """Return the states of a plan every millisecond, shape (K, 7)."""
    duration = float(solved.plans.duration[0])
    t = np.append(np.arange(0.0, duration, 1e-3), duration)
    return np.asarray(solved.plans[[0] * len(t)].states_at(t)[0])


def turned_goal(robot: Robot, limits: Any) -> list[float]:
    """Return joint positions with the orientation of the hand at the start, whose straight line leaves it."""
    hand = PoseKinematics(robot, robot.model.getFrameId(HAND))
    (place,), (turn,), _ = hand.evaluate(np.array(START, float)[:, None])
    places = np.tile(place + np.array([0.05, 0.5, 0.1]), (200, 1))
    seeds = random_states(robot, 200, 5).T.copy()
    q, met = solve_pose_ik(hand, places, np.tile(turn, (200, 1, 1)), seeds)
    states = RestingStates(cnpgen.load_problem("panda"), robot)
    urdf = cnpgen.load_problem("panda").urdf_text
    for goal in q[:, met].T:
        line = np.linspace(START, goal, 50)
        turns = link_poses(urdf, HAND, line)[0]
        violation = orientation_violation(turns, turns[0], limits, EULER).max()
        if 0.2 < violation < 0.6 and states.are_ends(goal[:, None].copy(), margin=0.01):
            return [float(each) for each in goal]
    raise AssertionError("no goal")


@pytest.mark.slow
@pytest.mark.parametrize("parametrization", [0, 1])
@pytest.mark.parametrize("limits", [(0.1, 0.1, 3.2), (0.3, 0.15, 0.6)])
def test_plans_keep_orientations(tmp_path, robot, parametrization, limits):
    names = zip(JOINTS, turned_goal(robot, limits), strict=True)
    goals = [
        {"joint_constraints": [{"joint_name": n, "position": q} for n, q in names]}
    ]
    paths = orientation(limits, robot, parameterization=parametrization)
    content = request(
        path_constraints=paths,
        goal_constraints=goals,
        world={"collision_objects": []},
    )
    solved = solve_scenes("panda", [scene_of(tmp_path, content)])
    assert solved.valid.all(), solved.results[0].reason
    free = solve_scenes(
        "panda", [scene_of(tmp_path, content | {"path_constraints": {}})]
    )
    urdf, wanted = (
        cnpgen.load_problem("panda").urdf_text,
        paths["orientation_constraints"][0]["orientation"],
    )
    kind = [EULER, ROTATION_VECTOR][parametrization]
    worst = [
        orientation_violation(
            link_poses(urdf, HAND, states_of(each))[0],
            Rotation.from_quat(wanted),
            limits,
            kind,
        ).max()
        for each in (solved, free)
    ]
    assert worst[0] <= ROUNDING
    assert worst[1] > 0.01  # without the constraint the motion violates it
    assert not cnpgen.evaluate_plans(with_problem(free, solved)).verdicts[0].valid


def with_problem(plans: Any, other: Any) -> Any:
    """Return plans as those of the problem of others."""
    from dataclasses import replace

    return replace(plans.plans, problem=other.plans.problem)


def around(places: Array, width: float) -> tuple[list[float], list[float]]:
    """Return the edges and the center of a box around points."""
    low, high = places.min(axis=0) - width, places.max(axis=0) + width
    return (high - low).tolist(), ((low + high) / 2).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["box", "cylinder", "union"])
def test_plans_keep_positions(tmp_path, robot, kind):
    ends = hand_at([START, GOAL])
    edges, center = around(ends, 0.06)
    shape = {
        # a thin box, and a disk about the axis of the robot
        "box": [{"type": "box", "dimensions": edges}],
        "cylinder": [{"type": "cylinder", "dimensions": [0.1, 0.62]}],
        "union": [
            {"type": "sphere", "dimensions": [0.2]},
            {"type": "box", "dimensions": [0.3, 1.2, 0.1]},
            {"type": "sphere", "dimensions": [0.2]},
        ],
    }[kind]
    middle = ends.mean(axis=0) + np.array([0.08, 0.0, 0.12])
    places = {
        "box": [center],
        "cylinder": [[0.0, 0.0, ends[0, 2]]],
        "union": [ends[0], middle, ends[1]],
    }[kind]
    paths = position(shape, places)
    post = box("post", [0.05, 0.05, 0.3], [0.5, 0, 0.15], "panda_link0")
    content = request(path_constraints=paths, world={"collision_objects": [post]})
    solved = solve_scenes("panda", [scene_of(tmp_path, content)])
    assert solved.valid.all(), solved.results[0].reason
    problem, _ = open_problem(solved.plans.problem)
    constraint = problem.first(LinkPosition)
    assert constraint is not None
    points = hand_at(states_of(solved))
    violations = [region_violation(each, points) for each in constraint.region]
    assert np.min(violations, axis=0).max() <= ROUNDING
    assert len(constraint.region) == len(shape)


def constrained(tmp_path: Path, robot: Robot, content: dict[str, Any]) -> Any:
    """Return the problem of a request."""
    scene = placed_scene(scene_of(tmp_path, content), robot, np.array(START, float))
    return requested_problem(cnpgen.load_problem("panda"), robot, [scene])[0]


def test_frames_of_objects_and_transforms_place_constraints(tmp_path, robot):
    table = box("table", [0.1, 0.1, 0.1], [0, 0, 0], "panda_link0")
    turn = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    table["pose"] = {"position": [0.6, 0.5, 0.2], "orientation": turn}
    header = {"header": {"frame_id": "table"}}
    regions = [{"type": "box", "dimensions": [1, 2, 3]}]
    paths = position(regions, [[0.1, 0, 0]], **header)
    paths |= orientation((0.1, 0.2, 0.3), robot, **header, orientation=UPRIGHT)
    content = request(path_constraints=paths, world={"collision_objects": [table]})
    problem = constrained(tmp_path, robot, content)
    region = problem.first(LinkPosition).region[0]
    np.testing.assert_allclose(region.position, [0.6, 0.6, 0.2], atol=1e-12)
    np.testing.assert_allclose(region.rotation, [0, 0, np.pi / 2], atol=1e-12)
    turned = problem.first(LinkOrientation)
    np.testing.assert_allclose(turned.rpy, [0, 0, np.pi / 2], atol=1e-12)
    assert turned.limits == (0.1, 0.2, 0.3)
    assert turned.parametrization == EULER
    restored = as_problem(record_problem(problem))
    assert restored.constraint == problem.constraint


def test_an_end_outside_is_named(tmp_path, robot):
    paths = position([{"type": "sphere", "dimensions": [0.1]}], [[0.5, 0, 0.5]])
    solved = solve_scenes(
        "panda", [scene_of(tmp_path, request(path_constraints=paths))]
    )
    assert not solved.valid.any()
    assert solved.results[0].reason == LinkPosition.reason


SPHERE = [{"type": "sphere", "dimensions": [1.0]}]


@pytest.mark.parametrize(
    ("paths", "text"),
    [
        (position(SPHERE, [[0, 0, 0]], link_name="gripper"), "the robot lacks"),
        (position(SPHERE, [[0, 0, 0]], link_name="panda_link0"), "that planned joints"),
        (
            position(SPHERE, [[0, 0, 0]], header={"frame_id": "panda_link4"}),
            "'panda_link4', expected a frame of the world",
        ),
        (position(SPHERE, [[0, 0, 0]], header={"frame_id": "lab"}), "the robot lacks"),
        (position(SPHERE, []), "one pose for each"),
        (position([{"type": "cone", "dimensions": [1, 1]}], [[0, 0, 0]]), "'cone'"),
        (position([{"type": "box", "dimensions": [1, 1, 0]}], [[0, 0, 0]]), "at least"),
        (position(SPHERE, [[0, 0, 0]], target_point_offset={"x": "nan", "y": 0, "z": 0}), "finite"),
        (position(SPHERE, [[0, 0, 0]], link_name=""), "without link_name"),
        ({"joint_constraints": [{"joint_name": "a"}]}, "give ranges of joints by"),
        ({"visibility_constraints": [{"weight": 1}]}, "visibility is not supported"),
        (
            {"orientation_constraints": [{"link_name": HAND, "orientation": UPRIGHT}]},
            "orientation tolerances must be at least",
        ),
    ],
)  # fmt: skip
def test_constraints_that_are_not_supported_are_refused(tmp_path, robot, paths, text):
    with pytest.raises((SceneError, UsageError), match=text):
        constrained(tmp_path, robot, request(path_constraints=paths))


def test_several_constraints_of_one_kind_hold_and_are_stored(tmp_path, robot):
    region = {"primitives": [{"type": 1, "dimensions": [0.2] * 3}]}
    region["primitive_poses"] = [{"position": [0.4, 0, 0.5], "orientation": UPRIGHT}]
    tilt = {"orientation": [1, 0, 0, 0], "absolute_z_axis_tolerance": 3.2}
    tilts = [
        tilt
        | {"link_name": link}
        | {f"absolute_{axis}_axis_tolerance": limit for axis in "xy"}
        for link, limit in ((HAND, 0.5), (HAND, 0.2), ("panda_link7", 0.4))
    ]
    places = [
        {"link_name": link, "constraint_region": region}
        for link in (HAND, "panda_link7")
    ]
    constraints = {"orientation_constraints": tilts, "position_constraints": places}
    content = request(path_constraints=constraints)
    scene = scene_of(tmp_path, content)
    placed = placed_scene(scene, robot, scene.start_q)
    problem, _, _ = requested_problem(cnpgen.load_problem("panda"), robot, [placed])
    record = record_problem(as_problem(record_problem(problem)))
    stored = [each for each in as_problem(record).constraint if hasattr(each, "link")]
    assert stored == list(placed.request.constraints)
    links = [HAND, HAND, "panda_link7", HAND, "panda_link7"]
    assert [each.link for each in stored] == links
