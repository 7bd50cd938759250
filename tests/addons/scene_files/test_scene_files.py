"""Scene files: readers against files as other software writes them, round trips of the writers, and invalid scenes."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy
import yaml

from cnpgen.errors import CnpgenError, DatasetError, UsageError
from cnpgen.problems.scenes.quaternions import (
    quaternion_of,
    roll_pitch_yaw,
    rotation_matrix,
)
from cnpgen.problems.scenes.scene_problem import checked_scene, make_obstacle
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.shape.hull import CUBE
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.scenes import SceneError, SceneProblem, load_scenes, make_mesh, save_scenes
from tests.examples.scene_files import REQUEST, ROBOMETRICS, SCENE
from tests.refusals import is_refused

pytest.importorskip("yaml")

JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
START = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


def write(folder: Path, **texts: str) -> Path:
    for name, text in texts.items():
        (folder / f"{name}.yaml").write_text(text)
    return folder


def example(name: str = "shelf") -> SceneProblem:
    """Return a scene with turned boxes, a cylinder and a sphere."""
    obstacles = (
        Obstacle(
            name="board",
            kind="box",
            position=(0.6, 0.1, 0.4),
            size=(0.8, 0.6, 0.03),
            rotation=(0.1, -0.4, 1.2),
        ),
        Obstacle(
            name="wall", kind="box", position=(0.0, 0.8, 0.4), size=(1.0, 0.05, 0.8)
        ),
        Obstacle(
            name="can 'A'",
            kind="cylinder",
            position=(0.5, -0.3, 0.5),
            radius=0.04,
            length=0.2,
            rotation=(0.5, 0.2, 0.0),
        ),
        Obstacle(name="ball", kind="sphere", position=(-0.4, -0.3, 0.7), radius=0.07),
    )
    goal = START + np.array([1.0, 0.2, -0.3, 0.4, 0.1, -0.2, 0.3])
    return SceneProblem(
        name=name, obstacles=obstacles, start_q=START, goal_q=goal[None]
    )


def test_quaternions_agree_with_scipy() -> None:
    random = scipy.spatial.transform.Rotation.random(200, random_state=1)
    edges = scipy.spatial.transform.Rotation.from_euler(
        "xyz",
        [[0, 90, 0], [30, 90, 0], [30, -90, 20], [180, 0, 0], [0, 0, 180]],
        degrees=True,
    )
    for rotation in [*random, *edges]:
        xyzw, matrix = rotation.as_quat(), rotation.as_matrix()
        assert rotation_matrix(xyzw[[3, 0, 1, 2]]) == pytest.approx(matrix, abs=1e-14)
        assert abs(quaternion_of(matrix) @ xyzw[[3, 0, 1, 2]]) == pytest.approx(
            1, abs=1e-14
        )
        assert turned(*roll_pitch_yaw(matrix)) == pytest.approx(matrix, abs=1e-12)


def test_moveit_scenes_and_requests_are_read_with_composed_poses(
    tmp_path: Path,
) -> None:
    (scene,) = load_scenes(write(tmp_path, scene0001=SCENE, request0001=REQUEST))
    can, shelf, ball = scene.obstacles
    assert (can.kind, can.radius, can.length, can.position) == (
        "cylinder",
        0.03,
        0.14,
        (0.9, 0.0, 1.08),
    )
    outer, inner = (
        scipy.spatial.transform.Rotation.from_euler("z", angle, degrees=True)
        for angle in (90, 45)
    )
    assert shelf.size == (1.2, 1.0, 0.04)
    assert shelf.position == pytest.approx(
        np.array([0.5, 0, 0.25]) + outer.apply([0.25, 0, 0])
    )
    assert turned(*shelf.rotation) == pytest.approx(
        (outer * inner).as_matrix(), abs=1e-12
    )
    assert ball.kind == "sphere"
    assert ball.position == pytest.approx((0.0, 0.0, 0.55))
    assert (shelf.name, ball.name) == ("shelf 1", "shelf 2")
    assert scene.joint_names == ("panda_finger_joint1", "panda_joint1", "panda_joint2")
    assert scene.start_q == pytest.approx([0.035, 0.1, -0.2])
    assert scene.goal_q == pytest.approx(np.array([[0.035, 1.5, 0.7]]))
    (pose,) = scene.other_goal_poses  # an alternative to the goal state
    assert pose.frame == "panda_hand"
    assert pose.position == pytest.approx([0.4, 0.1, 0.6])
    assert pose.rotation == pytest.approx(np.diag([1.0, -1.0, -1.0]))
    assert np.array(pose.tolerances) == pytest.approx(
        np.array([[0.002 / 3**0.5] * 3, [0.05, 0, 0]])  # missing tolerances are zero
    )


def test_one_file_of_a_pair_reads_the_other_one_too(tmp_path: Path) -> None:
    write(tmp_path, scene0001=SCENE, request0001=REQUEST, both=SCENE + REQUEST)
    for name in ("scene0001", "request0001", "both"):
        (scene,) = load_scenes(tmp_path / f"{name}.yaml")
        assert len(scene.obstacles) == 3


def test_robometrics_files_have_several_goal_states_and_a_pose(tmp_path: Path) -> None:
    (scene,) = load_scenes(write(tmp_path, mb_set=ROBOMETRICS) / "mb_set.yaml")
    assert scene.name == "bookshelf_small_panda 0"
    assert scene.goal_q.shape == (2, 7)
    cube, cylinder = scene.obstacles
    xyzw = [0.0, 0.0, -0.5233762232815127, 0.8521017127688338]
    assert turned(*cube.rotation) == pytest.approx(
        scipy.spatial.transform.Rotation.from_quat(xyzw).as_matrix(), abs=1e-12
    )
    assert (cylinder.radius, cylinder.length) == (0.01, 0.14)
    assert scene.goal_pose is not None
    assert scene.goal_pose.rotation == pytest.approx(
        scipy.spatial.transform.Rotation.from_quat([0.5] * 4).as_matrix()
    )


def mpinets_file(path: Path, *, names: str = "quaternions", dtype: str = "f4") -> Path:
    """Write two rows as MPiNets stores them: padding of zeros with invalid quaternions."""
    with h5py.File(path, "w") as file:
        file["cuboid_dims"] = np.array(
            [[[1, 0.5, 0.1], [0.2, 0.2, 0.2]], [[0.3, 0.3, 0.3], [0, 0, 0]]], dtype
        )
        file["cuboid_centers"] = np.array(
            [[[0.6, 0, 0.2], [0.5, 0.4, 0.6]], [[0.5, -0.4, 0.6], [0, 0, 0]]], dtype
        )
        turn = [0.9238795325, 0, 0, 0.3826834324]
        file[f"cuboid_{names}"] = np.array(
            [[turn, [1, 0, 0, 0]], [[1, 0, 0, 0], [0, 0, 0, 0]]], dtype
        )
        file["cylinder_radii"] = np.array([[[0.0]], [[0.05]]], dtype)
        file["cylinder_heights"] = np.array([[[0.0]], [[0.3]]], dtype)
        file["cylinder_centers"] = np.array([[[0, 0, 0]], [[0.4, 0.4, 0.3]]], dtype)
        file[f"cylinder_{names}"] = np.array([[[0, 0, 0, 0]], [[1, 0, 0, 0]]], dtype)
        states = np.linspace(START, START + 0.5, 50)
        file["global_solutions"] = np.stack([states, states[::-1]]).astype(dtype)
    return path


@pytest.mark.parametrize("names", ["quaternions", "quats"])
def test_mpinets_files_are_read_without_their_padding(
    tmp_path: Path, names: str
) -> None:
    first, second = load_scenes(mpinets_file(tmp_path / "train.hdf5", names=names))
    assert [obstacle.kind for obstacle in first.obstacles] == ["box", "box"]
    assert [obstacle.kind for obstacle in second.obstacles] == ["box", "cylinder"]
    assert first.obstacles[0].rotation == pytest.approx((0, 0, np.pi / 4), abs=1e-6)
    assert second.obstacles[1].length == pytest.approx(0.3)
    assert first.start_q == pytest.approx(START, abs=1e-6)
    assert second.goal_q == pytest.approx(START[None], abs=1e-6)
    (only,) = load_scenes(tmp_path / "train.hdf5", start=1, n=1)
    assert only.name == "1"


def same_scene(ours: SceneProblem, other: SceneProblem) -> None:
    assert ours.start_q == pytest.approx(other.start_q, abs=1e-15)
    assert ours.goal_q == pytest.approx(other.goal_q, abs=1e-15)
    rest = {obstacle.name: obstacle for obstacle in other.obstacles}
    assert len(rest) == len(ours.obstacles)
    for mine, its in zip(
        sorted(ours.obstacles, key=lambda item: item.position),
        sorted(rest.values(), key=lambda item: item.position),
        strict=True,
    ):
        assert (mine.kind, mine.size, mine.radius, mine.length) == (
            its.kind,
            its.size,
            its.radius,
            its.length,
        )
        assert mine.position == its.position
        assert turned(*mine.rotation) == pytest.approx(turned(*its.rotation), abs=1e-14)


def test_hdf5_files_are_read_as_written(tmp_path: Path) -> None:
    scenes = [example("a"), replace(example("b"), obstacles=example().obstacles[1:3])]
    save_scenes(tmp_path / "scenes.h5", scenes)
    loaded = load_scenes(tmp_path / "scenes.h5")
    assert [scene.name for scene in loaded] == ["a", "b"]
    for ours, other in zip(scenes, loaded, strict=True):
        same_scene(ours, other)
    before = (tmp_path / "scenes.h5").read_bytes()
    save_scenes(tmp_path / "scenes.h5", scenes)
    assert (tmp_path / "scenes.h5").read_bytes() == before


def test_yaml_folders_are_read_as_written(tmp_path: Path) -> None:
    save_scenes(tmp_path / "scenes", [example(), example()], joints=JOINTS)
    loaded = load_scenes(tmp_path / "scenes")
    assert len(loaded) == 2
    assert loaded[0].joint_names == JOINTS
    assert [obstacle.name for obstacle in loaded[0].obstacles] == [
        "board",
        "wall",
        "can 'A'",
        "ball",
    ]
    same_scene(example(), loaded[0])


def test_writers_refuse_scenes_that_a_format_cannot_hold(tmp_path: Path) -> None:
    capsule = Obstacle(
        name="pill", kind="capsule", position=(0.5, 0.0, 0.5), radius=0.1, length=0.2
    )
    scene = replace(example(), obstacles=(capsule,))
    with is_refused(SceneError):
        save_scenes(tmp_path / "scenes.h5", [scene])
    with is_refused(SceneError):
        save_scenes(tmp_path / "scenes", [scene], joints=JOINTS)
    with is_refused(CnpgenError, argument="path"):
        save_scenes(tmp_path / "scenes.txt", [example()])


BAD_SCENES = {  # damage of the text of a scene -> part of the message
    "orientation: [0, 0, 0, 1]|orientation: [0, 0, 0, 0]": r"scene '0001': obstacle 'Can1'.*quaternion.*zero",
    "dimensions: [0.14, 0.03]|dimensions: [0.14, -0.03]": "scene '0001': obstacle 'Can1'.*sizes must be at least",
    "dimensions: [0.14, 0.03]|dimensions: [0.14, .nan]": "obstacle 'Can1'.*must be a number|obstacle 'Can1'.*finite",
    "dimensions: [0.14, 0.03]|dimensions: [0.14, nan]": "scene '0001': obstacle 'Can1'.*size must be finite",
    "position: [0.9, 0, 1.08]|position: [0.9, 0]": "obstacle 'Can1'.*position must be 3 numbers",
    "position: [0.9, 0, 1.08]|position: [0, 0, 0.02]": "scene '0001': obstacle 'Can1' contains the robot's base",
    "type: cylinder|type: cone": "obstacle 'Can1' is a cone",
    "collision_objects:|collision_objects: &a": "anchor 'a'",
    "name: shelf|name: [shelf": "is not YAML",
    "primitives:|planes: [{}]\n      primitives:": "obstacle 'Can1' has planes, expected primitives or meshes",
    "primitives:|meshes: [{}]\n      primitives:": "obstacle 'Can1' has 1 meshes and 0 poses, expected equal numbers",
    "primitives:|meshes: [{vertices: []}]\n      mesh_poses: [{position: [0, 0, 0], orientation:"
    " [0, 0, 0, 1]}]\n      primitives:": "obstacle 'Can1' is a mesh without vertices",
    "primitives:|meshes: [{vertices: [{x: 0, y: 0, z: 0}, {x: 1, y: 0, z: 0}, {x: 0, y: 1, z: 0}, {x: 0, y: 0, z: 1}],"
    " triangles: [{vertex_indices: [1, 2, 4]}]}]\n      mesh_poses: [{position: [2, 2, 2], orientation: [0, 0, 0, 1]}]"
    "\n      primitives:": "obstacle 'Can1': a triangle has the vertex 4, expected 0 to 3",
}


@pytest.mark.parametrize("damage", BAD_SCENES, ids=range(len(BAD_SCENES)))
def test_an_invalid_scene_is_named_with_file_scene_and_obstacle(
    tmp_path: Path, damage: str
) -> None:
    old, new = damage.split("|")
    assert old in SCENE
    write(tmp_path, scene0001=SCENE.replace(old, new, 1), request0001=REQUEST)
    with pytest.raises(SceneError, match=BAD_SCENES[damage]) as error:
        load_scenes(tmp_path)
    assert "scene0001.yaml" in str(error.value)


def test_requests_must_fit_the_joints(tmp_path: Path) -> None:
    write(
        tmp_path,
        scene0001=SCENE,
        request0001=REQUEST.replace("position: 1.5e0", "position: nan"),
    )
    with is_refused(SceneError):
        load_scenes(tmp_path)
    write(
        tmp_path,
        request0001=REQUEST.replace("joint_name: panda_joint2", "joint_name: elbow"),
    )
    with is_refused(SceneError):
        load_scenes(tmp_path)
    (tmp_path / "request0001.yaml").unlink()
    with is_refused(SceneError):
        load_scenes(tmp_path)


def test_meshes_are_written_for_moveit_and_read_again(tmp_path: Path) -> None:
    rock = make_mesh(
        "rock", 0.1 * CUBE[1:] + 0.2, (0.5, 0.1, 0.3), turned(0.1, 0.2, 0.3)
    )
    joints = tuple(f"joint{index}" for index in range(7))
    q = np.linspace(-0.5, 0.5, 7)
    scene = SceneProblem(
        name="one",
        obstacles=(rock,),
        start_q=q,
        goal_q=q[None] + 0.1,
        joint_names=joints,
    )
    save_scenes(tmp_path / "scenes", [scene])
    (again,) = load_scenes(tmp_path / "scenes")
    before, after = (
        solids_of([each], place_obstacles([each]))[0]
        for each in (rock, again.obstacles[0])
    )
    np.testing.assert_allclose(after.low, before.low, atol=1e-12)
    np.testing.assert_allclose(after.high, before.high, atol=1e-12)
    document = yaml.safe_load(
        next((tmp_path / "scenes").glob("scene*")).read_text(encoding="utf-8")
    )
    (mesh,) = document["world"]["collision_objects"][0]["meshes"]
    vertices = np.array([[each[axis] for axis in "xyz"] for each in mesh["vertices"]])
    a, b, c = (
        vertices[index]
        for index in np.array([each["vertex_indices"] for each in mesh["triangles"]]).T
    )
    volume = (np.cross(a, b) * c).sum() / 6
    assert volume == pytest.approx(
        0.1**3 * (1 - 1 / 6), rel=1e-9
    )  # positive: all triangles face outwards


def test_rotations_of_meshes_are_checked() -> None:
    for arguments, error, text in (
        ({"rotation": 2 * np.eye(3)}, SceneError, "no rotation matrix"),
        ({"position": (0, 0)}, UsageError, r"position must have shape \(3,\)"),
        (
            {"points": np.eye(3, 2)},
            UsageError,
            r"points must have shape \(3, 3\), got \(3, 2\)",
        ),
        (
            {"points": np.nan * CUBE},
            SceneError,
            "obstacle 'rock': points and position must be finite",
        ),
    ):
        with pytest.raises(error, match=text):
            make_mesh(**{"name": "rock", "points": CUBE} | arguments)


def test_meshes_of_moveit_are_hulls_with_composed_poses(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.3, 0], [0, 0, 0.4]])
    inside = [[0.05, 0.05, 0.05]]
    vertices = [
        dict(zip("xyz", map(float, point), strict=True))
        for point in [*corners.tolist(), *inside]
    ]
    wedge = f"""\
    - header: {{frame_id: base_link}}
      id: wedge
      pose: {{position: [1.0, 0, 0], orientation: [0, 0, 1, 0]}}
      meshes: [{{triangles: [], vertices: {vertices}}}]
      mesh_poses: [{{position: [0.5, 0, 0.1], orientation: [0, 0, 0, 1]}}]
"""
    (tmp_path / "scene1.yaml").write_text(SCENE + wedge)
    (tmp_path / "request1.yaml").write_text(REQUEST)
    (scene,) = load_scenes(tmp_path)
    mesh = scene.obstacles[-1]
    assert (mesh.kind, mesh.name) == ("mesh", "wedge")
    (solid,) = solids_of([mesh], place_obstacles([mesh]))
    placed = np.array([1.0, 0, 0]) + (corners + np.array([0.5, 0, 0.1])) * [-1, -1, 1]
    assert solid.low == pytest.approx(placed.min(axis=0))
    assert solid.high == pytest.approx(placed.max(axis=0))


def test_too_many_obstacles_are_refused_before_they_are_built(tmp_path: Path) -> None:
    entry = "\n    - {id: x, primitives: [{type: box, dimensions: [1, 1, 1]}], primitive_poses: [{}]}"
    write(
        tmp_path,
        scene0001="world:\n  collision_objects:" + 2000 * entry,
        request0001=REQUEST,
    )
    with is_refused(SceneError):
        load_scenes(tmp_path)
    with h5py.File(tmp_path / "many.h5", "w") as file:
        file["cuboid_dims"] = np.ones((1, 1_000_000, 3), "f4")
        file["cuboid_centers"] = np.ones((1, 1_000_000, 3), "f4")
        file["cuboid_quaternions"] = np.ones((1, 1_000_000, 4), "f4")
        file["start_q"] = file["goal_q"] = np.zeros((1, 7))
    with is_refused(SceneError):
        load_scenes(tmp_path / "many.h5")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (
            "cuboid_quaternions",
            np.zeros((2, 2, 4)),
            "scene '0': obstacle 'cuboid 0'.*zero",
        ),
        (
            "cuboid_dims",
            -np.ones((2, 2, 3)),
            "scene '0': obstacle 'cuboid 0'.*sizes must be at least",
        ),
        (
            "cuboid_dims",
            np.full((2, 2, 3), np.nan),
            "scene '0': obstacle 'cuboid 0'.*finite",
        ),
        (
            "cuboid_centers",
            np.zeros((2, 2, 3)),
            "scene '0': obstacle 'cuboid 1' contains the robot's base",
        ),
        ("cuboid_centers", np.zeros((3, 2, 3)), "cuboid_centers must have shape"),
        ("cylinder_heights", None, "lacks cylinder_heights"),
        ("global_solutions", None, "has no starts and goals"),
        ("cuboid_centers", np.array(b"text"), "must hold numbers"),
    ],
)
def test_invalid_hdf5_scenes_are_refused(
    tmp_path: Path, name: str, value: np.ndarray | None, message: str
) -> None:
    path = mpinets_file(tmp_path / "train.h5")
    with h5py.File(path, "a") as file:
        del file[name]
        if value is not None:
            file[name] = value
    with pytest.raises((SceneError, DatasetError), match=message):
        load_scenes(path)


def test_documents_of_a_million_brackets_are_refused(tmp_path: Path) -> None:
    for text in ("[" * 1_000_000, "- " * 100_000, "{a: " * 100_000):
        (tmp_path / "deep.yaml").write_text(text)
        # LibYAML, where it is installed, words it in its own way.
        with pytest.raises(
            SceneError, match=r"deep.yaml is (not YAML|nested too deeply)"
        ):
            load_scenes(tmp_path / "deep.yaml")


def test_obstacles_at_the_base_may_be_plates_below_it() -> None:
    def plate(top: float) -> SceneProblem:
        box = make_obstacle(
            "plate",
            "box",
            [1, 1, 0.2],
            np.array([0, 0, top - 0.1]),
            np.array([1, 0, 0, 0]),
            place="",
        )
        return replace(example(), obstacles=(box,))

    assert checked_scene(plate(0.005)).obstacles
    with is_refused(SceneError):
        checked_scene(plate(0.02))
