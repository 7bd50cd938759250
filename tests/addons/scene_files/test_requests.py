"""Requests of MoveIt are planned and judged as asked: velocities, scaling, tolerances, frames and attached objects."""

import copy
import json
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.plans.scene_plans import goal_states, scene_plans, start_state
from cnpgen.problems.limit_sources import limit_sources
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.problems.scenes.placement import placed_scene
from cnpgen.problems.scenes.requested_problem import requested_problem
from cnpgen.problems.scenes.scene_problem import SceneProblem
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.convex_part import turned
from cnpgen.scenes import SceneError, load_scenes, save_scenes, solve_scenes
from tests.addons.scene_files.moveit_messages import document
from tests.addons.scene_files.test_moveit_unused import OTHER, changed, minimal
from tests.conftest import needs_compiled_code
from tests.examples.example_robots import needs_robots
from tests.refusals import is_refused

pytestmark = needs_robots

JOINTS = [f"panda_joint{index}" for index in range(1, 8)]
START = [-0.5, -0.4, 0, -2.2, 0, 1.8, 0.785]
GOAL = [0.5, -0.4, 0, -2.2, 0, 1.8, 0.785]
UPRIGHT = [0, 0, 0, 1]
BASE, HAND = "panda_link0", "panda_hand"


def box(name: str, size: list[float], at: list[float], frame: str) -> dict[str, Any]:
    return {
        "id": name,
        "header": {"frame_id": frame},
        "primitives": [{"type": "box", "dimensions": size}],
        "primitive_poses": [{"position": at, "orientation": UPRIGHT}],
    }


def request(**changes: Any) -> dict[str, Any]:
    """Return a scene with a post before the robot, and the request to pass it."""
    post = box("post", [0.05, 0.05, 0.3], [0.5, 0, 0.15], "panda_link0")
    constraints = [
        {"joint_name": name, "position": q, "tolerance_above": 1e-3}
        for name, q in zip(JOINTS, GOAL, strict=True)
    ]
    return {
        "robot_model_name": "panda",
        "world": {"collision_objects": [post]},
        "start_state": {"joint_state": {"name": JOINTS, "position": START}},
        "goal_constraints": [{"joint_constraints": constraints}],
    } | changes


def stick(weight: float = 2.0, **changes: Any) -> dict[str, Any]:
    """Return a start state whose hand carries a stick of 30 cm."""
    body = box("stick", [0.04, 0.04, 0.3], [0, 0, 0.25], "panda_hand") | changes
    state = copy.deepcopy(request()["start_state"])
    state["attached_collision_objects"] = [
        {
            "link_name": "panda_hand",
            "object": body,
            "touch_links": ["panda_leftfinger", "panda_rightfinger"],
            "weight": weight,
        }
    ]
    return state


def scene_of(folder: Path, content: dict[str, Any], **options: Any) -> SceneProblem:
    file = folder / "case.yaml"
    file.write_text(json.dumps(content))  # JSON is YAML
    (scene,) = load_scenes(file, **options)
    return scene


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot(cnpgen.load_problem("panda"))


def placed(scene: SceneProblem, robot: Robot) -> SceneProblem:
    return placed_scene(scene, robot, start_state(scene, robot))


def pose_of(robot: Robot, frame: str, q: list[float]) -> pin.SE3:
    """Return the pose of a frame by Pinocchio."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, np.array(q, float))
    return data.oMf[robot.model.getFrameId(frame)]


def test_objects_in_frames_of_links_are_placed_at_the_start(tmp_path, robot):
    block = box("block", [0.1, 0.2, 0.3], [0.1, 0, 0.4], "panda_link4")
    scene = scene_of(tmp_path, request(world={"collision_objects": [block]}))
    (obstacle,) = placed(scene, robot).obstacles
    expected = pose_of(robot, "panda_link4", START).act(
        pin.SE3(np.eye(3), np.array([0.1, 0, 0.4]))
    )
    np.testing.assert_allclose(obstacle.position, expected.translation, atol=1e-12)
    np.testing.assert_allclose(
        turned(*obstacle.rotation), expected.rotation, atol=1e-12
    )


def test_objects_in_frames_of_objects_and_subframes_are_placed(tmp_path, robot):
    table = box("table", [0.4, 0.4, 0.1], [0, 0, 0], "world")
    turn = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    table["pose"] = {"position": [0.6, 0, 0.2], "orientation": turn}
    table |= {
        "subframe_names": ["corner"],
        "subframe_poses": [{"position": [0.2, 0, 0.05], "orientation": UPRIGHT}],
    }
    cup = box("cup", [0.05, 0.05, 0.1], [0.1, 0, 0.1], "table")
    pen = box("pen", [0.01, 0.01, 0.1], [0.1, 0, 0.1], "table/corner")
    scene = scene_of(tmp_path, request(world={"collision_objects": [table, cup, pen]}))
    positions = [each.position for each in placed(scene, robot).obstacles]
    np.testing.assert_allclose(
        positions, [[0.6, 0, 0.2], [0.6, 0.1, 0.3], [0.6, 0.3, 0.35]], atol=1e-12
    )


def test_the_placement_of_the_base_moves_the_world(tmp_path, robot):
    half = np.sqrt(0.5)
    base = {"translation": [1.0, 2.0, 0.5], "rotation": [0, 0, half, half]}
    state = request()["start_state"] | {
        "multi_dof_joint_state": {
            "header": {"frame_id": "map"},
            "joint_names": ["virtual_joint"],
            "transforms": [base],
        }
    }
    objects = [
        box("in world", [0.1, 0.1, 0.1], [1.0, 2.6, 0.8], "world"),
        box("in map", [0.1, 0.1, 0.1], [1.0, 2.6, 0.8], "map"),
        box("in base", [0.1, 0.1, 0.1], [0.6, 0, 0.3], "panda_link0"),
    ]
    content = request(start_state=state, world={"collision_objects": objects})
    positions = [
        each.position for each in placed(scene_of(tmp_path, content), robot).obstacles
    ]
    np.testing.assert_allclose(positions, [[0.6, 0, 0.3]] * 3, atol=1e-12)
    base["rotation"] = [half, 0, 0, half]
    with is_refused(SceneError):
        scene_of(tmp_path, content)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (
            "table_top",
            "'post' is in the frame 'table_top', which the robot lacks; expected",
        ),
        ("panda_link_0", r"lacks \(did you mean 'panda_link\d'\?\)"),
    ],
)
def test_unknown_frames_are_refused(tmp_path, robot, frame, text):
    post = box("post", [0.05, 0.05, 0.3], [0.5, 0, 0.15], frame)
    scene = scene_of(tmp_path, request(world={"collision_objects": [post]}))
    for call in (solve_scenes, scene_plans):
        with pytest.raises(SceneError, match=text):
            call("panda" if call is solve_scenes else robot_problem(), [scene])


def robot_problem() -> cnpgen.Problem:
    return cnpgen.load_problem("panda")


def test_operations_change_the_world_in_their_order(tmp_path):
    first = box("a", [0.1, 0.1, 0.1], [0.5, 0, 0.5], "world")
    entries = [
        first,
        box("b", [0.2, 0.1, 0.1], [0.5, 0.3, 0.5], "world"),
        box("a", [0.3, 0.1, 0.1], [0.5, 0, 0.7], "world") | {"operation": 2},
        {"id": "b", "operation": "REMOVE"},
        {
            "id": "a",
            "operation": 3,
            "header": {"frame_id": "world"},
            "primitive_poses": [
                {"position": [0.4, 0, z], "orientation": UPRIGHT} for z in (0.8, 0.9)
            ],
        },
    ]
    scene = scene_of(tmp_path, request(world={"collision_objects": entries}))
    assert [each.size[0] for each in scene.obstacles] == [0.1, 0.3]
    assert [each.position for each in scene.obstacles] == [(0.4, 0, 0.8), (0.4, 0, 0.9)]
    for bad, text in (
        ([first, first], "added twice"),
        ([first | {"operation": 4}], "operation must be 0 to 3"),
        ([{"id": "c", "operation": 1}], "removed, and the world has no such object"),
        ([{"id": "c", "operation": 3}], "moved, and the world has no such object"),
        ([first, {"id": "a", "operation": 3}], "moved without a pose"),
        ([first, first | {"operation": 3}], "is moved and has shapes"),
    ):
        with pytest.raises(SceneError, match=text):
            scene_of(tmp_path, request(world={"collision_objects": bad}))


def test_goal_tolerances_move_goals_into_the_limits(tmp_path, robot):
    content = request()
    upper = float(robot.position_upper[0])
    goal = content["goal_constraints"][0]["joint_constraints"]
    goal[0] = {"joint_name": JOINTS[0], "position": upper + 0.1, "tolerance_below": 0.2}
    scene = scene_of(tmp_path, content)
    assert goal_states(scene, robot)[0, 0] == upper
    goal[0]["tolerance_below"] = 0.05
    with is_refused(SceneError):
        goal_states(scene_of(tmp_path, content), robot)
    goal[0] = {"joint_name": JOINTS[0], "position": 0.5, "tolerance_above": -0.1}
    with is_refused(SceneError):
        scene_of(tmp_path, content)


def test_start_velocities_reach_the_boundary_conditions(tmp_path):
    state = copy.deepcopy(request()["start_state"])
    order = [*JOINTS[::-1], "panda_finger_joint1"]
    speeds = [0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.0]
    state["joint_state"] = {
        "name": order,
        "position": [*START[::-1], 0.04],
        "velocity": speeds,
        "effort": [1.0] * 8,
    }
    scene = scene_of(tmp_path, request(start_state=state))
    plans = scene_plans(robot_problem(), [scene])
    np.testing.assert_array_equal(plans.boundary.start_dq, [speeds[6::-1]])
    with is_refused(SceneError):
        save_scenes(tmp_path / "other", [scene])
    state["joint_state"]["velocity"][-1] = 0.1
    with is_refused(SceneError):
        scene_plans(robot_problem(), [scene_of(tmp_path, request(start_state=state))])
    state["joint_state"]["velocity"] = [0.1]
    with is_refused(SceneError):
        scene_of(tmp_path, request(start_state=state))


def test_a_goal_of_a_joint_that_is_not_planned_must_be_its_start(tmp_path, robot):
    content = request()
    state = content["start_state"]["joint_state"] = {
        "name": [*JOINTS, "panda_finger_joint1"],
        "position": [*START, 0.04],
    }
    goal = {"joint_name": "panda_finger_joint1", "position": 0.0}
    content["goal_constraints"][0]["joint_constraints"].append(goal)
    with is_refused(SceneError):
        goal_states(scene_of(tmp_path, content), robot)
    goal["tolerance_above"] = 0.05
    assert len(goal_states(scene_of(tmp_path, content), robot)) == 1
    assert state["position"][-1] == 0.04


def changed_problem(
    folder: Path, content: dict[str, Any], robot: Robot, **options: Any
):
    scene = placed(scene_of(folder, content), robot)
    return requested_problem(robot_problem(), robot, [scene], **options)


def test_scaling_factors_scale_the_limits_of_planner_and_verdict(tmp_path, robot):
    content = request(
        max_velocity_scaling_factor=0.1, max_acceleration_scaling_factor=0.5
    )
    problem, scaled, _ = changed_problem(tmp_path, content, robot)
    for actual in (scaled, open_problem(record_problem(problem))[1]):
        np.testing.assert_allclose(actual.velocity_limit, 0.1 * robot.velocity_limit)
        np.testing.assert_allclose(
            actual.acceleration_limit, 0.5 * robot.acceleration_limit
        )
        np.testing.assert_allclose(actual.jerk_limit, robot.jerk_limit)
        np.testing.assert_allclose(actual.torque_limit, robot.torque_limit)
    same, own, _ = changed_problem(
        tmp_path, request(max_velocity_scaling_factor=0), robot
    )
    assert own is robot
    assert record_problem(same) == record_problem(robot_problem())


def test_scenes_of_one_call_share_a_problem(tmp_path, robot):
    scenes = [
        placed(scene_of(tmp_path, request(max_velocity_scaling_factor=factor)), robot)
        for factor in (0.5, 0.6)
    ]
    with is_refused(SceneError, argument="first"):
        requested_problem(robot_problem(), robot, scenes)
    with is_refused(SceneError):
        scene_plans(robot_problem(), scenes[:1])


def test_attached_objects_have_geometry_mass_and_touch_links(tmp_path, robot):
    content = request(start_state=stick())
    problem, carrying, _ = changed_problem(tmp_path, content, robot)
    assert "attached stick" in record_problem(problem).urdf
    # mass and center of mass against a box that Pinocchio adds to the hand
    model = robot.model.copy()
    hand = model.frames[model.getFrameId("panda_hand")]
    inertia = pin.Inertia.FromBox(2.0, 0.04, 0.04, 0.3)
    place = hand.placement * pin.SE3(np.eye(3), np.array([0, 0, 0.25]))
    model.appendBodyToJoint(hand.parentJoint, inertia, place)
    for mine, other in zip(carrying.model.inertias, model.inertias, strict=True):
        np.testing.assert_allclose(
            mine.toDynamicParameters(), other.toDynamicParameters(), atol=1e-9
        )
    (part,) = [
        each for each in carrying.shape.convex_parts if each.link == "attached stick"
    ]
    frame = carrying.model.frames[carrying.model.getFrameId("attached stick")].placement
    corners = (part.vertices - frame.translation) @ frame.rotation
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.04, 0.04, 0.3], atol=1e-12)
    pairs = {
        frozenset((pair.first, pair.second)): pair.left_out
        for pair in carrying.shape.pairs
    }
    assert pairs[frozenset(("attached stick", "panda_link5"))] == ""
    assert not any(left_out == "always" for left_out in pairs.values())


def test_an_object_of_the_world_is_attached_by_its_id(tmp_path, robot):
    state = stick()
    attached = state["attached_collision_objects"][0]
    where = pose_of(robot, "panda_hand", START).act(
        pin.SE3(np.eye(3), np.array([0, 0, 0.25]))
    )
    quaternion = pin.Quaternion(where.rotation).coeffs().tolist()
    body = box("stick", [0.04, 0.04, 0.3], [0, 0, 0], "world")
    body["primitive_poses"] = [
        {"position": where.translation.tolist(), "orientation": quaternion}
    ]
    usual = placed(scene_of(tmp_path, request(start_state=state)), robot)
    attached["object"] = {"id": "stick"}
    content = request(start_state=state, world={"collision_objects": [body]})
    scene = placed(scene_of(tmp_path, content), robot)
    assert not scene.obstacles
    (mine,), (other,) = (each.request.attached[0].shapes for each in (scene, usual))
    np.testing.assert_allclose(mine.position, other.position, atol=1e-9)
    np.testing.assert_allclose(
        turned(*mine.rotation), turned(*other.rotation), atol=1e-9
    )


@pytest.mark.parametrize(
    ("state", "text"),
    [
        (stick(0), "has the weight 0, which means that it is unknown"),
        (stick(-1), "weight must be positive"),
        (stick(float("nan")), "weight must be positive"),
        (
            stick(header={"frame_id": "panda_hnd"}),
            r"frame 'panda_hnd'.*did you mean 'panda_hand'",
        ),
        (stick(header={}), "has no header.frame_id"),
        (
            stick(id="cup", primitives=[], primitive_poses=[]),
            "the world has no object of this name",
        ),
        (stick(operation=1), "operation must be ADD"),
        (
            stick(
                primitive_poses=[{"position": [0, 0, -0.15], "orientation": UPRIGHT}]
            ),
            "'stick' overlaps the link 'panda_link.' in every state: name the link in its touch_links",
        ),
    ],
)
def test_invalid_attached_objects_are_refused(tmp_path, robot, state, text):
    with pytest.raises(SceneError, match=text):
        changed_problem(tmp_path, request(start_state=state), robot)


def test_an_unknown_weight_is_given_by_payload(tmp_path, robot):
    content = request(start_state=stick(0))
    _, carrying, _ = changed_problem(tmp_path, content, robot, payload=1.5)
    mass = [
        sum(each.mass for each in item.model.inertias) for item in (robot, carrying)
    ]
    assert mass[1] - mass[0] == pytest.approx(1.5)
    with is_refused(UsageError, argument="payload"):
        changed_problem(tmp_path, content, robot, payload=-5.0)


def test_attached_objects_need_link_geometry(tmp_path, robot):
    scene = placed(scene_of(tmp_path, request(start_state=stick())), robot)
    problem = cnpgen.load_problem("heavy-object")
    with is_refused(SceneError):
        requested_problem(problem, load_robot(problem), [scene])


def test_a_robot_of_another_name_and_other_joints_are_warnings(tmp_path, robot, caplog):
    state = {
        "joint_state": {
            "name": [*JOINTS, "panda_finger_joint1", "torso"],
            "position": [*START, 0.01, 0.3],
        }
    }
    scene = scene_of(tmp_path, request(robot_model_name="fetch", start_state=state))
    requested_problem(robot_problem(), robot, [placed(scene, robot)])
    assert "is for the robot 'fetch', the URDF is that of 'panda'" in caplog.text
    assert (
        "panda_finger_joint1 (0.01 in the file, held at 0.04), torso (the robot lacks it)"
        in caplog.text
    )


def test_files_as_robowflex_and_tf_write_them_are_read(tmp_path):
    """Rows of the matrix are plain lists, frames begin with a slash, corners are lists, and factors are 0."""
    content = request(
        allowed_collision_matrix={
            "entry_names": ["panda_link0", "panda_link1"],
            "entry_values": [[False, True], [True, False]],
        },
        fixed_frame_transforms=[
            {
                "header": {"frame_id": "panda_link0"},
                "child_frame_id": "panda_link0",
                "transform": {"translation": [0, 0, 0], "rotation": UPRIGHT},
            }
        ],
        workspace_parameters={"min_corner": [-1, -1, -1], "max_corner": [1, 1, 1]},
        max_velocity_scaling_factor=0,
        max_acceleration_scaling_factor=0,
    )
    content["world"]["collision_objects"][0]["header"]["frame_id"] = "/panda_link0"
    scene = scene_of(tmp_path, content)
    assert scene.request.obstacle_frames == ("panda_link0",)
    assert not scene.request.changes_problem


def matrix(*pairs: tuple[str, str]) -> dict[str, Any]:
    """Return an allowed collision matrix of links and objects."""
    names = ["panda_link0", "panda_link5", "stick", "post", "shelf"]
    allowed = {*pairs, *(pair[::-1] for pair in pairs)}
    rows = [{"enabled": [(a, b) in allowed for b in names]} for a in names]
    return {"entry_names": names, "entry_values": rows}


def test_allowed_pairs_of_attached_objects_and_links_are_touch_links(tmp_path):
    shelf = box("shelf", [0.1, 0.1, 0.1], [0.8, 0, 0.2], "panda_link0")
    world = {"collision_objects": [*request()["world"]["collision_objects"], shelf]}
    allowed = (
        ("stick", "panda_link5"),
        ("post", "shelf"),
        ("panda_link0", "panda_link5"),
    )
    content = request(start_state=stick(), world=world)
    scene = scene_of(tmp_path, content | {"allowed_collision_matrix": matrix(*allowed)})
    fingers = "panda_leftfinger", "panda_rightfinger"
    assert scene.request.attached[0].touch_links == (*fingers, "panda_link5")
    allowed = ("post", "panda_link5"), ("stick", "post"), ("panda_link0", "shelf")
    scene = scene_of(tmp_path, content | {"allowed_collision_matrix": matrix(*allowed)})
    links = scene.request.obstacle_touch_links
    touching = dict(zip(("post", "shelf"), links, strict=True))
    assert touching == {"post": ("panda_link5", "stick"), "shelf": ("panda_link0",)}


def test_defaults_of_allowed_collisions(tmp_path, robot):
    shelf = box("shelf", [0.1, 0.1, 0.1], [0.8, 0, 0.2], "panda_link0")
    world = {"collision_objects": [*request()["world"]["collision_objects"], shelf]}

    def read(names: list[str], values: list[bool], **entries: Any) -> SceneProblem:
        defaults = {"default_entry_names": names, "default_entry_values": values}
        acm = {"allowed_collision_matrix": defaults | entries}
        return scene_of(tmp_path, request(start_state=stick(), world=world) | acm)

    assert [each.name for each in read(["post"], [True]).obstacles] == ["shelf"]
    scene = read(["panda_link5"], [True])
    assert scene.request.obstacle_touch_links == (("panda_link5",),) * 2
    assert "panda_link5" in scene.request.attached[0].touch_links
    assert not read(["post"], [False]).request.obstacle_touch_links
    for names, values, entries, text in (
        (["stick"], [True], {}, "stick and all others"),
        (["post", "shelf"], [True, False], {}, "true for post and false for shelf"),
        (["post"], [True], matrix(), "true for post and false for it and panda_link0"),
    ):
        with pytest.raises(SceneError, match=f"matrix is '{text}"):
            read(names, values, **entries)
    with is_refused(SceneError):
        placed(read(["panda_link_5"], [True]), robot)


def test_an_object_that_links_may_touch_becomes_a_link_of_the_base(tmp_path, robot):
    pairs = ("post", "panda_link5"), ("shelf", "panda_link0"), ("post", "stick")
    shelf = box("shelf", [0.1, 0.1, 0.1], [0.8, 0, 0.2], "panda_link0")
    world = {"collision_objects": [*request()["world"]["collision_objects"], shelf]}
    content = request(start_state=stick(), world=world)
    content |= {"allowed_collision_matrix": matrix(*pairs)}
    scene = placed(scene_of(tmp_path, content), robot)
    assert [each.name for each in scene.obstacles] == ["shelf"]
    _, other, _ = requested_problem(robot_problem(), robot, [scene])
    assert other.shape is not None
    assert other.shape.joints["attached post"] == 0
    left_out = {
        frozenset((each.first, each.second))
        for each in other.shape.pairs
        if each.left_out == "disabled"
    }
    of_post = {frozenset(("attached post", "panda_link5"))}
    of_post |= {frozenset(("attached post", "attached stick"))}
    assert {pair for pair in left_out if "attached post" in pair} == of_post
    part = next(
        each for each in other.shape.convex_parts if each.link == "attached post"
    )
    corners = [[0.475, -0.025, 0], [0.525, 0.025, 0.3]]
    np.testing.assert_allclose(
        [part.vertices.min(axis=0), part.vertices.max(axis=0)], corners, atol=1e-9
    )
    with is_refused(SceneError):
        scene_plans(robot_problem(), [scene_of(tmp_path, content)])
    with is_refused(SceneError):
        save_scenes(tmp_path / "other", [scene_of(tmp_path, content)])


def test_padding_and_scale_enlarge_links_for_obstacles_only(tmp_path, robot):
    sizes = {
        "link_padding": [{"link_name": "panda_hand", "padding": 0.02}],
        "link_scale": [
            {"link_name": "panda_hand", "scale": 1.5},
            {"link_name": "panda_link0", "scale": 1},
        ],
    }
    content = request(start_state=stick(), **sizes)
    content |= {"allowed_collision_matrix": matrix(("post", "panda_link5"))}
    scene = placed(scene_of(tmp_path, content), robot)
    assert scene.request.link_sizes == (("panda_hand", 1.5, 0.02),)
    _, other, _ = requested_problem(robot_problem(), robot, [scene])
    assert other.shape is not None
    corners = {part.link: part.vertices for part in other.shape.convex_parts}
    hand = corners["panda_hand"]
    offsets = hand - hand.mean(axis=0)
    lengths = np.linalg.norm(offsets, axis=1, keepdims=True)
    grown = hand.mean(axis=0) + offsets * (1.5 + 0.02 / lengths)
    name = "attached padding of panda_hand"
    np.testing.assert_allclose(corners[name], grown, atol=1e-9)
    assert not {part.link for part in other.shape.convex_parts} & {
        "attached padding of panda_link0"
    }
    (body,) = (each for each in corners if each.endswith("of attached stick"))
    # In the frame of the joint, which is turned by 45 degrees about z.
    width = np.sqrt(2) * (1.5 * 0.04 + 0.04)
    sizes_of_stick = np.ptp(corners[body], axis=0)
    assert sizes_of_stick == pytest.approx([width, width, 1.5 * 0.3 + 0.04])
    checked = {
        frozenset((each.first, each.second))
        for each in other.shape.pairs
        if not each.left_out
    }
    post = "attached post"  # which no padded link may enter
    assert {pair for pair in checked if {name, body} & pair} == {
        frozenset((name, post)),
        frozenset((body, post)),
    }
    sizes = {"link_padding": [{"link_name": "hnd", "padding": 0.02}]}
    unknown = scene_of(tmp_path, request(**sizes))
    with is_refused(SceneError):
        placed(unknown, robot)


@pytest.mark.slow
@needs_compiled_code
def test_a_padded_link_keeps_its_distance_from_obstacles(tmp_path, robot):
    corners = next(
        part.vertices for part in robot.shape.convex_parts if part.link == "panda_hand"
    )
    frame = robot.model.frames[robot.model.getFrameId("panda_hand")]
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, np.array(START))
    pose = data.oMi[frame.parentJoint]
    corners = corners @ pose.rotation.T + pose.translation
    corner, center = corners[corners[:, 0].argmax()], corners.mean(axis=0)
    ahead = corner + 0.05 * (corner - center) / np.linalg.norm(corner - center)
    block = box("block", [0.02] * 3, ahead.tolist(), "world")

    def solved(padding: float) -> Any:
        pads = [{"link_name": "panda_hand", "padding": padding}]
        world = {"collision_objects": [block]}
        content = request(world=world, link_padding=pads)
        return solve_scenes("panda", [scene_of(tmp_path, content)])

    assert solved(0.03).valid.all()
    refused = solved(0.06)
    assert not refused.valid.any()
    (failure,) = refused.summary()["not_valid"]
    assert "padding of panda_hand, block" in failure["explanation"]


@pytest.mark.slow
@needs_compiled_code
def test_an_allowed_collision_of_an_object_and_links_holds_for_these_links(
    tmp_path, robot
):
    at = pose_of(robot, "panda_hand", START).translation.tolist()
    block = box("block", [0.1, 0.1, 0.1], at, "panda_link0")
    hand = ["panda_link6", "panda_link7", "panda_hand"]
    names = ["block", *hand, "panda_leftfinger", "panda_rightfinger"]
    world = {"collision_objects": [*request()["world"]["collision_objects"], block]}

    def solved(links: list[str]) -> Any:
        rows = [[{a, b} - {*links} == {"block"} for b in names] for a in names]
        acm = {"entry_names": names, "entry_values": rows}
        content = request(world=world, allowed_collision_matrix=acm)
        return solve_scenes("panda", [scene_of(tmp_path, content)])

    allowed = solved(names[1:])
    assert allowed.valid.all()
    pairs = open_problem(allowed.plans.problem)[1].shape.pairs
    assert any(each.left_out == "disabled" for each in pairs)
    refused = solved(hand[:2])
    assert not refused.valid.any()
    (failure,) = refused.summary()["not_valid"]
    assert "panda_hand, attached block" in failure["explanation"]


@pytest.mark.slow
@needs_compiled_code
def test_the_velocity_scaling_of_a_request_holds(tmp_path, robot):
    content = request(
        max_velocity_scaling_factor=0.1, max_acceleration_scaling_factor=0.1
    )
    solved = solve_scenes("panda", [scene_of(tmp_path, content)])
    assert solved.valid.all()
    dq = np.abs(states(solved)[1]) / robot.velocity_limit
    assert 0.099 < dq.max() < 0.1003


@pytest.mark.slow
@needs_compiled_code
def test_the_plan_begins_with_the_velocity_of_the_request(tmp_path):
    state = copy.deepcopy(request()["start_state"])
    state["joint_state"]["velocity"] = [0.5] * 7
    solved = solve_scenes("panda", [scene_of(tmp_path, request(start_state=state))])
    assert solved.valid.all()
    np.testing.assert_allclose(states(solved)[1][0], 0.5, atol=1e-9)


@pytest.mark.slow
@needs_compiled_code
def test_an_attached_object_avoids_the_obstacles(tmp_path, robot):
    hand = pose_of(robot, "panda_hand", [0, *START[1:]])
    tip = hand.act(np.array([0, 0, 0.4]))
    post = box("post", [0.05, 0.05, 0.2], [float(tip[0]), 0, 0.1], "panda_link0")
    content = request(start_state=stick(), world={"collision_objects": [post]})
    q, *_ = states(solve := solve_scenes("panda", [scene_of(tmp_path, content)]))
    assert solve.valid.all()
    assert min(stick_distances(robot, q, post)) >= -1e-4
    straight = np.linspace(START, GOAL, 50)
    assert min(stick_distances(robot, straight, post)) < -0.02


def states(solved: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities of the only plan every millisecond."""
    plans = solved.plans
    found = [plans.states_at(time) for time in np.arange(0, plans.duration[0], 1e-3)]
    return np.array([q[0] for q, *_ in found]), np.array([dq[0] for _, dq, _ in found])


def stick_distances(
    robot: Robot, states: np.ndarray, post: dict[str, Any]
) -> list[float]:
    """Return the distances of the stick from the post by Pinocchio and Coal [m]."""
    body, other = coal.Box(0.04, 0.04, 0.3), coal.Box(0.05, 0.05, 0.2)
    there = coal.Transform3s(
        np.eye(3), np.array(post["primitive_poses"][0]["position"])
    )
    found = []
    for q in states:
        pose = pose_of(robot, "panda_hand", q) * pin.SE3(
            np.eye(3), np.array([0, 0, 0.25])
        )
        here = coal.Transform3s(pose.rotation, pose.translation)
        result = coal.DistanceResult()
        found.append(
            coal.distance(body, here, other, there, coal.DistanceRequest(), result)
        )
    return found


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            [],
            "world.collison_objects (did you mean 'collision_objects'?); --allow-unused collison_objects",
        ),
        (["--payload", "-1"], "expected a mass above 0"),
        (["--allow-unused", "collison_objects"], "has no joint 'panda_joint7'"),
    ],
)
def test_the_command_line_names_the_option_for_unknown_keys(
    tmp_path, capsys, options, text
):
    content = request(world={"collison_objects": []})
    if "--allow-unused" in options:  # stops before the plan, after the scenes were read
        state = content["start_state"]["joint_state"]
        content["start_state"] = {
            "joint_state": {key: value[:-1] for key, value in state.items()}
        }
        del content["goal_constraints"][0]["joint_constraints"][-1]
    file = tmp_path / "case.yaml"
    file.write_text(json.dumps(content))
    out = str(tmp_path / "plans.h5")
    assert main(["solve", str(file), "--robot", "panda", "-o", out, *options]) == 2
    assert text in capsys.readouterr().err


def test_plans_record_the_elements_that_were_accepted_as_unused(tmp_path):
    content = request(max_cartesian_speed=0.3)
    scene = scene_of(tmp_path, content, allow_unused=["max_cartesian_speed"])
    plans = scene_plans(robot_problem(), [scene])
    assert (
        plans.source
        == f"scenes of {tmp_path / 'case.yaml'}, without max_cartesian_speed"
    )


def document_for_panda() -> dict[str, Any]:
    """Return the document of all elements of the messages for a Panda among far objects."""
    text = json.dumps(document())
    for old, new in (("hand", HAND), ("finger", "panda_leftfinger"), ("base", BASE)):
        text = text.replace(f'"{old}"', f'"{new}"')
    content: dict[str, Any] = json.loads(text)
    for state in (content["robot_state"], content["start_state"]):
        state["joint_state"] |= {"name": JOINTS, "position": START, "velocity": []}
    content["robot_state"].pop("attached_collision_objects")
    content["world"]["collision_objects"] = content["world"]["collision_objects"][:1]
    content["fixed_frame_transforms"][0]["transform"]["translation"]["x"] = 3
    constraints = request()["goal_constraints"][0]["joint_constraints"]
    content["goal_constraints"][0]["joint_constraints"] = constraints
    names = content["allowed_collision_matrix"]["entry_names"]
    assert set(names) <= {HAND, "panda_leftfinger"}
    return content


@pytest.mark.slow
@needs_compiled_code
def test_elements_that_are_not_used_do_not_change_plans_and_verdicts(tmp_path):
    usual = other = document_for_panda()
    for place, value in OTHER.values():
        other = changed(other, place, value)
    found = []
    for content in (usual, other):
        solved = solve_scenes("panda", [scene_of(tmp_path, content)])
        assert solved.valid.all()
        plans = solved.plans
        verdicts = cnpgen.evaluate_plans(plans)
        points = plans.path_control_points, plans.rate_control_points
        arrays = *points, plans.columns["obstacle_poses"]
        bytes_of = [array.tobytes() for array in arrays]
        report = [verdict.to_dict() for verdict in verdicts.verdicts]
        found.append((bytes_of, plans.problem, verdicts.summary(), report))
    assert found[0] == found[1]


def test_a_misspelt_object_in_a_matrix_is_listed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "cnpgen")
    shelf = {"id": "shelf", "primitives": [{"type": 1, "dimensions": [0.1] * 3}]}
    shelf["primitive_poses"] = [{"position": [1, 0, 0], "orientation": [0, 0, 0, 1]}]
    content = minimal() | {"world": {"collision_objects": [shelf]}}
    for name, listed in (("shelf", False), ("shef", True), ("panda_hand", False)):
        caplog.clear()
        rows = [{"enabled": [False, True]}, {"enabled": [True, False]}]
        entries = {"entry_names": [name, "panda_link5"], "entry_values": rows}
        document = content | {"allowed_collision_matrix": entries}
        (tmp_path / "scene.yaml").write_text(json.dumps(document))
        load_scenes(tmp_path / "scene.yaml")
        text = "allowed_collision_matrix.shef (did you mean 'shelf'?)"
        assert (text in caplog.text) == listed


@pytest.mark.parametrize(
    ("names", "unused"),
    [
        (("panda_link5", "post"), ""),
        (("panda_link5", "panda_hand"), "pairs of links"),
        (("post", "shelf"), "pairs of objects"),
    ],
)
def test_pairs_of_a_matrix_that_are_applied_are_not_listed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, names: Any, unused: str
) -> None:
    caplog.set_level("INFO", "cnpgen")
    shelf = box("shelf", [0.1, 0.1, 0.1], [0.8, 0, 0.2], "panda_link0")
    world = {"collision_objects": [*request()["world"]["collision_objects"], shelf]}
    rows = [{"enabled": [False, True]}, {"enabled": [True, False]}]
    entries = {"entry_names": [*names], "entry_values": rows}
    scene_of(tmp_path, request(world=world, allowed_collision_matrix=entries))
    text = f"not used: allowed_collision_matrix.{unused} ("
    assert (text in caplog.text) if unused else ("not used" not in caplog.text)


def test_demands_of_a_request_keep_the_sources_of_limits(tmp_path, robot):
    """Accelerations that a rule guesses stay guesses, scaled or not."""
    problem = robot_problem()
    before = limit_sources(problem, robot)
    content = request(allowed_collision_matrix=matrix(("post", "panda_link5")))
    for scale, suffix in ((1, ""), (0.5, ", times 0.5")):
        scaled = content | {"max_acceleration_scaling_factor": scale}
        scene = placed(scene_of(tmp_path, scaled), robot)
        changed_problem, other, _ = requested_problem(problem, robot, [scene])
        after = limit_sources(changed_problem, other)
        assert after["jerk"] == before["jerk"]
        assert after["acceleration"].basis == before["acceleration"].basis
        assert after["acceleration"].source == before["acceleration"].source + suffix


def test_a_matrix_that_allows_and_forbids_a_pair_is_refused(tmp_path: Path) -> None:
    content = matrix(("post", "panda_link5"))
    content["entry_values"][1] = [False] * len(content["entry_names"])
    with is_refused(SceneError):
        scene_of(tmp_path, request() | {"allowed_collision_matrix": content})
