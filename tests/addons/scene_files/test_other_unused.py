"""Every element of robometrics, MPiNets and Avoid Everything files is used, refused or listed."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.scenes.placement import placed_scene
from cnpgen.scenes import (
    SceneError,
    SceneProblem,
    load_scenes,
    observe,
    solve_scenes,
)
from tests.examples.example_robots import needs_robots
from tests.refusals import is_refused

START = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
POSE = [0.5, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0]
PROBLEM: dict[str, Any] = {
    "start": START,
    "goal_ik": [[0.5, *START[1:]]],
    "goal_pose": {
        "frame": "panda_hand",
        "position_xyz": [0.4, 0, 0.4],
        "quaternion_wxyz": [0, 1, 0, 0],
    },
    "obstacles": {
        "cuboid": {"box": {"dims": [0.1, 0.1, 0.1], "pose": POSE}},
        "cylinder": {"can": {"radius": 0.1, "height": 0.2, "pose": POSE}},
        "sphere": {"ball": {"radius": 0.1, "pose": POSE}},
    },
    "world_frame": "panda_link0",
    "collision_buffer_ik": 0.0,
}


def load(folder: Path, problem: dict[str, Any], **options: Any) -> SceneProblem:
    (folder / "set.yaml").write_text(json.dumps({"shelf": [problem]}))
    (scene,) = load_scenes(folder / "set.yaml", **options)
    return scene


def digest(scene: SceneProblem) -> str:
    goal = scene.goal_pose
    ends = [scene.start_q.tolist(), scene.goal_q.tolist()]
    ends += (
        []
        if goal is None
        else [goal.frame, goal.position.tolist(), goal.rotation.tolist()]
    )
    return repr([ends, scene.obstacles, scene.request.obstacle_frames])


def places(content: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the places of all keys of a document."""
    if isinstance(content, list):
        return []
    return [
        each
        for key, value in (content.items() if isinstance(content, dict) else ())
        for each in ((*place, key), *places(value, (*place, key)))
    ]


def with_value(place: tuple[Any, ...], value: Any) -> dict[str, Any]:
    content = copy.deepcopy(PROBLEM)
    at: Any = content
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    return content


@pytest.mark.parametrize("place", places(PROBLEM), ids=".".join)
def test_every_element_of_robometrics_files_is_used_refused_or_listed(
    tmp_path: Path, place: tuple[Any, ...]
) -> None:
    usual = digest(load(tmp_path, PROBLEM))
    for value in (0, -1, 0.3, "nan", "", [], {}, "elsewhere"):
        if place[-1] == "collision_buffer_ik":
            assert digest(load(tmp_path, with_value(place, value))) == usual
            continue
        try:
            assert digest(load(tmp_path, with_value(place, value))) != usual
        except SceneError as error:
            refusal = str(error)
        else:
            continue
        assert "shelf 0" in refusal
    wrong = with_value((*place[:-1], f"{place[-1]}q"), 1)
    if place[:-1] in {(), ("goal_pose",)} or len(place) == 4:
        with is_refused(SceneError, argument="allow_unused"):
            load(tmp_path, wrong)
        key = f"{place[-1]}q"
        assert load(tmp_path, wrong, allow_unused=[key]).request.accepted


@pytest.mark.parametrize("key", ["obstacles", "obstacle"])
@pytest.mark.parametrize("count", [1, 2])
def test_every_problem_of_robometrics_states_its_obstacles(
    tmp_path: Path, key: str, count: int
) -> None:
    without = {name: PROBLEM[name] for name in PROBLEM if name != "obstacles"}
    problems = [*[PROBLEM] * (count - 1), without]
    if key == "obstacle":
        without[key] = PROBLEM["obstacles"]
    (tmp_path / "set.yaml").write_text(json.dumps({"shelf": problems}))
    text = "has no obstacles" if key == "obstacles" else "did you mean 'obstacles'"
    with pytest.raises(SceneError, match=rf"'shelf {count - 1}' .*{text}"):
        load_scenes(tmp_path / "set.yaml")
    without |= {key: {}, "obstacles": {}}
    without.pop("obstacle", None)
    assert load(tmp_path, without).obstacles == ()


@pytest.mark.parametrize("goals", [PROBLEM["goal_ik"], []])
def test_a_goal_pose_of_robometrics_names_its_frame(
    tmp_path: Path, goals: list[list[float]]
) -> None:
    pose = {key: PROBLEM["goal_pose"][key] for key in PROBLEM["goal_pose"]}
    del pose["frame"]
    with is_refused(SceneError):
        load(tmp_path, PROBLEM | {"goal_ik": goals, "goal_pose": pose})


@needs_robots
def test_the_world_frame_of_robometrics_is_a_link_of_the_robot(tmp_path: Path) -> None:
    robot = load_robot(load_problem("panda"))
    start = np.array(START)
    scene = load(tmp_path, PROBLEM)
    usual = load(tmp_path, with_value(("world_frame",), ""))
    assert placed_scene(scene, robot, start).obstacles == usual.obstacles
    other = load(tmp_path, with_value(("world_frame",), "table"))
    with is_refused(SceneError):
        placed_scene(other, robot, start)


@needs_robots
@pytest.mark.parametrize("start", [[], START[:3], [np.nan, *START[1:]]])
def test_frames_of_links_need_a_start_of_the_robot(
    tmp_path: Path, start: list[float]
) -> None:
    robot = load_robot(load_problem("panda"))
    scene = load(tmp_path, with_value(("world_frame",), "panda_link3"))
    text = r"start must have 7 finite joint positions for .*'shelf 0', got \["
    with pytest.raises(UsageError, match=text):
        placed_scene(scene, robot, np.array(start))


@needs_robots
def test_an_empty_start_in_a_file_is_refused(tmp_path: Path) -> None:
    scene = load(tmp_path, with_value(("start",), []) | {"goal_ik": [[]]})
    with is_refused(SceneError):
        solve_scenes("panda", [scene])


@needs_robots
def test_a_goal_pose_beside_goal_states_is_listed_and_names_a_frame(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "cnpgen")
    scene = load(tmp_path, with_value(("goal_pose", "frame"), "panda_hnd"))
    assert "not used: goal_pose" in caplog.text
    with is_refused(SceneError):
        solve_scenes("panda", [scene])


def hdf5(folder: Path, **changes: Any) -> Path:
    columns: dict[str, Any] = {
        "cuboid_dims": np.full((2, 1, 3), 0.1),
        "cuboid_centers": np.full((2, 1, 3), 0.5),
        "cuboid_quaternions": np.tile([1.0, 0, 0, 0], (2, 1, 1)),
        "start_q": np.zeros((2, 7)),
        "goal_q": np.ones((2, 7)),
    } | changes
    file = folder / "scenes.h5"
    with h5py.File(file, "w") as content:
        for name, values in columns.items():
            content[name] = values
    return file


def test_unknown_datasets_of_hdf5_files_are_refused(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "cnpgen")
    usual = [digest(scene) for scene in load_scenes(hdf5(tmp_path))]
    file = hdf5(tmp_path, cilinder_radii=np.ones((2, 1)))
    with is_refused(SceneError, argument="allow_unused"):
        load_scenes(file)
    scenes = load_scenes(file, allow_unused=["cilinder_radii"])
    assert scenes[0].request.accepted == ("cilinder_radii",)
    for seed in range(2):  # the trajectories beside starts and goals change nothing
        file = hdf5(
            tmp_path, global_solutions=np.random.default_rng(seed).random((2, 9, 7))
        )
        assert [digest(scene) for scene in load_scenes(file)] == usual
    assert "not used: global_solutions" in caplog.text


CYLINDERS = {
    "cylinder_radii": np.full((2, 1, 1), 0.1),
    "cylinder_heights": np.full((2, 1, 1), 0.2),
    "cylinder_centers": np.full((2, 1, 3), 0.5),
    "cylinder_quaternions": np.tile([1.0, 0, 0, 0], (2, 1, 1)),
}


@pytest.mark.parametrize(
    "lost", ["cuboid_dims", "cuboid_centers", "cuboid_quaternions", *CYLINDERS]
)
def test_a_part_of_the_datasets_of_a_kind_is_refused(tmp_path: Path, lost: str) -> None:
    file = hdf5(tmp_path, **CYLINDERS)
    assert len(load_scenes(file)[0].obstacles) == 2
    with h5py.File(file, "a") as content:
        del content[lost]
    with is_refused(SceneError):
        load_scenes(file)


def test_centers_without_radii_are_refused(tmp_path: Path) -> None:
    with is_refused(SceneError):
        load_scenes(hdf5(tmp_path, sphere_centers=np.full((2, 1, 3), 0.5)))


@pytest.mark.parametrize("name", ["cuboid_dims", "goal_q"])
def test_a_part_of_a_file_has_equal_numbers_of_rows_too(
    tmp_path: Path, name: str
) -> None:
    rows = np.full((3, 1, 3), 0.1) if name == "cuboid_dims" else np.ones((3, 7))
    with is_refused(SceneError):
        load_scenes(hdf5(tmp_path, **{name: rows}), n=2)


@pytest.mark.parametrize("name", ["cuboid_dims", "cuboid_quaternions", "start_q"])
def test_attributes_of_datasets_are_refused(tmp_path: Path, name: str) -> None:
    file = hdf5(tmp_path)
    with h5py.File(file, "a") as content:
        content[name].attrs["unit"] = "mm"
    with is_refused(SceneError, argument="allow_unused"):
        load_scenes(file)
    scenes = load_scenes(file, allow_unused=["unit"])
    assert scenes[0].request.accepted == (f"{name}.unit",)


def test_observations_need_one_frame(tmp_path: Path) -> None:
    scene = load(tmp_path, PROBLEM)
    assert observe([scene], "tokens")["mask"].sum() == 3
    request = replace(scene.request, obstacle_frames=("a", "b", ""))
    with is_refused(UsageError, argument="scenes"):
        observe([replace(scene, request=request)], "tokens")
