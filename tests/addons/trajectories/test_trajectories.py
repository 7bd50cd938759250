"""Sampled trajectories: decisions agree with the verdict on plans, files are read, and bad files are located."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.trajectories.smooth_curve import AccelerationLimits, smooth_curve
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.plans import Plans
from cnpgen.plans.export import export_plans
from cnpgen.plans.exporter import sample_plan
from cnpgen.problems.scenes.yaml_document import MAX_YAML_DEPTH, read_yaml
from cnpgen.trajectories import Decision, LoadOptions, Trajectory, load_trajectories
from tests.examples.plan_files import plans_of
from tests.examples.plans import load, perturbed
from tests.refusals import assert_said, is_refused

LABELS = ("hit", "replan", "transport")


def sampled(plans: Plans, rate: float, orders: int) -> list[Trajectory]:
    found = []
    for index in range(len(plans)):
        plan = sample_plan(plans.motion[[index]], rate, index)
        found.append(Trajectory(plan.t, *(plan.q, plan.dq, plan.ddq)[: orders + 1]))
    return found


def decisions(
    plans: Plans, rate: float, orders: int, **options: Any
) -> dict[str, Decision]:
    (verdict,) = cnpgen.evaluate_trajectories(
        plans.problem, sampled(plans, rate, orders), **options
    ).verdicts
    return {name: entry.decision for name, entry in verdict.conditions.items()}


@pytest.mark.parametrize("label", ["hit", "transport"])
def test_a_valid_plan_with_all_derivatives_is_valid(label: str) -> None:
    plans = plans_of(load(label))
    found = cnpgen.evaluate_trajectories(plans.problem, sampled(plans, 500, 2))
    assert found.valid.tolist() == [True]
    judged = cnpgen.evaluate_plans(plans, workers=1).verdicts[0].margins
    for name, entry in found.verdicts[0].conditions.items():
        assert entry.margin.value == pytest.approx(
            judged[name].value, rel=0.02, abs=1e-3
        ), name


@pytest.mark.parametrize("label", ["hit", "transport"])
def test_positions_decide_positions_velocities_and_distances(label: str) -> None:
    found = decisions(plans_of(load(label)), 100, 0, interpolation="linear")
    undecided = {
        name for name, decision in found.items() if decision == Decision.UNDECIDED
    }
    assert undecided == {"joint acceleration", "joint torque"}
    assert {found[name] for name in found.keys() - undecided} == {Decision.VALID}


@pytest.mark.parametrize("label", ["hit", "transport"])
@pytest.mark.parametrize("name", ["joint velocity", "joint acceleration"])
def test_a_limit_that_is_exceeded_by_its_tolerance_and_a_percent_is_never_valid(
    label: str, name: str
) -> None:
    plans = plans_of(load(label))
    margin = cnpgen.evaluate_plans(plans, workers=1).verdicts[0].margins[name]
    wanted = 1 + margin.tolerance / abs(margin.bound) + 0.01
    speed = wanted / abs(margin.value / margin.bound)
    motion = plans.motion.time_scaled(
        1 / (speed if name == "joint velocity" else np.sqrt(speed))
    )
    fast = cnpgen.make_plans(
        plans.problem,
        plans.boundary,
        path_control_points=motion.path,
        rate_control_points=motion.rate,
    )
    jerk = (
        float(
            np.abs(
                motion.at_times(np.linspace(0, motion.duration()[0], 5000)[None]).jerk
            ).max()
        )
        * 1.05
    )
    for options in (
        {},
        {"max_jerk": jerk},
        {"max_jerk": jerk, "noise": 1e-3},
        {"noise": 1e-4},
    ):
        for rate, orders in ((500, 2), (500, 1), (100, 0), (30, 2), (30, 0)):
            found = decisions(fast, rate, orders, **options)
            if (
                (rate > 30 or "max_jerk" in options) and name in found
            ):  # not if another limit is refuted first; at 30 Hz the maximum is between two samples of another curve
                assert found[name] != Decision.VALID, (rate, orders, options)
    assert set(decisions(fast, 500, 2).values()) >= {Decision.INVALID}


@pytest.mark.parametrize("label", LABELS)
@pytest.mark.parametrize(
    "bound", [1.05, 5.0]
)  # of the jerk, relative to the largest one
@pytest.mark.parametrize(
    ("rate", "orders", "noise"),
    [(500, 2, 0.0), (100, 0, 0.0), (30, 0, 1e-3), (30, 2, 5e-5)],
)
def test_no_decision_under_a_bound_of_the_jerk_contradicts_the_plan(
    label: str, rate: float, orders: int, noise: float, bound: float
) -> None:
    plans, random = plans_of(load(label)), np.random.default_rng(0)
    motion = plans.motion
    jerk = (
        float(
            np.abs(
                motion.at_times(np.linspace(0, motion.duration()[0], 5000)[None]).jerk
            ).max()
        )
        * bound
    )
    (exact,) = sampled(plans, rate, orders)
    parts = [part for part in (exact.q, exact.dq, exact.ddq) if part is not None]
    noisy = Trajectory(
        exact.t, *(part + noise * random.uniform(-1, 1, part.shape) for part in parts)
    )
    (verdict,) = cnpgen.evaluate_trajectories(
        plans.problem, [noisy], max_jerk=jerk, noise=noise
    ).verdicts
    truth = cnpgen.evaluate_plans(plans, workers=1).verdicts[0].margins
    assert verdict.conditions
    for name, entry in verdict.conditions.items():
        wrong = Decision.INVALID if truth[name].ok else Decision.VALID
        assert entry.decision != wrong, name


@pytest.mark.parametrize("jerk", [18e3, 40e3])
def test_a_large_error_between_samples_never_proves_a_violation(jerk: float) -> None:
    found = decisions(plans_of(load("replan")), 200, 0, max_jerk=jerk)
    assert Decision.INVALID not in found.values()


def test_a_bound_that_the_samples_contradict_decides_nothing() -> None:
    plans = plans_of(load("hit"))
    (verdict,) = cnpgen.evaluate_trajectories(
        plans.problem, sampled(plans, 100, 0), max_jerk=1.0
    ).verdicts
    assert verdict.decision == Decision.UNDECIDED
    assert (
        verdict.reason
        == "no curve with jerks within the bound passes through the samples"
    )


@pytest.mark.parametrize("label", [*LABELS, "dragging"])
@pytest.mark.parametrize("by", [1e-3, 1e-2, 5e-2])
def test_dense_samples_of_a_perturbed_plan_are_decided_as_the_plan(
    label: str, by: float
) -> None:
    plans = plans_of(perturbed(load(label), by))
    (verdict,) = cnpgen.evaluate_trajectories(
        plans.problem, sampled(plans, 1000, 2)
    ).verdicts
    truth = cnpgen.evaluate_plans(plans, workers=1).verdicts[0].margins
    for name, entry in verdict.conditions.items():
        clear = abs(truth[name].severity - 1) > 0.05
        phase_dependent = (
            name == "table height" and label == "replan"
        )  # samples have no phase of a spline
        unresolved = (
            by > 1e-2 and entry.decision == Decision.UNDECIDED
        )  # accelerations that change within 1 ms
        if clear and not phase_dependent and not unresolved:
            assert entry.decision == (
                Decision.VALID if truth[name].ok else Decision.INVALID
            ), name


def test_the_share_of_time_with_a_violation_is_reported() -> None:
    plans = plans_of(load("transport"))
    (valid,) = sampled(plans, 500, 2)
    tilted = Trajectory(
        valid.t,
        valid.q
        + np.eye(7)[3] * np.sin(np.pi * valid.t / valid.duration)[:, None] * 1.2,
    )
    tilted = Trajectory(4 * tilted.t, tilted.q)  # within the joint limits
    (verdict,) = cnpgen.evaluate_trajectories(plans.problem, [tilted]).verdicts
    tilt = verdict.conditions["tilt"]
    assert (verdict.decision, tilt.decision) == (Decision.INVALID, Decision.INVALID)
    assert tilt.violated_share == pytest.approx(
        1 - 2 * np.arcsin(tilt.margin.tolerance / 1.2) / np.pi, abs=0.01
    )


@pytest.mark.parametrize("last_step", [2e-4, 2e-3])
def test_jerks_are_not_exceeded_by_rounding_in_a_short_last_step(
    last_step: float,
) -> None:
    t = np.append(np.arange(100) * 2e-3, 99 * 2e-3 + last_step)
    jerk = 1000.0
    trajectory = Trajectory(
        t, 1 + jerk * t[:, None] ** 3 / 6, jerk * t[:, None] ** 2 / 2, jerk * t[:, None]
    )
    curve = smooth_curve(
        trajectory, AccelerationLimits(np.array([jerk]), np.array([jerk * 1.0001]))
    )
    assert curve is not None
    assert np.abs(curve.polynomials.jerk - jerk).max() < 0.01 * jerk


@pytest.mark.parametrize(
    ("exponent", "expected"), [(0.2, "invalid"), (1.0, "valid"), (None, "valid")]
)
def test_phases_of_the_samples_decide_a_bound_that_narrows(
    exponent: float | None, expected: str
) -> None:
    plans = plans_of(
        load("hit")
    )  # starts off the table; with the exponent 0.2, it should have reached it at once
    (trajectory,) = sampled(plans, 500, 2)
    share = trajectory.t / trajectory.duration
    trajectory = replace(
        trajectory, phase=None if exponent is None else share**exponent
    )
    (verdict,) = cnpgen.evaluate_trajectories(plans.problem, [trajectory]).verdicts
    assert verdict.conditions["table height"].decision == expected


def test_phases_increase_from_0_to_1() -> None:
    (trajectory,) = sampled(plans_of(load("hit")), 100, 0)
    for phase, message in (
        (trajectory.t, "must increase from 0 to 1, got 0 to"),
        (np.ones(3), "must have shape"),
    ):
        with pytest.raises(UsageError, match=message):
            replace(trajectory, phase=phase)


# Files


@pytest.fixture
def plans() -> Plans:
    return plans_of(load("hit"), load("hit"))


@pytest.mark.parametrize("to", ["npz", "csv", "joint-trajectory"])
def test_exported_plans_are_read_as_they_are(
    plans: Plans, tmp_path: Path, to: str
) -> None:
    out = tmp_path / ("plans.npz" if to == "npz" else to)
    export_plans(plans, out, to=to, rate=500)
    loaded = load_trajectories(out, "airhockey")
    for trajectory, expected in zip(
        loaded.trajectories, sampled(plans, 500, 2), strict=True
    ):
        assert np.allclose(trajectory.t, expected.t, atol=1e-9, rtol=0)
        for name in ("q", "dq", "ddq"):
            found, wanted = getattr(trajectory, name), getattr(expected, name)
            if to == "joint-trajectory":  # the last time is that of a nanosecond
                found, wanted = found[:-1], wanted[:-1]
            assert np.array_equal(found, wanted)
        if to != "joint-trajectory":
            np.testing.assert_array_equal(
                trajectory.phase, plans.motion[[0]].phase_at(expected.t[None])[0]
            )
    kinds = {name.split()[0] for name in loaded.ignored}
    assert kinds == (set() if to == "joint-trajectory" else {"jerk"})
    assert cnpgen.evaluate_trajectories("airhockey", loaded.trajectories).valid.all()


JOINTS = [f"joint_{k}" for k in range(1, 7)]
Q = np.linspace(0, 0.5, 24).reshape(4, 6)
T = np.array([0.0, 0.1, 0.25, 0.3])


def message(order: list[int]) -> dict[str, Any]:
    points = [
        {
            "positions": [*q[order].tolist(), 0.04],
            "time_from_start": {"sec": int(t), "nanosec": round(t % 1 * 1e9)},
        }
        for t, q in zip(T, Q, strict=True)
    ]
    return {"joint_names": [*(JOINTS[k] for k in order), "finger"], "points": points}


def test_messages_are_reordered_and_grippers_are_ignored(tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    order = [3, 1, 0, 5, 4, 2]
    (tmp_path / "ros.json").write_text(json.dumps(message(order)))
    (tmp_path / "moveit.json").write_text(
        json.dumps({"trajectory": [{"joint_trajectory": message(order)}]})
    )
    (tmp_path / "moveit.yaml").write_text(
        yaml.safe_dump({"joint_trajectory": message(order)}) + "---\n"
    )
    for name in ("ros.json", "moveit.json", "moveit.yaml"):
        (trajectory,) = load_trajectories(tmp_path / name, "airhockey").trajectories
        assert np.allclose(trajectory.q, Q)
        assert np.allclose(trajectory.t, T)
        assert trajectory.dq is None


def write_csv(path: Path, heads: list[str], columns: list[np.ndarray]) -> Path:
    rows = [
        ",".join(heads),
        *(",".join(map(str, row)) for row in np.stack(columns, axis=1).tolist()),
    ]
    path.write_text("\n".join(rows))
    return path


def test_a_table_in_degrees_with_a_rate_and_other_names(tmp_path: Path) -> None:
    file = write_csv(
        tmp_path / "a.csv",
        [f"axis{k}" for k in range(6)] + ["grip"],
        [*np.rad2deg(Q).T, T],
    )
    loaded = load_trajectories(
        file,
        "airhockey",
        joints=[f"axis{k}" for k in range(6)],
        options=LoadOptions(unit="deg", rate=10),
    )
    assert np.allclose(loaded.trajectories[0].q, Q)
    assert np.allclose(loaded.trajectories[0].t, np.arange(4) / 10)
    assert loaded.ignored == ("grip",)


def test_a_rate_must_agree_with_the_times_of_the_file(tmp_path: Path) -> None:
    """Otherwise a motion would be judged at another speed."""
    file = write_csv(tmp_path / "a.csv", ["t", *JOINTS], [T, *Q.T])
    rate = 1 / (T[1] - T[0])
    (trajectory,) = load_trajectories(
        file, "airhockey", options=LoadOptions(rate=rate)
    ).trajectories
    assert np.allclose(trajectory.t, T)
    with is_refused(UsageError, argument="rate"):
        load_trajectories(file, "airhockey", options=LoadOptions(rate=2 * rate))
    without = write_csv(tmp_path / "b.csv", ["t", *JOINTS], [0 * T, *Q.T])
    (trajectory,) = load_trajectories(
        without, "airhockey", options=LoadOptions(rate=50)
    ).trajectories
    assert np.allclose(trajectory.t, np.arange(len(T)) / 50)


@pytest.mark.parametrize(
    "pattern", ["{}", "q_{}", "{}_position", "{}.pos", "position {} [deg]"]
)
def test_columns_are_found_by_their_usual_names(tmp_path: Path, pattern: str) -> None:
    values = np.rad2deg(Q) if "deg" in pattern else Q
    heads = [
        "time [ms]",
        *(pattern.format(joint) for joint in JOINTS),
        *(f"vel_{joint}" for joint in JOINTS),
    ]
    file = write_csv(tmp_path / "a.csv", heads, [1e3 * T, *values.T, *(2 * Q).T])
    (trajectory,) = load_trajectories(file, "airhockey").trajectories
    assert np.allclose(trajectory.q, Q)
    assert np.allclose(trajectory.t, T)
    assert trajectory.dq is not None
    assert np.allclose(trajectory.dq, 2 * Q)


def test_times_in_milliseconds_need_their_unit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_csv(tmp_path / "a.csv", ["t", *JOINTS], [1e4 * T, *Q.T])
    assert main(["evaluate", str(file), "--problem", "airhockey"]) == 2
    assert (
        "t has steps of 1e+03 and no unit, and may be in s or ms: all joints are slower"
        in (text := capsys.readouterr().err)
    )
    assert "name the column 't [s]' or 't [ms]'" in text
    for name, factor in (("t [ms]", 1e-3), ("t [s]", 1.0)):
        file.write_text(
            file.read_text().replace(file.read_text().partition(",")[0], name, 1)
        )
        (trajectory,) = load_trajectories(file, "airhockey").trajectories
        assert np.allclose(trajectory.t, factor * 1e4 * T)
    slow = write_csv(tmp_path / "slow.csv", ["t", *JOINTS], [10 * T, *Q.T])
    assert load_trajectories(slow, "airhockey").trajectories[
        0
    ].duration == pytest.approx(3)


def test_a_file_of_neither_plans_nor_trajectories_is_refused_with_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.md").write_text("# Notes")
    for words in (["notes.md"], ["notes.md", "--problem", "airhockey"]):
        assert main(["evaluate", str(tmp_path / words[0]), *words[1:]]) == 2
        assert_said(capsys.readouterr().err)
    assert (
        main(["evaluate", str(tmp_path / "nosuch.csv"), "--problem", "airhockey"]) == 2
    )
    assert_said(capsys.readouterr().err)


def test_a_column_separates_trajectories(tmp_path: Path) -> None:
    heads = ["episode", "t", *JOINTS]
    columns = [np.repeat([7, 3], 4), np.tile(T, 2) + 5, *np.concatenate([Q, -Q]).T]
    loaded = load_trajectories(
        write_csv(tmp_path / "a.csv", heads, columns),
        "airhockey",
        options=LoadOptions(separate_by="episode"),
    )
    first, second = loaded.trajectories
    assert np.allclose(first.q, Q)
    assert np.allclose(second.q, -Q)
    assert np.allclose(second.t, T)
    assert loaded.labels[1].endswith("episode 3.0")


def test_arrays_of_several_trajectories_and_wrapped_angles(tmp_path: Path) -> None:
    turned = Q.copy()
    turned[2:, 0] -= 2 * np.pi
    np.savez(tmp_path / "a.npz", q=np.stack([Q, turned]), t=T)
    loaded = load_trajectories(
        tmp_path / "a.npz", "airhockey", options=LoadOptions(unwrap=True)
    )
    assert [np.allclose(trajectory.q, Q) for trajectory in loaded.trajectories] == [
        True,
        True,
    ]
    assert repr(
        cnpgen.evaluate_trajectories("airhockey", loaded.trajectories)
    ).startswith("<2 trajectories: ")


BAD = {
    "text.csv": (
        "t," + ",".join(JOINTS) + "\n0,0,0,0,0,0,0\n1,x,0,0,0,0,0\n",
        r"line 3: joint_1 must be a number, got 'x'",
    ),
    "short.csv": ("t,joint_1\n0\n", r"line 2 has 1 values"),
    "empty.csv": ("", "is empty"),
    "names.csv": ("t,a,b\n0,1,2\n", "no columns with joint positions"),
    "time.csv": (",".join(JOINTS) + "\n0,0,0,0,0,0\n", "no column of times"),
    "back.csv": (
        "t," + ",".join(JOINTS) + "\n1,0,0,0,0,0,0\n0,0,0,0,0,0,0\n",
        "must increase",
    ),
    "nan.csv": (
        "t," + ",".join(JOINTS) + "\n0,0,0,0,0,0,0\n1,nan,0,0,0,0,0\n",
        "must be finite",
    ),
    "broken.json": ("{", "is not JSON"),
    "number.json": ("3", "expected a JointTrajectory"),
    "points.json": ('{"joint_names": ["a"], "points": []}', "points must be a list"),
    "positions.json": (
        '{"joint_names": ["a"], "points": [{"positions": [1, 2], "time_from_start": 0}]}',
        r"points\[0\]",
    ),
    "stamp.json": (
        '{"joint_names": ["a"], "points": [{"positions": [1]}]}',
        r"points\[0\].time_from_start",
    ),
    "joint.json": (
        '{"joint_names": ["a"], "points": [{"positions": [1], "time_from_start": 0}]}',
        "there is no joint 'joint_1'",
    ),
    "broken.yaml": ("a: [", "is not YAML"),
    "broken.npz": ("PK", "is not an archive"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_refused_with_its_place_and_exit_code_2(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if name.endswith(".yaml"):
        pytest.importorskip("yaml")
    text, expected = BAD[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match=expected) as caught:
        load_trajectories(tmp_path / name, "airhockey")
    assert name in str(caught.value)
    assert main(["evaluate", str(tmp_path / name), "--problem", "airhockey"]) == 2
    assert capsys.readouterr().err.startswith("cnpgen: error: ")


def test_the_command_judges_exported_plans(
    plans: Plans, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export_plans(plans, tmp_path / "out", to="csv", rate=500)
    assert (
        main(["evaluate", str(tmp_path / "out"), "--problem", "airhockey", "--json"])
        == 0
    )
    document = json.loads(capsys.readouterr().out)
    assert (document["valid"], document["invalid"], document["undecided"]) == (2, 0, 0)
    assert (
        document["verdicts"][0]["conditions"]["joint velocity"]["decision"] == "valid"
    )
    words = [
        "evaluate",
        str(tmp_path / "out"),
        "--problem",
        "airhockey",
        "--interpolation",
        "linear",
        "--list",
    ]
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "undecided: joint acceleration: the curve lacks a derivative" in out
    number = r"\d\.\d\de[+-]\d\d"
    either = f"({number} +-|- +{number})"  # margin or violation
    cells = (
        f" +joint velocity +{either}" + r" +\d\.\de-\d\d +rad/s +0 +\d\.\d{4}  joint_\d"
    )
    assert any(
        re.fullmatch(cells, line) for line in out.splitlines()
    )  # one line per condition, with its unit
    assert main(["evaluate", str(tmp_path / "out")]) == 2
    assert_said(capsys.readouterr().err)


def test_positions_in_degrees_are_refused_with_a_suggestion(tmp_path: Path) -> None:
    path = tmp_path / "degrees.csv"
    rows = "".join(f"{t},1,40,0,-30,0,{110 + t}\n" for t in range(4))
    path.write_text(f"t,q1,q2,q3,q4,q5,q6\n{rows}")
    message = r"median position of joint_2 must be from .* 40 deg = 0\.698 rad\? unit='deg' reads degrees"
    with pytest.raises(UsageError, match=message):
        load_trajectories(path, "airhockey")
    (trajectory,) = load_trajectories(
        path, "airhockey", options=LoadOptions(unit="deg")
    ).trajectories
    assert trajectory.q[0, 1] == pytest.approx(np.deg2rad(40))


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [1, 1]\nb: &b [*a, *a]\nt: [0, 1]\nq: *b\n",  # grows exponentially with more levels
        "joint_trajectory: &x {trajectory: *x}\n",  # contains itself
    ],
)
def test_yaml_with_anchors_is_refused(tmp_path: Path, text: str) -> None:
    pytest.importorskip("yaml")
    (tmp_path / "anchors.yaml").write_text(text)
    with is_refused(UsageError, argument="path"):
        load_trajectories(tmp_path / "anchors.yaml", "airhockey")


def test_numbered_columns_of_fewer_joints_are_counted(tmp_path: Path) -> None:
    (tmp_path / "five.csv").write_text("t,q1,q2,q3,q4,q5\n0,0,0,0,0,0\n1,0,0,0,0,0\n")
    with is_refused(UsageError, argument="path"):
        load_trajectories(tmp_path / "five.csv", "airhockey")


@pytest.mark.parametrize("opening", ["[", "{a: "])
def test_yaml_is_nested_to_the_stated_depth(tmp_path: Path, opening: str) -> None:
    """A list and a mapping count as one level each."""
    pytest.importorskip("yaml")
    closing = "]" if opening == "[" else "}"

    def nested(levels: int) -> list[object]:
        (tmp_path / "deep.yaml").write_text(opening * levels + "1" + closing * levels)
        return read_yaml(tmp_path / "deep.yaml")

    assert len(nested(MAX_YAML_DEPTH)) == 1
    with is_refused(UsageError):
        nested(MAX_YAML_DEPTH + 1)


def test_a_damaged_header_of_a_parquet_file_in_a_dataset_of_lerobot_is_an_error(
    tmp_path: Path,
) -> None:
    pytest.importorskip("pyarrow")
    plans = plans_of(load("hit"))
    export_plans(plans, tmp_path / "set", to="lerobot", rate=100)
    (path,) = (tmp_path / "set").glob("data/*/*.parquet")
    content = bytearray(path.read_bytes())
    length = int.from_bytes(content[-8:-4], "little")
    for place in range(len(content) - 8 - length, len(content) - 8, 3):
        content[place] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(
        UsageError, match=r"000.parquet is not a Parquet file, or is dam"
    ):
        load_trajectories(tmp_path / "set", plans.problem)


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_a_file_with_a_stack_of_no_trajectories_is_an_error(
    tmp_path: Path, unit: str
) -> None:
    np.savez(tmp_path / "none.npz", t=np.zeros((0, 5)), q=np.zeros((0, 5, 6)))
    with is_refused(UsageError, argument="path"):
        load_trajectories(
            tmp_path / "none.npz", "airhockey", options=LoadOptions(unit=unit)
        )


def test_a_table_without_rows_is_an_error(tmp_path: Path) -> None:
    np.savez(tmp_path / "none.npz", t=np.zeros(0), q=np.zeros((0, 6)))
    with is_refused(UsageError, argument="path"):
        load_trajectories(tmp_path / "none.npz", "airhockey")


def test_names_in_a_parquet_file_that_are_no_texts_are_an_error(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    table, path = pyarrow.table({"a_column": [1.0, 2.0]}), tmp_path / "table.parquet"
    parquet.write_table(table, path)
    path.write_bytes(path.read_bytes().replace(b"a_column", b"a\xf4column"))
    with is_refused(UsageError, argument="path"):
        load_trajectories(path, "airhockey")
    for names in (b"7", b"[", b"\xf4"):
        parquet.write_table(
            table.replace_schema_metadata({b"cnpgen_joint_names": names}), path
        )
        with is_refused(UsageError, argument="path"):
            load_trajectories(path, "airhockey")


def test_a_payload_of_the_command_line_counts_in_the_torques(
    plans: Plans, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export_plans(plans, tmp_path / "out", to="csv", rate=500)
    words = [
        "evaluate",
        str(tmp_path / "out"),
        "--problem",
        "airhockey",
        "--json",
        "--payload",
    ]
    torques = []
    for payload in ("0.001", "40", "40,0,0,0.3"):
        main([*words, payload])
        conditions = json.loads(capsys.readouterr().out)["verdicts"][0]["conditions"]
        torques.append(conditions["joint torque"]["margin"])
    shares = [abs(margin["value"] / margin["bound"]) for margin in torques]
    assert shares[0] < 1 < shares[1] != shares[2]
    assert main([*words, "-1"]) == 2
    assert_said(capsys.readouterr().err)


@pytest.mark.slow
def test_a_trajectory_is_drawn_with_its_verdict(
    plans: Plans, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export_plans(plans, tmp_path / "out", to="csv", rate=500)
    words = [
        "evaluate",
        str(tmp_path / "out"),
        "--problem",
        "airhockey",
        "--plot",
        str(tmp_path / "drawn.svg"),
    ]
    assert main([*words, "--payload", "40"]) == 1
    assert "drawn: trajectory 0" in capsys.readouterr().err
    picture = (tmp_path / "drawn.svg").read_text()
    assert picture.count("<path") > 100
    assert main([*words, "--plan", "9"]) == 2
    assert "has no trajectory 9" in capsys.readouterr().err
