"""Files with one element changed, dropped or misspelt: the difference is refused, listed, or changes the trajectory."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.problems.problem_record import as_record, open_problem
from cnpgen.robots.urdf import urdf_tree
from cnpgen.trajectories import LoadOptions, load_trajectories
from tests.addons.trajectories.test_table_columns import BACKWARDS, DQ, Q, T
from tests.refusals import is_refused

JOINTS = BACKWARDS[::-1]
HEAD = ["t", *JOINTS, *(f"{joint}_velocity" for joint in JOINTS)]
POINTS = [
    {
        "positions": q.tolist(),
        "velocities": dq.tolist(),
        "accelerations": [],
        "effort": [],
        "time_from_start": {"sec": 0, "nanosec": round(1e9 * t)},
    }
    for t, q, dq in zip(T, Q, DQ, strict=True)
]
HEADER = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
MESSAGE = {"header": HEADER, "joint_names": JOINTS, "points": POINTS}
RESULT = {
    "planned_trajectory": {
        "joint_trajectory": MESSAGE,
        "multi_dof_joint_trajectory": {"joint_names": [], "points": []},
    },
    "trajectory_start": {
        "joint_state": {"name": JOINTS, "position": Q[0].tolist()},
        "attached_collision_objects": [],
        "is_diff": False,
    },
    "error_code": {"val": 1, "message": "", "source": ""},
    "planning_time": 0.1,
}
GOAL = {"goal": {"trajectory": MESSAGE}}
STATES = [
    {
        "header": {"stamp": {"sec": 9, "nanosec": round(1e9 * t)}, "frame_id": ""},
        "name": JOINTS,
        "position": q.tolist(),
        "velocity": dq.tolist(),
        "effort": [],
    }
    for t, q, dq in zip(T, Q, DQ, strict=True)
]
COLUMNS = {"t": T.tolist(), "q": Q.tolist(), "joint_names": JOINTS}


def outcome(unchanged: Path, changed: Path) -> str:
    """Return how a changed file is read: "refused", "listed", "changed", or "silent"."""
    before = load_trajectories(unchanged, "airhockey")
    try:
        after = load_trajectories(changed, "airhockey")
    except UsageError:
        return "refused"
    if set(after.ignored) - set(before.ignored):
        return "listed"
    (a,), (b,) = before.trajectories, after.trajectories
    same = [np.array_equal(a.t, b.t), np.array_equal(a.q, b.q)]
    same.append((a.dq is None) == (b.dq is None))
    same.append(a.dq is None or b.dq is None or np.array_equal(a.dq, b.dq))
    return "silent" if all(same) else "changed"


def rename(mapping: dict[str, Any], old: str, new: str) -> None:
    mapping[new] = mapping.pop(old)


def each(key: str, old: str, new: str) -> Callable[[Any], None]:
    def change(document: Any) -> None:
        for entry in document[key] if key else document:
            rename(entry, old, new)

    return change


JSON_CHANGES: list[tuple[str, Any, Callable[[Any], Any], str]] = [
    ("velocities", MESSAGE, each("points", "velocities", "velocites"), "refused"),
    ("a key", MESSAGE, lambda m: m.update(velocity_scaling=0.5), "refused"),
    (
        "a stamp",
        MESSAGE,
        lambda m: rename(m["points"][5]["time_from_start"], "nanosec", "nanosecs"),
        "refused",
    ),
    ("a time", MESSAGE, lambda m: m["points"][5].pop("time_from_start"), "refused"),
    (
        "one point",
        MESSAGE,
        lambda m: rename(m["points"][5], "positions", "q"),
        "refused",
    ),
    ("order", MESSAGE, lambda m: m.update(joint_names=BACKWARDS), "changed"),
    ("code", RESULT, lambda m: rename(m, "error_code", "eror_code"), "refused"),
    ("failure", RESULT, lambda m: m["error_code"].update(val=-2), "refused"),
    ("no value", RESULT, lambda m: m["error_code"].pop("val"), "refused"),
    (
        "attached",
        RESULT,
        lambda m: m["trajectory_start"]["attached_collision_objects"].append({"a": 1}),
        "refused",
    ),
    (
        "attached, misspelt",
        RESULT,
        lambda m: m["trajectory_start"].update(attached_objects=[{"a": 1}]),
        "refused",
    ),
    (
        "base",
        RESULT,
        lambda m: m["planned_trajectory"]["multi_dof_joint_trajectory"].update(
            points=[{}]
        ),
        "refused",
    ),
    (
        "base, misspelt",
        RESULT,
        lambda m: m["planned_trajectory"].update(multi_dof_joint={"points": [{}]}),
        "refused",
    ),
    (
        "base, points misspelt",
        RESULT,
        lambda m: m["planned_trajectory"]["multi_dof_joint_trajectory"].update(
            pionts=[{}]
        ),
        "refused",
    ),
    (
        "base, placed",
        RESULT,
        lambda m: m["trajectory_start"].update(
            multi_dof_joint_state={"joint_names": ["world"]}
        ),
        "listed",
    ),
    (
        "efforts",
        MESSAGE,
        lambda m: [point.update(effort=[1.0] * 6) for point in m["points"]],
        "listed",
    ),
    ("few efforts", MESSAGE, lambda m: m["points"][3].update(effort=[1.0]), "refused"),
    ("state efforts", STATES, lambda m: m[3].update(effort=[1.0] * 6), "listed"),
    ("few in a state", STATES, lambda m: m[3].update(effort=[1.0]), "refused"),
    (
        "start of few joints",
        RESULT,
        lambda m: m["trajectory_start"]["joint_state"]["position"].pop(),
        "refused",
    ),
    (
        "two times",
        MESSAGE,
        lambda m: m["points"][5]["time_from_start"].update(secs=1),
        "refused",
    ),
    (
        "tolerance",
        GOAL,
        lambda m: m["goal"].update(path_tolerance=[{"name": "a"}]),
        "listed",
    ),
    ("scaling", GOAL, lambda m: m["goal"].update(speed=0.5), "refused"),
    ("velocity", STATES, each("", "velocity", "velocty"), "refused"),
    ("a position", STATES, lambda m: m[4].pop("position"), "refused"),
    ("names", STATES, lambda m: [s.update(name=BACKWARDS) for s in m], "changed"),
    ("a second", STATES, lambda m: m[4]["header"]["stamp"].update(sec=10), "refused"),
    ("unit", COLUMNS, lambda m: m.update(unit="deg"), "refused"),
    ("joint_names", COLUMNS, lambda m: rename(m, "joint_names", "joints"), "refused"),
    ("an object", COLUMNS, lambda m: m.update(limits={"a": 1}), "refused"),
]


@pytest.mark.parametrize(
    ("document", "change", "expected"),
    [case[1:] for case in JSON_CHANGES],
    ids=[case[0] for case in JSON_CHANGES],
)
def test_elements_of_messages(
    tmp_path: Path, document: Any, change: Callable[[Any], Any], expected: str
) -> None:
    changed = copy.deepcopy(document)
    change(changed)
    paths = tmp_path / "a.json", tmp_path / "b.json"
    for path, content in zip(paths, (document, changed), strict=True):
        path.write_text(json.dumps(content))
    assert outcome(*paths) == expected


def at(index: int, seconds: int, nanoseconds: int = 0) -> Callable[[Any], None]:
    """Return a change of the time of one point, or with index -1 a shift of all."""

    def change(message: Any) -> None:
        stamps = [point["time_from_start"] for point in message["points"]]
        if index >= 0:
            stamps[index].update(sec=seconds, nanosec=nanoseconds)
            return
        for stamp in stamps:
            stamp["sec"] += seconds

    return change


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (at(-1, -100), "begins at t = -100 s: controllers skip"),
        (at(0, -1), "begins at t = -1 s: controllers skip"),
        (at(-1, 2), "begins at t = 2 s: the motion before"),
        (at(3, -1), "must increase"),
        (at(3, 0, round(1e9 * T[2])), "must increase"),
        (at(3, 0, -5), "must be a time such as"),
        (at(0, 0, -5), "must be a time such as"),
    ],
)
def test_times_before_the_start(
    tmp_path: Path, change: Callable[[Any], None], expected: str
) -> None:
    message = copy.deepcopy(MESSAGE)
    change(message)
    wrapped = {"planned_trajectory": {"joint_trajectory": message}}
    for document in (message, {"goal": {"trajectory": message}}, wrapped):
        path = tmp_path / "a.json"
        path.write_text(json.dumps(document))
        if expected.startswith("begins"):
            notes = load_trajectories(path, "airhockey").notes
            assert any(expected in note for note in notes)
        else:
            with pytest.raises(UsageError, match=expected):
                load_trajectories(path, "airhockey")


@pytest.mark.parametrize("suffix", ["npz", "hdf5"])
def test_times_of_arrays_before_the_start(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    if suffix == "npz":
        np.savez(path, t=T - 1, q=Q)
    else:
        with h5py.File(path, "w") as file:
            file["t"], file["q"] = T - 1, Q
    notes = load_trajectories(path, "airhockey").notes
    assert any("begins at t = -1 s: controllers skip" in note for note in notes)


def test_the_loss_of_an_element_is_accepted_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(MESSAGE | {"velocity_scaling": 0.5}))
    with is_refused(UsageError, argument="allow_unused"):
        load_trajectories(path, "airhockey")
    options = LoadOptions(allow_unused=("velocity_scaling",))
    loaded = load_trajectories(path, "airhockey", options=options)
    assert loaded.ignored == ("velocity_scaling",)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("joint_3_velocity", "joint_3_velocty", "refused"),
        ("joint_2", "jiont_2", "refused"),
        ("t", "tme", "refused"),
        ("t", "t [us]", "changed"),
        ("joint_1", "joint_1 [deg]", "refused"),
        ("joint_5", "joint_4", "refused"),
    ],
)
def test_names_of_columns(tmp_path: Path, old: str, new: str, expected: str) -> None:
    paths = tmp_path / "a.csv", tmp_path / "b.csv"
    rows = np.column_stack([T, Q, DQ])
    for path, name in zip(paths, (old, new), strict=True):
        head = ",".join(name if each == old else each for each in HEAD)
        np.savetxt(path, rows, "%.17g", ",", header=head, comments="")
    assert outcome(*paths) == expected


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda f: f["q"].attrs.update(units="deg"), "changed"),
        (lambda f: f["t"].attrs.update(unit="us"), "changed"),
        (lambda f: f["t"].attrs.update(epoch="1970"), "listed"),
        (lambda f: f.attrs.update(rate=50.0), "listed"),
        (lambda f: f.attrs.update(joint_nams=JOINTS), "refused"),
        (lambda f: f.create_group("scene"), "listed"),
        (lambda f: f.move("q", "q0"), "refused"),
        (lambda f: f.move("t", "tt"), "refused"),
    ],
)
def test_elements_of_hdf5(
    tmp_path: Path, change: Callable[[Any], Any], expected: str
) -> None:
    paths = tmp_path / "a.h5", tmp_path / "b.h5"
    for path in paths:
        with h5py.File(path, "w") as file:
            file["t"], file["q"] = T, Q
            if path is paths[1]:
                change(file)
    assert outcome(*paths) == expected


def test_units_in_the_metadata_of_parquet(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    columns = {"t": T} | dict(zip(JOINTS, Q.T, strict=True))
    plain = pyarrow.table(columns)
    fields = [
        pyarrow.field(name, pyarrow.float64(), metadata={"unit": "deg"})
        if name == "joint_1"
        else pyarrow.field(name, pyarrow.float64())
        for name in columns
    ]
    arrays = [pyarrow.array(values) for values in columns.values()]
    in_fields = pyarrow.table(arrays, schema=pyarrow.schema(fields))
    in_table = plain.replace_schema_metadata({"units": json.dumps({"t": "us"})})
    for table, expected in ((in_fields, "changed"), (in_table, "changed")):
        parquet.write_table(plain, tmp_path / "a.parquet")
        parquet.write_table(table, tmp_path / "b.parquet")
        assert outcome(tmp_path / "a.parquet", tmp_path / "b.parquet") == expected


def test_positions_of_joints_that_are_not_planned(tmp_path: Path) -> None:
    """Arrays of an archive and the file beside exported plans are compared with the problem."""
    for position, expected in ((0.0, "silent"), (0.1, "refused")):
        held = {"held_joint_names": np.array(["joint_7"])}
        held["held_joint_positions"] = np.array([position])
        np.savez(tmp_path / "a.npz", t=T, q=Q)
        np.savez(tmp_path / "b.npz", t=T, q=Q, **held)
        assert outcome(tmp_path / "a.npz", tmp_path / "b.npz") == expected
    folder = tmp_path / "plans"
    folder.mkdir()
    rows = np.column_stack([T, Q])
    head = ",".join(HEAD[:7])
    np.savetxt(folder / "plan_0.csv", rows, "%.17g", ",", header=head, comments="")
    (folder / "held_joints.yaml").write_text('"joint_7": 0.2\n')
    with is_refused(UsageError, argument="path"):
        load_trajectories(folder, "airhockey")


def test_the_json_of_a_verdict_names_what_was_not_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "message.json"
    path.write_text(json.dumps(MESSAGE | {"velocity_scaling": 0.5}), encoding="utf-8")
    words = ["evaluate", str(path), "--problem", "airhockey", "--json"]
    assert main([*words, "--allow-unused", "velocity_scaling"]) in {0, 1}
    assert "velocity_scaling" in json.loads(capsys.readouterr().out)["unused"]


def test_options_that_nothing_needs_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_text(json.dumps(MESSAGE))
    for options, text in (
        ({"allow_unused": ("velocity_scaling",)}, "has no 'velocity_scaling'"),
        ({"separator": ";"}, "separator is for text files"),
        ({"topic": "/a"}, "topic is for bags"),
    ):
        with pytest.raises(UsageError, match=text):
            load_trajectories(file, "airhockey", options=LoadOptions(**options))


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_a_unit_is_refused_where_all_columns_state_theirs(
    tmp_path: Path, unit: Any
) -> None:
    head = ",".join(["t [s]", *(f"{joint} [rad]" for joint in JOINTS)])
    rows = np.column_stack([T, Q])
    path = tmp_path / "a.csv"
    np.savetxt(path, rows, "%.17g", ",", header=head, comments="")
    with is_refused(UsageError, argument="unit"):
        load_trajectories(path, "airhockey", options=LoadOptions(unit=unit))
    head = head.replace("joint_2 [rad]", "joint_2")
    np.savetxt(path, rows, "%.17g", ",", header=head, comments="")
    load_trajectories(path, "airhockey", options=LoadOptions(unit="rad"))


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--plan", "0"], "--plan needs --plot"),
        (
            ["--ignore-velocities", "--velocities", "a,b,c,d,e,f"],
            "--velocities has no effect with --ignore-velocities",
        ),
        (["--unit", "rad"], "--unit is for columns without a unit"),
    ],
)
def test_options_without_effect_on_samples_are_refused(
    tmp_path: Path, words: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    head = ",".join(["t [s]", *(f"{joint} [rad]" for joint in JOINTS)])
    path = tmp_path / "a.csv"
    rows = np.column_stack([T, Q])
    np.savetxt(path, rows, "%.17g", ",", header=head, comments="")
    assert main(["evaluate", str(path), "--problem", "airhockey", *words]) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize("name", ["unit", "joint_names", "note"])
def test_attributes_of_the_names_of_joints_are_refused_or_listed(
    tmp_path: Path, name: str
) -> None:
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        file["t"], file["q"], file["joint_names"] = T, Q, JOINTS
        file["joint_names"].attrs[name] = "deg"
    if name == "note":
        loaded = load_trajectories(path, "airhockey")
        assert loaded.ignored == ("attribute note of joint_names",)
        return
    with is_refused(UsageError, argument="path"):
        load_trajectories(path, "airhockey")


@pytest.mark.parametrize(
    ("changes", "note"),
    [
        ({}, ""),
        ({"position": (Q[0] + 1e-6).tolist()}, ""),
        (
            {"position": (Q[0] + 0.2).tolist()},
            "joint_1 at {0:.6g}, where the motion has {1:.6g}",
        ),
        ({"velocity": [0.5] * 6}, "joint_1 at 0.5, where the motion has 0"),
        (
            {
                "name": [*JOINTS, "claw"],
                "position": [*Q[0].tolist(), 0.0],
                "velocity": [],
            },
            "claw, which is not planned",
        ),
    ],
)
def test_a_start_that_is_not_the_first_point_is_noted(
    tmp_path: Path, changes: dict[str, Any], note: str
) -> None:
    document = copy.deepcopy(RESULT)
    document["trajectory_start"]["joint_state"] |= {
        "velocity": DQ[0].tolist()
    } | changes
    (tmp_path / "a.json").write_text(json.dumps(document))
    notes = load_trajectories(tmp_path / "a.json", "airhockey").notes
    expected = note.format(Q[0, 0] + 0.2, Q[0, 0]).removesuffix(" 0")
    assert any(expected in each for each in notes) == bool(note), notes
    assert any("the start state of the message" in each for each in notes) == bool(note)


def test_the_first_of_several_trajectories_begins_at_the_start(tmp_path: Path) -> None:
    parts = [
        {"joint_trajectory": MESSAGE},
        copy.deepcopy({"joint_trajectory": MESSAGE}),
    ]
    for point in parts[1]["joint_trajectory"]["points"]:
        point["positions"][0] += 0.2
    state = RESULT["trajectory_start"]
    path = tmp_path / "a.json"
    for order, noted in ((parts, False), (parts[::-1], True)):
        document = {"trajectory_start": state, "trajectory": order}
        path.write_text(json.dumps(document))
        notes = load_trajectories(path, "airhockey").notes
        assert any("start state" in note for note in notes) == noted


@pytest.mark.parametrize("model", ["", "iiwa", "fetch"])
def test_a_robot_of_another_name_is_noted(tmp_path: Path, model: str) -> None:
    urdf = open_problem(as_record("airhockey"))[1].urdf_text
    own = urdf_tree(urdf).get("name", "")
    model = model.replace("iiwa", own)
    path = tmp_path / "a.json"
    path.write_text(json.dumps(RESULT | {"model_id": model}))
    notes = load_trajectories(path, "airhockey").notes
    text = f"is for the robot {model!r}, the URDF is that of {own!r}"
    assert any(text in note for note in notes) == (model not in {"", own})


def test_columns_without_a_name_are_listed_by_their_number(tmp_path: Path) -> None:
    lines = [",".join(HEAD) + ","]
    rows = np.column_stack([T, Q, DQ]).tolist()
    lines += [",".join(map(repr, row)) + "," for row in rows]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    loaded = load_trajectories(path, "airhockey")
    assert loaded.ignored == (f"column {len(HEAD) + 1}",)


@pytest.mark.parametrize(
    ("time", "unit", "noted"),
    [("t [s]", "", True), ("t", " [rad]", True), ("t [s]", " [rad]", False)],
)
def test_columns_without_a_unit_are_noted_each(
    tmp_path: Path, time: str, unit: str, noted: bool
) -> None:
    head = ",".join([time, *(f"{joint}{unit}" for joint in JOINTS)])
    path = tmp_path / "a.csv"
    np.savetxt(path, np.column_stack([T, Q]), "%.17g", ",", header=head, comments="")
    notes = load_trajectories(path, "airhockey").notes
    text = "columns without a unit are read in s, rad and m"
    assert any(text in note for note in notes) == noted
    path = tmp_path / "a.json"
    # Messages define their units.
    path.write_text(json.dumps(MESSAGE))
    assert not any(text in note for note in load_trajectories(path, "airhockey").notes)


@pytest.mark.parametrize("kind", ["effort", "jerk"])
def test_efforts_and_jerks_in_a_table_are_listed(tmp_path: Path, kind: str) -> None:
    names = [f"{kind} joint_1", f"joint_2_{kind}"]
    path = tmp_path / "a.csv"
    rows = np.column_stack([T, Q, Q[:, :2]])
    head = ",".join(["t", *JOINTS, *names])
    np.savetxt(path, rows, "%.17g", ",", header=head, comments="")
    assert load_trajectories(path, "airhockey").ignored == tuple(names)
