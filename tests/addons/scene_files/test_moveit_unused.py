"""Every element of MoveIt's messages is used, refused by name, or listed as harmless or unused."""

import copy
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import numpy as np
import pytest

from cnpgen.addons.scene_files.moveit_scenes import read_moveit
from cnpgen.addons.scene_files.moveit_unused import HARMLESS, UNUSED, UNUSED_ELEMENTS
from cnpgen.cli.docs_command import list_pages, page_text
from cnpgen.errors import UsageError
from cnpgen.problems.scenes.scene_problem import SceneProblem, checked_scene
from cnpgen.problems.scenes.scene_reader import ReadingOptions
from cnpgen.robots.obstacle import Obstacle
from cnpgen.scenes import load_scenes
from cnpgen.store.files.accounted import Account, accounted, is_default
from tests.addons.scene_files.moveit_messages import MESSAGES, VALUES, document, header
from tests.refusals import is_refused

FILE = Path("kitchen.yaml")
Place = tuple[str | int, ...]


def texts(value: Any) -> Any:
    """Return a document as YAML is read: all scalars are texts."""
    if isinstance(value, dict):
        return {key: texts(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [texts(entry) for entry in value]
    return None if value == "" else str(value)


def read(content: dict[str, Any], *allowed: str) -> tuple[SceneProblem, Account]:
    options = ReadingOptions(allow_unused=allowed)
    ((scene, account),) = read_moveit({FILE: texts(content)}, options)
    return checked_scene(scene), account


def digest(value: Any) -> Any:
    """Return everything that planner and verdict get of a scene, comparable."""
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = {each.name for each in dataclasses.fields(value)}
        if isinstance(value, SceneProblem | Obstacle):
            names.discard("name")
        return [digest(getattr(value, name)) for name in sorted(names)]
    if isinstance(value, tuple | list):
        return [digest(each) for each in value]
    return value


def fields_of(kind: str, place: Place, depth: int = 0) -> Iterator[tuple[Place, str]]:
    """Yield all fields below a message, with the first entry of every list."""
    for name, type_ in MESSAGES[kind].items():
        inner = type_.removesuffix("[]")
        at: Place = (*place, name, *([0] if type_ != inner else []))
        yield at, inner
        if inner in MESSAGES and depth < 7:
            yield from fields_of(inner, at, depth + 1)


ALL_FIELDS = [*fields_of("PlanningScene", ()), *fields_of("MotionPlanRequest", ())]


def value_at(content: Any, place: Place) -> Any:
    for key in place:
        try:
            content = content[key]
        except (KeyError, IndexError):
            return None
    return content


def changed(content: dict[str, Any], place: Place, value: Any) -> dict[str, Any]:
    """Return a document with another value at a place, whose missing parents are made."""
    result = copy.deepcopy(content)
    at: Any = result
    for key, following in zip(place, [*place[1:], None], strict=True):
        empty: Any = [] if isinstance(following, int) else {}
        if isinstance(at, list) and len(at) <= int(key):
            at.append(empty)
        if following is None:
            at[key] = value
        elif not isinstance(at, list) and not isinstance(at.get(key), type(empty)):
            at[key] = empty
        at = at[key]
    return result


def plain(place: Place) -> str:
    return ".".join(key for key in place if isinstance(key, str))


def is_listed(place: Place) -> bool:
    keys = ["", *plain(place).split(".")]
    ends = [each.split(".") for each in (*HARMLESS, *UNUSED)]
    return any(
        keys[start : start + len(end)] == end
        for end in ends
        for start in range(len(keys) - len(end) + 1)
    )


def outcome(content: dict[str, Any], place: Place, value: Any, usual: Any) -> str:
    """Return the outcome of a value: refused, used, listed, without effect, or lost."""
    before = value_at(content, place)
    try:
        scene, _ = read(changed(content, place, value))
    except UsageError as error:
        refusal = str(error)
    else:
        refusal = ""
    if refusal:
        assert FILE.stem in refusal
        return "refused"
    if digest(scene) != usual:
        return "used"
    if is_listed(place):
        return "listed"
    same = is_default(texts(value)) or texts(value) == texts(before)
    return "without effect" if same else "lost"


EQUIVALENT = {  # values that mean the same as those of the documents, or the elements that they depend on are missing
    "rich": {
        "world.collision_objects.operation": "APPEND to a new object adds it",
        "world.octomap.octomap.data": "more cells that are free",
        "link_padding.link_name": "a padding of 0",
        "link_scale.link_name": "a scale of 1",
        "start_state.multi_dof_joint_state.transforms.rotation.w": "-q is q",
    },
    "plain": {
        "world.collision_objects.operation": "REMOVE of all objects of an empty world",
        "world.octomap": "an octomap without data",
        "fixed_frame_transforms": "a frame without objects",
        "start_state.multi_dof_joint_state.header.frame_id": "a frame without objects",
        "start_state.is_diff": "there is no robot_state to differ from",
    },
}


def test_the_document_of_the_tests_is_read() -> None:
    scene, account = read(document())
    assert len(scene.obstacles) == 6
    assert [each.name for each in scene.request.attached] == ["tool", "cup"]
    assert "group_name" in account.unused
    assert not account.accepted


@pytest.mark.parametrize(
    "root", ["plain", pytest.param("rich", marks=pytest.mark.slow)]
)
def test_every_element_of_the_messages_is_used_refused_or_listed(root: str) -> None:
    content = document() if root == "rich" else minimal()
    usual = digest(read(content)[0])
    counts: dict[str, int] = {}
    lost = []
    for place, kind in ALL_FIELDS:
        for value in VALUES.get(kind, [{}]):
            result = outcome(content, place, value, usual)
            counts[result] = counts.get(result, 0) + 1
            if result == "lost" and not plain(place).startswith(
                tuple(EQUIVALENT[root])
            ):
                lost.append(f"{plain(place)} = {value!r}")
    assert not lost
    assert min(counts["refused"], counts["used"], counts["listed"]) > 10


def pairs_of(count: int, *, seed: int) -> Iterator[list[tuple[Place, Any]]]:
    """Yield pairs of changes: of two fields of one message, or of a field and one in it."""
    random = np.random.default_rng(seed)
    groups: dict[Place, list[tuple[Place, str]]] = {}
    for place, kind in ALL_FIELDS:
        # Fields of a message, and those of the messages in it.
        for depth in range(len(place)):
            if len(place) - depth <= 4:
                groups.setdefault(place[:depth], []).append((place, kind))
    several = [group for group in groups.values() if len(group) > 1]
    for _ in range(count):
        group = several[random.integers(len(several))]
        chosen = random.choice(len(group), 2, replace=False)
        pair = [group[index] for index in sorted(chosen)]
        values = [VALUES.get(kind, [{}]) for _, kind in pair]
        yield [
            (place, options[random.integers(len(options))])
            for (place, _), options in zip(pair, values, strict=True)
        ]


@pytest.mark.parametrize(
    ("root", "count"),
    [("plain", 300), pytest.param("rich", 1000, marks=pytest.mark.slow)],
)
def test_one_of_two_changes_does_not_hide_the_other(root: str, count: int) -> None:
    content = document() if root == "rich" else minimal()
    usual = digest(read(content)[0])
    results, lost = set(), []
    for (first, one), (second, other) in pairs_of(count, seed=4):
        alone = [
            outcome(content, first, one, usual),
            outcome(content, second, other, usual),
        ]
        both = outcome(changed(content, first, one), second, other, usual)
        results.add(both)
        # Two wrong elements may be right together, in a part that is listed.
        if {"used", "refused"} & {*alone} and both in {"lost", "without effect"}:
            lost.append(f"{plain(first)} = {one!r}, {plain(second)} = {other!r}")
    assert results >= ({"refused"} if root == "plain" else {"used", "refused"})
    assert not lost


def minimal() -> dict[str, Any]:
    goal = {"joint_constraints": [{"joint_name": "a", "position": 0.5}]}
    state = {"joint_state": {"name": ["a", "b"], "position": [0.1, 0.2]}}
    world: dict[str, Any] = {"collision_objects": []}
    return {"world": world, "start_state": state, "goal_constraints": [goal]}


def test_a_misspelt_key_is_refused_with_the_nearest_name_at_every_place() -> None:
    content = document()
    for place, _ in ALL_FIELDS:
        if not isinstance(place[-1], str) or value_at(content, place) is None:
            continue
        # Pairs of the matrix are used, others in it are listed.
        if is_listed(place[:-1]) and place[0] != "allowed_collision_matrix":
            continue
        wrong = changed(content, (*place[:-1], f"{place[-1]}q"), "elsewhere")
        with pytest.raises(UsageError, match=rf"unknown element.*{place[-1]}q"):
            read(wrong)
    with pytest.raises(
        UsageError,
        match=r"world\.collison_objects \(did you mean 'collision_objects'\?\)",
    ):
        read(changed(content, ("world", "collison_objects"), []))


@pytest.mark.parametrize(
    ("place", "wrong"),
    [
        (("world", "collision_objects", 0, "primitives", 0, "dimensions"), "dimension"),
        (("start_state", "joint_state", "position"), "positon"),
        (("start_state", "joint_state"), "joint_states"),
    ],
    ids=str,
)
def test_a_misspelt_key_is_named_where_its_absence_is_an_error(place, wrong) -> None:
    content = document()
    values = value_at(content, place[:-1])
    values[wrong] = values.pop(place[-1])
    with is_refused(UsageError, argument=ANY):
        read(content)


OTHER = {  # entry of the tables -> place in the document, and another value
    ".name": (("name",), "cellar"),
    ".object_colors": (("object_colors",), []),
    "header.stamp": (("world", "collision_objects", 0, "header", "stamp"), {"secs": 9}),
    "header.seq": (("world", "collision_objects", 0, "header", "seq"), 7),
    "joint_state.header": (("start_state", "joint_state", "header"), header("map")),
    "multi_dof_joint_state.joint_names": (
        ("start_state", "multi_dof_joint_state", "joint_names"),
        ["floating_base"],
    ),
    ".robot_state.multi_dof_joint_state.header": (
        ("robot_state", "multi_dof_joint_state", "header"),
        header("map"),
    ),
    "path_constraints.name": (("path_constraints", "name"), "none"),
    "octomap.octomap.header": (("world", "octomap", "octomap", "header"), header("x")),
    "collision_objects.type": (("world", "collision_objects", 0, "type"), {"key": "c"}),
    "object.type": (
        ("start_state", "attached_collision_objects", 0, "object", "type"),
        {"key": "c"},
    ),
    "goal_constraints.name": (("goal_constraints", 0, "name"), "other"),
    ".robot_state.is_diff": (("robot_state", "is_diff"), False),
    "meshes.triangles": (
        ("world", "collision_objects", 0, "meshes", 0, "triangles"),
        [{"vertex_indices": [1, 2, 3]}],
    ),
    "constraint_region.primitive_poses.orientation": (
        (
            *("goal_constraints", 1, "position_constraints", 0, "constraint_region"),
            *("primitive_poses", 0, "orientation"),
        ),
        [0, 0, 0, 1],
    ),
    "joint_constraints.weight": (
        ("goal_constraints", 0, "joint_constraints", 0, "weight"),
        0.2,
    ),
    "position_constraints.weight": (
        ("goal_constraints", 1, "position_constraints", 0, "weight"),
        0.2,
    ),
    "orientation_constraints.weight": (
        ("goal_constraints", 1, "orientation_constraints", 0, "weight"),
        0.2,
    ),
    ".allowed_collision_matrix": (
        ("allowed_collision_matrix", "entry_values"),
        [{"enabled": [False, False]}, {"enabled": [False, False]}],
    ),
    ".group_name": (("group_name",), "hand"),
    ".pipeline_id": (("pipeline_id",), "pilz"),
    ".planner_id": (("planner_id",), "LIN"),
    ".num_planning_attempts": (("num_planning_attempts",), 9),
    ".allowed_planning_time": (("allowed_planning_time",), 9),
    ".workspace_parameters": (("workspace_parameters",), {"max_corner": {"x": 9}}),
    ".reference_trajectories": (("reference_trajectories",), []),
    ".cartesian_speed_end_effector_link": (
        ("cartesian_speed_end_effector_link",),
        "base",
    ),
    ".cartesian_speed_limited_link": (("cartesian_speed_limited_link",), "base"),
    ".robot_state.joint_state": (("robot_state", "joint_state", "position"), [9, 9]),
    "joint_state.effort": (("start_state", "joint_state", "effort"), [9, 9]),
    "multi_dof_joint_state.twist": (
        ("start_state", "multi_dof_joint_state", "twist"),
        [],
    ),
    "multi_dof_joint_state.wrench": (
        ("start_state", "multi_dof_joint_state", "wrench"),
        [],
    ),
    "attached_collision_objects.detach_posture": (
        ("start_state", "attached_collision_objects", 0, "detach_posture"),
        {"joint_names": ["x"]},
    ),
}


@pytest.mark.parametrize("entry", [*HARMLESS, *UNUSED])
def test_an_entry_of_the_tables_does_not_change_the_problem(entry: str) -> None:
    content = document()
    place, value = OTHER[entry]
    assert texts(value_at(content, place)) != texts(value)
    usual, other = read(content), read(changed(content, place, value))
    assert digest(other[0]) == digest(usual[0])
    if entry in UNUSED:
        assert entry.lstrip(".") in " ".join(usual[1].unused)


def test_the_docs_print_the_lists() -> None:
    text = page_text(list_pages()["scene-elements"])
    for table in (HARMLESS, UNUSED):
        for key, reason in table.items():
            assert f"- `{key.lstrip('.')}`: {reason}\n" in text


@pytest.mark.parametrize(
    ("place", "value", "text"),
    [
        (("max_cartesian_speed",), 0.2, "max_cartesian_speed is '0.2': the speed of"),
        (("max_velocity_scaling_factor",), 1.5, "above 0 and at most 1"),
        (("max_velocity_scaling_factor",), -0.5, "above 0 and at most 1"),
        (("max_acceleration_scaling_factor",), "nan", "above 0 and at most 1"),
        (
            ("path_constraints", "joint_constraints"),
            [{"joint_name": "hand"}],
            "path_constraints.joint_constraints is a list of 1: give ranges",
        ),
        (
            ("trajectory_constraints", "constraints"),
            [{"name": "x"}],
            "trajectory_constraints is",
        ),
        (
            ("link_padding", 0, "padding"),
            -0.02,
            "link_padding is -0.02: expected 0 to 1 for",
        ),
        (("link_scale", 0, "scale"), 0.9, "link_scale is 0.9: expected 1 to"),
        (("is_diff",), True, "is_diff is 'True': the file must have the whole scene"),
        (
            ("allowed_collision_matrix",),
            {"default_entry_names": ["cup"], "default_entry_values": [True]},
            "allowed_collision_matrix is 'cup and all others'",
        ),
        (("start_state", "is_diff"), False, "detaches them"),
        (
            ("goal_constraints", 1, "position_constraints", 0, "target_point_offset"),
            {"x": 0.1, "y": 0, "z": 0},
            "target_point_offset is a mapping",
        ),
    ],
)
def test_a_refusal_names_the_element_and_can_be_accepted_by_name(
    place: Place, value: Any, text: str
) -> None:
    content = changed(document(), place, value)
    with pytest.raises(UsageError, match=text) as error:
        read(content)
    (key, *_) = [key for key in error.value.remedies.values() if key] or [None]
    if key is None:  # an invalid value, which cannot be accepted
        return
    scene, account = read(content, str(key))
    assert account.accepted == [
        next(each for each in account.accepted if each.endswith(str(key)))
    ]
    assert scene.request.accepted == tuple(account.accepted)


def test_accepted_and_unused_elements_are_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "cnpgen")
    content = changed(document(), ("max_cartesian_speed",), 0.2)
    file = tmp_path / "kitchen.yaml"
    file.write_text(json.dumps(content))  # JSON is YAML
    with is_refused(UsageError, argument="allow_unused"):
        load_scenes(file)
    (scene,) = load_scenes(file, allow_unused=["max_cartesian_speed"])
    assert scene.request.accepted == ("max_cartesian_speed",)
    assert "accepted as unused: max_cartesian_speed" in caplog.text
    assert "not used: allowed_collision_matrix" in caplog.text


def test_unread_elements_are_found_in_lists_and_mappings() -> None:
    account = Account("file", UNUSED_ELEMENTS)
    wrapped = accounted({"a": [{"b": "1", "c": "2"}, {"d": "3"}], "e": {}}, account)
    assert wrapped["a"][0]["b"] == "1"
    with is_refused(UsageError, argument="allow_unused"):
        account.finish(wrapped)


def write(folder: Path, **files: dict[str, Any]) -> Path:
    """Write documents as files of a folder; JSON is YAML."""
    for name, content in files.items():
        (folder / f"{name}.yaml").write_text(json.dumps(content))
    return folder


def test_an_error_of_a_request_names_its_file(tmp_path: Path) -> None:
    content = minimal()
    scene = {"world": content.pop("world")}
    write(tmp_path, scene1=scene, request1=content | {"max_velocity_scale": 0.1})
    with is_refused(UsageError, argument="allow_unused"):
        load_scenes(tmp_path / "scene1.yaml")
    write(tmp_path, scene1=scene | {"nam": "x"}, request1=content)
    with is_refused(UsageError, argument="allow_unused"):
        load_scenes(tmp_path / "request1.yaml")
    request = content | {"max_cartesian_speed": 0.1}
    write(tmp_path, scene1=scene | {"nam": "x"}, request1=request)
    (read,) = load_scenes(tmp_path, allow_unused=["nam", "max_cartesian_speed"])
    assert read.request.accepted == ("nam", "max_cartesian_speed")


@pytest.mark.parametrize("key", ["goal_constraints", "world"])
def test_a_misspelt_key_of_a_whole_part_is_named(tmp_path: Path, key: str) -> None:
    content = minimal()
    content[key[:-1]] = content.pop(key)
    write(tmp_path, kitchen=content)
    for path in (tmp_path, tmp_path / "kitchen.yaml"):
        hint = rf"unknown: {key[:-1]} \(did you mean '{key}'\?\)"
        with pytest.raises(UsageError, match=hint):
            load_scenes(path)


def test_a_start_state_without_a_goal_is_refused(tmp_path: Path) -> None:
    write(tmp_path, a=minimal(), b={"start_state": minimal()["start_state"]})
    with is_refused(UsageError):
        load_scenes(tmp_path)


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("max_cartesian_sped", r"has no 'max_cartesian_sped' \(did you mean"),
        ("group_nam", r"has no 'group_nam' \(did you mean 'group_name'\?\)"),
        ("world", "has no 'world' that is refused"),
        ("max_velocity_scaling_factor", "has no 'max_velocity_scaling_factor'"),
    ],
)
def test_a_key_that_no_scene_needs_is_refused(
    tmp_path: Path, key: str, text: str
) -> None:
    content = minimal() | {"group_name": "arm", "max_cartesian_speed": 0.1}
    file = write(tmp_path, a=content) / "a.yaml"
    allowed = ["max_cartesian_speed", key]
    with pytest.raises(UsageError, match=f"allow_unused must name .*{text}"):
        load_scenes(file, allow_unused=allowed)
    (scene,) = load_scenes(file, allow_unused=allowed[:1], allowed_elsewhere=[key])
    # An element that is only listed needs no acceptance, and may have it.
    load_scenes(file, allow_unused=["max_cartesian_speed", "group_name"])
    assert scene.request.accepted == ("max_cartesian_speed",)


def test_files_of_a_folder_without_scenes_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, a=minimal(), b={"colision_objects": []})
    assert len(load_scenes(tmp_path)) == 1
    assert "b.yaml has no scene and is not used" in caplog.text


def test_keys_that_occur_twice_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text("start_state: {}\nworld: {}\nworld: {}\n")
    with is_refused(UsageError):
        load_scenes(file)
    text = json.dumps(minimal())
    file.write_text(f"{text}\n---\n{text}\n")
    with is_refused(UsageError):
        load_scenes(file)


def test_options_that_no_scene_needs_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = write(tmp_path, a=minimal()) / "a.yaml"
    present = {"a": 0.3, "b": 0.4}
    load_scenes(file, present=present, packages=[tmp_path])
    assert "no scene names a mesh file: the packages are not needed" in caplog.text
    assert "the present state of the robot (start) is not used" in caplog.text
    caplog.clear()
    write(tmp_path, a=minimal() | {"start_state": {}})
    (scene,) = load_scenes(file, present=present)
    assert scene.start_q.tolist() == [0.3, 0.4]
    assert not caplog.text
    with is_refused(UsageError, argument="packages"):
        load_scenes(file, packages=[tmp_path / "none"])


@pytest.mark.parametrize("weight", ["nan", "inf", -1, "much"])
@pytest.mark.parametrize(
    "place",
    [
        ("goal_constraints", 0, "joint_constraints"),
        ("goal_constraints", 1, "position_constraints"),
        ("goal_constraints", 1, "orientation_constraints"),
    ],
    ids=str,
)
def test_a_weight_that_is_no_weight_is_refused(place: Place, weight: Any) -> None:
    with is_refused(UsageError):
        read(changed(document(), (*place, 0, "weight"), weight))


def test_frames_that_are_given_twice_are_refused() -> None:
    place = {"translation": [0, 0, 1], "rotation": [0, 0, 0, 1]}
    frame = {"child_frame_id": "camera", "transform": place}
    with is_refused(UsageError):
        read(minimal() | {"fixed_frame_transforms": [frame, frame]})
    twice = changed(
        document(), ("world", "collision_objects", 0, "subframe_names"), ["a", "a"]
    )
    first = ("world", "collision_objects", 0, "subframe_poses")
    poses = value_at(document(), first) * 2
    with is_refused(UsageError):
        read(changed(twice, first, poses))
