"""Tables of other programs: names, times, units and separators, each read in one way or refused."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import h5py
import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.trajectories import (
    LoadedTrajectories,
    LoadOptions,
    Trajectory,
    load_trajectories,
)
from tests.refusals import assert_said, is_refused

READING = {entry.name for entry in fields(LoadOptions)}
HOME = np.array([-0.3, 0.6975, 0, -0.5049, 0, 1.9286])
T = np.arange(0, 0.6001, 0.01)
SHARE = 10 * (T / 0.6) ** 3 - 15 * (T / 0.6) ** 4 + 6 * (T / 0.6) ** 5
Q = HOME + np.outer(0.3 * SHARE, [1, 0, 0, 0, 0, 0])
DQ = np.gradient(Q, T, axis=0)
NAMES = [f"q{k}" for k in range(1, 7)]
BACKWARDS = [f"joint_{k}" for k in range(6, 0, -1)]


def table(
    path: Path,
    names: list[str],
    *columns: np.ndarray,
    mark: str = ",",
    comment: str = "",
) -> Path:
    np.savetxt(
        path,
        np.column_stack(columns),
        delimiter=mark,
        header=mark.join(names),
        comments=comment,
        fmt="%.17g",
    )
    return path


def loaded(path: Path, **given: Any) -> LoadedTrajectories:
    own = {name: given.pop(name) for name in READING & given.keys()}
    return load_trajectories(path, "airhockey", options=LoadOptions(**own), **given)


def only(path: Path, **options: Any) -> Trajectory:
    (trajectory,) = loaded(path, **options).trajectories
    return trajectory


def test_a_label_that_returns_begins_a_new_trajectory(tmp_path: Path) -> None:
    path = tmp_path / "labels.csv"
    lines = ["t,phase," + ",".join(NAMES)]
    for k, label in enumerate(("move", "wait", "move")):
        lines += [
            ",".join([f"{t + 0.61 * k:.6g}", label, *(f"{v:.17g}" for v in row)])
            for t, row in zip(T, Q if k == 0 else Q[::-1], strict=True)
        ]
    path.write_text("\n".join(lines))
    found = loaded(path, separate_by="phase")
    assert [each.duration for each in found.trajectories] == pytest.approx([0.6] * 3)
    assert found.labels[2].endswith("phase move, part 2")


def test_the_arrays_t_and_q_win_over_others_with_their_ending(tmp_path: Path) -> None:
    np.savez(tmp_path / "reference.npz", t=T, q=Q, ref_q=Q + 0.5, ref_t=T)
    found = loaded(tmp_path / "reference.npz")
    assert np.array_equal(found.trajectories[0].q, Q)
    assert set(found.ignored) == {"ref_q", "ref_t"}


@pytest.mark.parametrize("place", ["attribute", "dataset", "both"])
def test_names_of_joints_in_hdf5_determine_the_order(
    tmp_path: Path, place: str
) -> None:
    with h5py.File(tmp_path / "names.h5", "w") as file:
        file["t"], file["q"] = T, Q[:, ::-1]
        if place != "dataset":
            file.attrs["joint_names"] = BACKWARDS
        if place != "attribute":
            file["joint_names"] = np.array(BACKWARDS, dtype=h5py.string_dtype())
    assert np.array_equal(only(tmp_path / "names.h5").q, Q)


def test_two_lists_of_names_in_hdf5_that_differ_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "names.h5", "w") as file:
        file["t"], file["q"] = T, Q
        file.attrs["joint_names"] = BACKWARDS
        file["joint_names"] = np.array(BACKWARDS[::-1], dtype="S8")
    with is_refused(UsageError, argument="path"):
        loaded(tmp_path / "names.h5")


def test_names_that_are_no_texts_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "names.h5", "w") as file:
        file["t"], file["q"], file["joint_names"] = T, Q, np.arange(6)
    with is_refused(UsageError, argument="path"):
        loaded(tmp_path / "names.h5")


def test_repeated_names_are_refused_everywhere(tmp_path: Path) -> None:
    path = table(tmp_path / "j.csv", ["t", *NAMES], T, Q)
    for option in ("joints", "velocities"):
        with is_refused(UsageError, argument=ANY):
            loaded(path, **{option: ["q1", "q2", "q3", "q4", "q5", "q5"]})
    np.savez(tmp_path / "a.npz", t=T, q=Q, joint_names=[*BACKWARDS[:5], "joint_6"])
    with is_refused(UsageError, argument="path"):
        loaded(tmp_path / "a.npz")
    units = ["t", "q1 [rad]", "q1 [deg]", *NAMES[1:]]
    path = table(tmp_path / "units.csv", units, T, Q[:, 0], Q)
    with is_refused(UsageError, argument="path"):
        loaded(path)


def test_seven_numbers_for_six_joints_are_ambiguous(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", ["t", "q0", *NAMES], T, Q[:, 0], Q)
    with is_refused(UsageError, argument="path"):
        loaded(path)
    assert np.array_equal(only(path, joints=NAMES).q, Q)


@pytest.mark.parametrize("comment", ["# ", "% ", "#"])
def test_the_head_of_numpy_is_a_comment(tmp_path: Path, comment: str) -> None:
    path = table(tmp_path / "hash.csv", ["t", *NAMES], T / 2, Q, comment=comment)
    assert only(path).duration == pytest.approx(0.3)
    with is_refused(UsageError, argument="rate"):
        loaded(path, rate=100)


@pytest.mark.parametrize("mark", [",", ";", "\t", " "])
def test_separators_are_found_or_stated(tmp_path: Path, mark: str) -> None:
    path = table(tmp_path / "a.txt", ["t", *NAMES], T, Q, mark=mark)
    assert np.array_equal(only(path).q, Q)
    assert np.array_equal(only(path, separator=mark).q, Q)


def test_columns_without_a_head_are_times_and_joints_or_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    np.savetxt(path, np.column_stack([T, Q]), fmt="%.17g")
    assert np.array_equal(only(path).q, Q)
    assert np.array_equal(only(path).t, T)
    np.savetxt(path, np.column_stack([Q, T, DQ]), fmt="%.17g")
    with is_refused(UsageError, argument="joints"):
        loaded(path)
    numbers = [str(k) for k in range(13)]
    found = only(path, joints=numbers[:6], time="6", velocities=numbers[7:])
    assert np.array_equal(found.q, Q)
    assert np.array_equal(found.dq, DQ)
    assert np.array_equal(found.t, T)


def test_a_number_in_brackets_is_a_name_and_no_unit(tmp_path: Path) -> None:
    names = [f"position[{k}]" for k in range(6)]
    assert np.array_equal(only(table(tmp_path / "a.csv", ["t", *names], T, Q)).q, Q)


def test_columns_of_other_programs_are_named_by_options(tmp_path: Path) -> None:
    positions = [f"actual_q_{k}" for k in range(6)]
    velocities = [f"actual_qd_{k}" for k in range(6)]
    names = ["stamp", *positions, *velocities]
    path = table(tmp_path / "rtde.csv", names, 1e6 * T, Q, DQ, mark=" ")
    found = only(path, joints=positions, velocities=velocities, time="stamp [us]")
    assert np.allclose(found.t, T)
    assert np.array_equal(found.dq, DQ)
    with is_refused(UsageError, argument="time"):
        loaded(path, joints=positions, time="stmp")


def test_a_rate_is_proposed_only_if_no_column_can_be_a_time(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", ["stamp", *NAMES], T, Q)
    with is_refused(UsageError, argument="time"):
        loaded(path)
    path = table(tmp_path / "b.csv", ["row", *NAMES], np.arange(len(T)), Q)
    with is_refused(UsageError, argument="rate"):
        loaded(path)


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_that_may_be_in_two_units_are_refused(
    tmp_path: Path, unit: str, factor: float
) -> None:
    t = T / 4  # 3.1 times the velocity limit, as in a file to be judged
    for glitch in (0.0, 2 * np.pi):
        q = Q.copy()
        q[-10:, 5] += glitch
        path = table(tmp_path / "a.csv", ["t", *NAMES], factor * t, q)
        with is_refused(UsageError, argument="path"):
            loaded(path)
    assert np.allclose(only(path, time=f"t [{unit}]").t, t)
    path = table(tmp_path / "b.csv", [f"t [{unit}]", *NAMES], factor * t, Q)
    assert np.allclose(only(path).t, t)


def test_velocities_decide_the_units_of_all_columns(tmp_path: Path) -> None:
    words = [f"dq{k}" for k in range(1, 7)]

    def path_of(t: float, q: float, dq: float) -> Path:
        return table(tmp_path / "a.csv", ["t", *NAMES, *words], t * T, q * Q, dq * DQ)

    assert only(path_of(1, 1, 1)).duration == pytest.approx(0.6)
    with is_refused(UsageError, argument="path"):
        loaded(path_of(1e3, 1, 1))
    with is_refused(UsageError, argument="path"):
        loaded(path_of(1, 1, 180 / np.pi))
    slow = path_of(1e3, 1, 1e-3)  # a motion of ten minutes
    assert only(slow).duration == pytest.approx(600)


def test_repeated_rows_are_dropped_on_request(tmp_path: Path) -> None:
    rows = np.repeat(np.arange(len(T)), np.where(np.arange(len(T)) % 7 == 3, 2, 1))
    path = table(tmp_path / "a.csv", ["t", *NAMES], T[rows], Q[rows])
    with is_refused(UsageError, argument="path"):
        loaded(path)
    found = loaded(path, drop_repeats=True)
    assert np.array_equal(found.trajectories[0].q, Q)
    assert any("9 repeated rows are dropped" in note for note in found.notes)
    q = Q[rows]
    q[4] += 1e-3
    path = table(tmp_path / "b.csv", ["t", *NAMES], T[rows], q)
    with is_refused(UsageError, argument="path"):
        loaded(path, drop_repeats=True)


@pytest.mark.parametrize(
    ("shift", "note"),
    [
        (0.5, "begins at t = 0.5 s: the motion before its first sample is not known"),
        (-0.5, "begins at t = -0.5 s: controllers skip the samples before 0"),
        (-9.0, "begins at t = -9 s: controllers skip the samples before 0"),
    ],
)
def test_a_first_sample_that_is_not_at_the_start_is_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shift: float, note: str
) -> None:
    path = table(tmp_path / "a.csv", ["t", *NAMES], T + shift, Q)
    main(["evaluate", str(path), "--problem", "airhockey"])
    text = capsys.readouterr().err
    assert note in text
    assert "columns without a unit are read in s, rad and m" in text


def states(order: list[list[int]]) -> list[dict[str, Any]]:
    return [
        {
            "header": {
                "stamp": {
                    "sec": 1_700_000_000 + k // 50,
                    "nanosec": k % 50 * 20_000_000,
                }
            },
            "name": [f"joint_{i + 1}" for i in rows],
            "position": Q[k, rows].tolist(),
            "velocity": DQ[k, rows].tolist(),
            "effort": [],
        }
        for k, rows in enumerate(order)
    ]


@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_the_order_of_joints_may_change_in_a_stream_of_states(
    tmp_path: Path, suffix: str
) -> None:
    random = np.random.default_rng(0)
    messages = states([random.permutation(6).tolist() for _ in T])
    path = tmp_path / f"a.{suffix}"
    if suffix == "json":
        path.write_text(json.dumps(messages))
    else:
        pytest.importorskip("yaml")
        path.write_text("\n---\n".join(json.dumps(each) for each in messages))
    found = only(path)
    assert np.array_equal(found.q, Q)
    assert np.array_equal(found.dq, DQ)
    assert np.allclose(found.t, 0.02 * np.arange(len(T)), atol=1e-12)


def test_a_stream_in_which_joints_come_and_go_is_refused(tmp_path: Path) -> None:
    messages = states([[0, 1, 2, 3, 4, 5]] * 4)
    messages[2]["name"][0] = "finger"
    (tmp_path / "a.json").write_text(json.dumps(messages))
    with is_refused(UsageError, argument="path"):
        loaded(tmp_path / "a.json")


def trajectory_message(count: int = len(T)) -> dict[str, Any]:
    points = [
        {
            "positions": q.tolist(),
            "time_from_start": {"sec": 0, "nanosec": round(1e9 * t)},
        }
        for t, q in zip(T[:count], Q[:count], strict=True)
    ]
    return {"joint_names": BACKWARDS[::-1], "points": points}


@pytest.mark.parametrize(
    "keys",
    [
        ("planned_trajectory", "joint_trajectory"),
        ("goal", "trajectory"),
        ("motion_plan_response", "trajectory", "joint_trajectory"),
        ("result", "planned_trajectory", "joint_trajectory"),
    ],
)
def test_messages_around_a_trajectory_are_read(
    tmp_path: Path, keys: tuple[str, ...]
) -> None:
    message: Any = trajectory_message()
    for key in reversed(keys):
        message = {key: message, "error_code": {"val": 1}}
    (tmp_path / "a.json").write_text(json.dumps(message))
    assert np.allclose(only(tmp_path / "a.json").q, Q)


def test_failed_responses_and_motions_of_a_base_are_refused(tmp_path: Path) -> None:
    path, message = tmp_path / "a.json", {"joint_trajectory": trajectory_message()}
    path.write_text(json.dumps({"trajectory": message, "error_code": {"val": -1}}))
    with is_refused(UsageError, argument="path"):
        loaded(path)
    base = {"points": [{"transforms": []}]}
    path.write_text(json.dumps(message | {"multi_dof_joint_trajectory": base}))
    with is_refused(UsageError, argument="path"):
        loaded(path)


@pytest.mark.parametrize("name", ["names", "joints", "joint_name", "scale", "offset"])
def test_attributes_that_change_the_meaning_of_numbers_are_refused(
    tmp_path: Path, name: str
) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["t"], file["q"] = T, Q
        file["q"].attrs[name] = 2.0
        file["q"].attrs["comment"] = "harmless"
    with is_refused(UsageError, argument="path"):
        loaded(path)
    found = load_trajectories(
        path, "airhockey", options=LoadOptions(allow_unused=(name,))
    )
    assert f"attribute {name} of q" in found.ignored


def test_names_of_joints_beside_one_dataset_determine_the_order(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "names.h5", "w") as file:
        file["t"], file["q"] = T, Q[:, ::-1]
        file["q"].attrs["joint_names"] = BACKWARDS
    assert np.array_equal(only(tmp_path / "names.h5").q, Q)


def unnamed(folder: Path, kind: str) -> Path:
    """Write a table whose columns name no joints."""
    path = folder / f"a.{kind}"
    if kind == "npz":
        np.savez(path, t=T, q=Q)
    elif kind == "hdf5":
        with h5py.File(path, "w") as file:
            file["t"], file["q"] = T, Q
    elif kind == "parquet":
        arrow = pytest.importorskip("pyarrow")
        columns = {"t": T, "q": arrow.array(Q.tolist())}
        pytest.importorskip("pyarrow.parquet").write_table(arrow.table(columns), path)
    else:
        names = ["t", *NAMES] if kind == "csv" else []
        np.savetxt(path, np.column_stack([T, Q]), header=" ".join(names), comments="")
    return path


@pytest.mark.parametrize("kind", ["npz", "hdf5", "parquet", "csv", "txt"])
def test_the_assumed_order_of_columns_without_names_is_stated(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = unnamed(tmp_path, kind)
    words = ["evaluate", str(path), "--problem", "airhockey"]
    assert main(words) in {0, 1}
    text = f"without names of joints are read in the problem's order: {', '.join(BACKWARDS[::-1])}"
    assert text in capsys.readouterr().err
    assert main([*words, "--json"]) in {0, 1}
    assert text in json.loads(capsys.readouterr().out)["notes"][0]
    # Names that the file does not have would be without effect.
    assert main([*words, "--joints", ",".join(BACKWARDS)]) == 2
    assert_said(capsys.readouterr().err)


def test_columns_with_names_or_stated_numbers_have_no_assumed_order(
    tmp_path: Path,
) -> None:
    np.savez(tmp_path / "a.npz", t=T, q=Q, joint_names=BACKWARDS[::-1])
    named = table(tmp_path / "a.csv", ["t", *BACKWARDS[::-1]], T, Q)
    by_number = {"joints": [str(k) for k in range(6)]}
    for notes in (
        loaded(tmp_path / "a.npz").notes,
        loaded(named).notes,
        loaded(unnamed(tmp_path, "hdf5"), **by_number).notes,
    ):
        assert not [note for note in notes if "order" in note]
