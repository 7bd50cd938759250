"""Alternative goals, empty start states, and meshes in files of MoveIt's scenes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.make.solve_scenes import _goals
from cnpgen.plans.scene_plans import start_state
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.scenes.placement import placed_scene
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.inline import corners_of
from cnpgen.scenes import SceneError, load_scenes
from tests.addons.scene_files.test_requests import (
    GOAL,
    JOINTS,
    START,
    UPRIGHT,
    box,
    pose_of,
    request,
    scene_of,
)
from tests.examples.example_robots import needs_robots
from tests.refusals import assert_said, is_refused

pytestmark = needs_robots


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot(cnpgen.load_problem("panda"))


def pose_goal(
    robot: Robot, q: list[float], shift: float = 0.0, frame: str = "panda_link0"
) -> dict[str, Any]:
    """Return a goal with the pose of the hand at a state."""
    pose = pose_of(robot, "panda_hand", q)

    place = (pose.translation + np.array([shift, 0, 0])).tolist()
    common = {"header": {"frame_id": frame}, "link_name": "panda_hand"}
    sphere = {
        "primitives": [{"type": "sphere", "dimensions": [0.002]}],
        "primitive_poses": [{"position": place, "orientation": UPRIGHT}],
    }
    turn = pin.Quaternion(pose.rotation).coeffs().tolist()
    tolerances = {f"absolute_{axis}_axis_tolerance": 0.01 for axis in "xyz"}
    return {
        "position_constraints": [common | {"constraint_region": sphere}],
        "orientation_constraints": [common | {"orientation": turn} | tolerances],
    }


@pytest.mark.parametrize("order", [1, -1])
def test_any_of_several_goal_poses_is_a_goal(tmp_path, robot, order):
    far, near = pose_goal(robot, START, shift=5.0), pose_goal(robot, GOAL)
    content = request(goal_constraints=[far, near][::order])
    scene = scene_of(tmp_path, content)
    assert len(scene.other_goal_poses) == 1
    states = _goals(cnpgen.load_problem("panda"), robot, scene, 0, most=5)
    place = pose_of(robot, "panda_hand", GOAL).translation
    for state in states:
        reached = pose_of(robot, "panda_hand", state.tolist()).translation
        np.testing.assert_allclose(reached, place, atol=0.0021)


def test_poses_are_alternatives_to_joint_goals_in_collision(tmp_path, robot):
    inside = [0.1, -0.4, 0, -2.2, 0, 1.8, 0.785]
    joints = {
        "joint_constraints": [
            {"joint_name": name, "position": q}
            for name, q in zip(JOINTS, inside, strict=True)
        ]
    }
    at = pose_of(robot, "panda_hand", inside).translation
    block = box("block", [0.1, 0.1, 0.1], at.tolist(), "panda_link0")
    both = request(
        goal_constraints=[joints, pose_goal(robot, GOAL)],
        world={"collision_objects": [block]},
    )
    scene, problem = scene_of(tmp_path, both), cnpgen.load_problem("panda")
    states = _goals(problem, robot, scene, 0, most=5)
    assert len(states)
    assert np.abs(states - inside).max(axis=1).min() > 0.05
    alone = scene_of(tmp_path, both | {"goal_constraints": [joints]})
    np.testing.assert_array_equal(_goals(problem, robot, alone, 0, most=5), [inside])


def test_frames_of_other_goals_are_placed(tmp_path, robot):
    table = box("table", [0.1, 0.1, 0.1], [0.3, 0.9, -0.4], "panda_link0")
    goals = [pose_goal(robot, GOAL), pose_goal(robot, GOAL, frame="table")]
    content = request(goal_constraints=goals, world={"collision_objects": [table]})
    scene = scene_of(tmp_path, content)
    placed = placed_scene(scene, robot, start_state(scene, robot))
    shift = placed.other_goal_poses[0].position - placed.goal_pose.position
    np.testing.assert_allclose(shift, [0.3, 0.9, -0.4], atol=1e-12)


def empty_start() -> dict[str, Any]:
    return request(start_state={"is_diff": True})


def test_an_empty_start_state_needs_the_present_one(tmp_path, robot):
    with is_refused(SceneError):
        scene_of(tmp_path, empty_start())
    present = dict(zip(JOINTS, START, strict=True))
    scene = scene_of(tmp_path, empty_start(), present=present)
    np.testing.assert_array_equal(start_state(scene, robot), START)
    stated = scene_of(tmp_path, request(), present=dict.fromkeys(JOINTS, 0.0))
    np.testing.assert_array_equal(start_state(stated, robot), START)


def test_the_command_takes_the_present_state(tmp_path, capsys):
    file = tmp_path / "case.yaml"
    file.write_text(json.dumps(empty_start()))
    command = ["solve", str(file), "--robot", "panda", "-o", str(tmp_path / "p.h5")]
    assert main([*command, "--start", "1,2"]) == 2
    assert_said(capsys.readouterr().err)
    assert main([*command, "--start", "0,nan,0,0,0,0,0"]) == 2
    assert main([*command, f"--start={','.join(map(str, START))}"]) == 0
    np.testing.assert_array_equal(
        cnpgen.load_plans(tmp_path / "p.h5").boundary.start_q, [START]
    )


def tetrahedron() -> str:
    points = ["0 0 0", "0.1 0 0", "0 0.1 0", "0 0 0.1"]
    faces = ["1 2 3", "1 2 4", "1 3 4", "2 3 4"]
    return "\n".join(
        [*(f"v {each}" for each in points), *(f"f {each}" for each in faces)]
    )


def with_mesh(resource: str, **more: Any) -> dict[str, Any]:
    rock = {
        "id": "rock",
        "header": {"frame_id": "panda_link0"},
        "meshes": [{"resource": resource, **more}],
        "mesh_poses": [{"position": [0.6, 0, 0.2], "orientation": UPRIGHT}],
    }
    return request(world={"collision_objects": [rock]})


def test_mesh_files_are_read_below_the_scene_and_the_packages(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "rock.obj").write_text(tetrahedron())
    packages = tmp_path / "packages"
    (packages / "stones" / "meshes").mkdir(parents=True)
    (packages / "stones" / "meshes" / "rock.obj").write_text(tetrahedron())
    size = {"dimensions": [2, 2, 2]}
    scene = scene_of(tmp_path, with_mesh("meshes/rock.obj", **size))
    corners = corners_of(scene.obstacles[0].mesh)
    np.testing.assert_allclose(np.ptp(corners, axis=0), 0.2, atol=1e-6)
    address = "package://stones/meshes/rock.obj"
    for folder in (packages, packages / "stones"):
        (obstacle,) = scene_of(
            tmp_path, with_mesh(address), packages=[folder]
        ).obstacles
        corners = corners_of(obstacle.mesh)
        np.testing.assert_allclose(np.ptp(corners, axis=0), 0.1, atol=1e-6)
    with is_refused(SceneError):
        scene_of(tmp_path, with_mesh(address))


@pytest.mark.parametrize(
    ("resource", "text"),
    [
        ("../rock.obj", "below the folder"),
        ("meshes/../../rock.obj", "below the folder"),
        ("package://stones/../../rock.obj", "below the folder"),
        ("https://example.org/rock.obj", "below the folder"),
        ("file:///etc/rock.obj", "below the folder"),
        ("/etc/rock.obj", "below the folder"),
        ("package:///etc/rock.obj", "below the folder"),
        ("link.obj", "is missing"),
        ("gone.obj", "is missing"),
        ("rock.txt", "not a mesh"),
    ],
)
def test_other_places_of_meshes_are_refused(tmp_path: Path, resource: str, text: str):
    folder = tmp_path / "scenes"
    folder.mkdir()
    (tmp_path / "rock.obj").write_text(tetrahedron())
    (folder / "rock.txt").write_text(tetrahedron())
    (folder / "link.obj").symlink_to(tmp_path / "rock.obj")
    with pytest.raises(SceneError, match=text):
        scene_of(folder, with_mesh(resource))


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"dimensions": [1, 1, 0]}, "dimensions are its scale"),
        ({"vertices": [[0, 0, 0]]}, "has vertices, too"),
        ({"resorce": 1}, "resorce"),
    ],
)
def test_contradicting_meshes_are_refused(tmp_path, more, text):
    (tmp_path / "rock.obj").write_text(tetrahedron())
    file = tmp_path / "case.yaml"
    file.write_text(json.dumps(with_mesh("rock.obj", **more)))
    with pytest.raises(SceneError, match=text):
        load_scenes(file)
