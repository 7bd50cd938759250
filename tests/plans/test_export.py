"""Exported plans: what robots and simulators read is the plan, up to its last instant."""

import csv
import errno
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans import Plans, save_plans
from cnpgen.plans.export import Exported, export_plans
from cnpgen.plans.exporter import sample_plan
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.schema import registry
from cnpgen.trajectory.spline_motion import Motion
from tests.examples.installed import installed_kind
from tests.plans.test_plans import draw_plans, garbage
from tests.refusals import is_refused

FORMATS = ("npz", "csv", "joint-trajectory")
FIELDS = ("q", "dq", "ddq", "jerk")
JOINTS = [f"joint_{number}" for number in range(1, 7)]  # of the problem airhockey


def read(exported: Exported, form: str) -> dict[int, dict[str, np.ndarray]]:
    """Read what was exported, by the index of the plan."""
    if form == "npz":
        with np.load(exported.files[0]) as data:
            assert data["joint_names"].tolist() == JOINTS
            names = ("t", *FIELDS)
            return {
                index: {name: data[f"plan_{index:05d}_{name}"] for name in names}
                for index in data["plan"].tolist()
            }
    return {
        int(path.stem.removeprefix("plan_")): (
            read_csv if form == "csv" else read_message
        )(path)
        for path in exported.files
    }


def read_csv(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    units = {"q": "rad", "dq": "rad/s", "ddq": "rad/s^2", "jerk": "rad/s^3"}
    columns = [
        f"{name} {joint} [{unit}]" for name, unit in units.items() for joint in JOINTS
    ]
    assert header == ["t [s]", *columns, "path_phase"]
    values = np.array(rows, float)
    return {"t": values[:, 0]} | {
        name: values[:, 1 + 6 * i : 7 + 6 * i] for i, name in enumerate(FIELDS)
    }


def read_message(path: Path) -> dict[str, np.ndarray]:
    message = json.loads(path.read_text(encoding="utf-8"))
    assert set(message) == {"header", "joint_names", "points"}
    assert message["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    assert message["joint_names"] == JOINTS
    stamps = [point["time_from_start"] for point in message["points"]]
    assert all(
        set(stamp) == {"sec", "nanosec"} and 0 <= stamp["nanosec"] < 10**9
        for stamp in stamps
    )
    nanoseconds = np.array(
        [stamp["sec"] * 10**9 + stamp["nanosec"] for stamp in stamps]
    )
    assert np.all(np.diff(nanoseconds) > 0)
    names = {"q": "positions", "dq": "velocities", "ddq": "accelerations"}
    return {"t": nanoseconds / 1e9} | {
        name: np.array([point[key] for point in message["points"]])
        for name, key in names.items()
    }


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("rate", [1000.0, 30.0, 0.1])
def test_every_form_holds_the_plans_as_they_are(
    tmp_path: Path, form: Any, rate: float
) -> None:
    plans = draw_plans(sample_id=np.arange(7) + 40)
    exported = export_plans(plans, tmp_path / "out", to=form, rate=rate)
    assert exported.count == 7
    assert exported.refused == {}
    found = read(exported, form)
    assert list(found) == list(range(7))
    for index, values in found.items():
        t, T = values["t"], plans.duration[index]
        tick = 1e-9 if form == "joint-trajectory" else 0.0
        assert t[0] == 0
        assert T - tick - 1e-15 * T <= t[-1] <= T + 1e-15 * T
        assert np.all(np.diff(t) > 0)
        assert np.allclose(t[:-1], np.arange(len(t) - 1) / rate, atol=1e-9)
        assert 0.009 / rate < t[-1] - t[-2] < 1.0101 / rate
        motion = plans[np.array([index])].motion
        states = motion.at(motion.phase_at(t[None]))
        for name in values.keys() - {"t"}:
            expected = getattr(states, name)[0]
            error = np.abs(values[name] - expected).max()
            assert error <= 1e-12 * np.abs(expected).max(), name
        end, last = plans.boundary, {name: rows[-1] for name, rows in values.items()}
        for name, rate_name, goal, exact in (
            ("q", "dq", end.goal_q, 1e-12),
            ("dq", "ddq", end.goal_dq, 1e-9),
        ):
            moved = 2 * tick * np.abs(last[rate_name]).max()
            assert np.abs(last[name] - goal[index]).max() < exact + moved


def test_npz_says_which_plans_and_samples_there_are(tmp_path: Path) -> None:
    plans = replace(garbage(), sample_id=np.arange(10) * 11)
    exported = export_plans(plans, tmp_path, to="npz")
    assert exported.files == (tmp_path / "plans.npz",)
    with np.load(exported.files[0]) as data:
        assert data["plan"].tolist() == [0, 9]
        assert data["sample_id"].tolist() == [0, 99]
        assert len(data.files) == 5 + 2 * 6


@pytest.mark.parametrize(
    ("name", "held"),
    [
        ("airhockey", {"joint_7": 0.0, "striker_joint_1": 0.0, "striker_joint_2": 0.0}),
        ("heavy-object", {}),
    ],
)
def test_exports_say_where_the_joints_stay_that_are_not_planned(
    tmp_path: Path, name: str, held: dict[str, float]
) -> None:
    plans = draw_plans(problem=load_problem(name), n=2)
    model = pin.buildModelFromXML(plans.problem.urdf)
    planned = set(plans.problem.joint_names)
    assert {each for each in [*model.names][1:] if each not in planned} == set(held)
    with np.load(
        export_plans(plans, tmp_path / "a.npz", to="npz", rate=50).files[0]
    ) as data:
        names, positions = (
            data["held_joint_names"].tolist(),
            data["held_joint_positions"].tolist(),
        )
        assert dict(zip(names, positions, strict=True)) == held
    for form in ("csv", "joint-trajectory"):
        exported = export_plans(plans, tmp_path / form, to=form, rate=50)
        if not held:
            assert exported.held_joints is None
            assert sorted((tmp_path / form).glob("[!.]*")) == sorted(exported.files)
            continue
        assert exported.held_joints == tmp_path / form / "held_joints.yaml"
        lines = exported.held_joints.read_text().splitlines()
        assert json.loads("{" + ",".join(lines) + "}") == held
    assert (
        export_plans(plans, tmp_path / "b.npz", to="npz", rate=50).held_joints is None
    )


@pytest.mark.parametrize("form", FORMATS)
def test_chosen_plans_keep_their_numbers(tmp_path: Path, form: Any) -> None:
    plans = draw_plans()
    every = read(export_plans(plans, tmp_path / "all", to=form, rate=50), form)
    some = read(
        export_plans(plans, tmp_path / "some", to=form, rate=50, only=[5, 2, 5]), form
    )
    assert list(some) == [2, 5]
    for index, values in some.items():
        for name, numbers in values.items():
            assert np.array_equal(numbers, every[index][name])


def test_of_the_plans_that_are_not_chosen_nothing_is_said(tmp_path: Path) -> None:
    exported = export_plans(garbage(), tmp_path, to="csv", rate=50, only=[0, 4])
    assert exported.count == 1
    assert list(exported.refused) == [4]
    for missing in (10, -1):
        with is_refused(UsageError, argument="only"):
            export_plans(garbage(), tmp_path, to="csv", only=[missing])


def test_numbers_in_a_message_are_numbers_to_readers_of_yaml_1_1(
    tmp_path: Path,
) -> None:
    """PyYAML's own expressions for floats and integers: what fits neither is a text to it."""
    is_float = re.compile(
        r"[-+]?(?:[0-9][0-9_]*)\.[0-9_]*(?:[eE][-+][0-9]+)?|\.[0-9][0-9_]*(?:[eE][-+][0-9]+)?"
    )
    is_integer = re.compile(r"[-+]?(?:0|[1-9][0-9_]*)")
    plans = draw_plans(n=2)
    plans = replace(plans, path_control_points=plans.path_control_points * 1e-7)
    plans.path_control_points[0, :4] = 1e-5  # a single digit before the exponent
    exported = export_plans(plans, tmp_path, to="joint-trajectory", rate=200)
    for path in exported.files:
        text = path.read_text(encoding="utf-8")
        assert "e-" in text
        for number in re.findall(
            r"[-+.eE0-9]*[0-9][-+.eE0-9]*", text.partition('"points"')[2]
        ):
            assert is_float.fullmatch(number) or is_integer.fullmatch(number), number
        values = read_message(path)
        index = int(path.stem[-5:])
        sampled = sample_plan(plans.motion[[index]], 200, ticks_per_s=10**9)
        for name in ("q", "dq", "ddq"):
            assert np.array_equal(values[name], getattr(sampled, name))


def test_the_last_sample_is_neither_missing_nor_doubled() -> None:
    for duration in (
        0.5,
        0.5 + 1e-12,
        0.5 - 1e-12,
        0.4999,
        0.500009,
        0.500011,
        1e-5,
        0.001,
    ):
        motion = Motion(np.zeros((1, 15, 1)), np.full((1, 20), 1 / duration))
        sampled = sample_plan(motion, 1000.0)
        assert sampled.t[-1] == motion.duration()[0]
        steps = np.diff(sampled.t)
        assert steps.min() > 0.99e-5
        assert steps.max() < 1.011e-3
        assert len(sampled.q) == len(sampled.t) >= 2


@pytest.mark.parametrize("form", FORMATS)
def test_equal_plans_are_equal_bytes(tmp_path: Path, form: Any) -> None:
    one, two = (
        export_plans(draw_plans(), tmp_path / name, to=form, rate=50)
        for name in ("a", "b")
    )
    assert [path.read_bytes() for path in one.files] == [
        path.read_bytes() for path in two.files
    ]


@pytest.mark.parametrize("form", FORMATS)
def test_plans_that_cannot_be_sampled_are_refused_by_name_and_the_others_are_exported(
    tmp_path: Path, form: Any
) -> None:
    plans = garbage()
    exported = export_plans(plans, tmp_path / "out", to=form, rate=100)
    assert exported.count == 2
    assert list(exported.refused) == list(range(1, 9))
    assert (
        "plan 4 (sample 4): the rate ds/dt is not positive throughout"
        in exported.refused[4]
    )
    assert (
        "plan 1 (sample 1): a boundary condition or a control point is not a finite number"
        in exported.refused[1]
    )
    found = read(exported, form)
    assert list(found) == [0, 9]
    clean = read(
        export_plans(draw_plans(n=10), tmp_path / "clean", to=form, rate=100), form
    )
    for index in (0, 9):
        for name, values in found[index].items():
            assert np.array_equal(values, clean[index][name])


def with_duration(plans: Plans, durations: list[float]) -> Plans:
    rate = plans.rate_control_points.copy()
    for index, duration in enumerate(durations):
        rate[index] *= plans.duration[index] / duration
    return replace(plans, rate_control_points=rate)


def test_plans_of_a_million_samples_or_less_than_a_nanosecond_are_refused(
    tmp_path: Path,
) -> None:
    plans = with_duration(draw_plans(n=5), [1001.0, 1e300, 1e-10, 0.5, 2.0])
    plans.path_control_points[4, 5] = 1e306
    exported = export_plans(plans, tmp_path, to="csv", rate=1000)
    assert [path.name for path in exported.files] == ["plan_00003.csv"]
    assert (
        "it lasts 1e+03 s: more than 1000000 samples at 1000 Hz" in exported.refused[0]
    )
    assert "more than 1000000 samples" in exported.refused[1]
    assert "it lasts 1e-10 s, less than a nanosecond" in exported.refused[2]
    assert "too large to compute with" in exported.refused[4]


@pytest.mark.parametrize("form", FORMATS)
def test_if_no_plan_can_be_exported_nothing_is_written(
    tmp_path: Path, form: Any
) -> None:
    bad = garbage()[np.arange(1, 9)]
    with is_refused(DatasetError):
        export_plans(bad, tmp_path / "out", to=form)
    with is_refused(DatasetError):
        export_plans(bad[np.zeros(8, bool)], tmp_path / "out", to=form)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf, 2e6])
def test_a_rate_that_makes_no_sense_is_refused(tmp_path: Path, rate: float) -> None:
    with is_refused(UsageError, argument="rate"):
        export_plans(draw_plans(), tmp_path, to="csv", rate=rate)


def test_wrong_forms_and_places_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans = draw_plans()
    with is_refused(UsageError, argument="to"):
        export_plans(plans, tmp_path, to="yaml")
    (tmp_path / "file").write_text("x")
    with is_refused(UsageError, argument="out"):
        export_plans(plans, tmp_path / "file", to="csv")

    def full(*_arguments: object, **_options: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    for form in FORMATS:
        with is_refused(MachineError):
            export_plans(plans, tmp_path / f"full-{form}", to=form)


EXPORTER = """
from dataclasses import dataclass
from cnpgen.plugins import Exporter, field
@dataclass(frozen=True)
class Durations(Exporter):
    suffix = ".txt"
    single_file = True
    def write(self, path, plans, exported):
        path.write_text("".join(f"{plan.index} {plan.t[-1]}\\n" for plan in plans))
"""


def test_a_package_adds_a_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans = draw_plans()
    (tmp_path / "durations.py").write_text(EXPORTER)
    with installed_kind(
        tmp_path,
        "durations",
        "durations:Durations",
        monkeypatch,
        group=registry.EXPORTERS,
    ):
        exported = export_plans(plans, tmp_path, to="durations", only=[1, 0])
        with is_refused(UsageError, argument="to"):
            export_plans(plans, tmp_path, to="duration")
    assert exported.files == (tmp_path / "plans.txt",)
    assert (
        exported.files[0].read_text()
        == f"0 {plans.duration[0]}\n1 {plans.duration[1]}\n"
    )


def test_a_format_with_a_file_per_plan_finds_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "separate.py").write_text(EXPORTER.replace("single_file = True", ""))
    with installed_kind(
        tmp_path,
        "separate",
        "separate:Durations",
        monkeypatch,
        group=registry.EXPORTERS,
    ):
        exported = export_plans(
            draw_plans(), tmp_path / "new" / "texts", to="separate", only=[0, 1]
        )
    assert [path.name for path in exported.files] == [
        "plan_00000.txt",
        "plan_00001.txt",
    ]
    assert all(path.is_file() for path in exported.files)


def test_an_exporter_that_writes_nothing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = EXPORTER.partition("        path.write_text")[0]
    (tmp_path / "silent.py").write_text(body + "        pass\n")
    with (
        installed_kind(
            tmp_path,
            "silent",
            "silent:Durations",
            monkeypatch,
            group=registry.EXPORTERS,
        ),
        is_refused(MachineError),
    ):
        export_plans(draw_plans(), tmp_path / "out.txt", to="silent")


def test_an_error_in_a_package_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save_plans(tmp_path / "plans.h5", draw_plans())
    (tmp_path / "failing.py").write_text(
        EXPORTER.replace("plan.t[-1]", "plan.time[-1]")
    )
    with installed_kind(
        tmp_path, "failing", "failing:Durations", monkeypatch, group=registry.EXPORTERS
    ):
        words = [
            "export",
            str(tmp_path / "plans.h5"),
            "--to",
            "failing",
            "-o",
            str(tmp_path / "out.txt"),
        ]
        assert main(words) == MachineError.exit_code
    message = capsys.readouterr().err
    assert (
        "error in the package 'failing': AttributeError: 'SampledPlan' object has no attribute 'time'"
        in message
    )
    assert "please report it" not in message


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "csv",
            "",
            "",
            r"exporter 'csv' is defined more than once: by cnpgen and by csv \(.*:Durations\)",
        ),
        (
            "broken",
            "Exporter, field",
            "Exporters, field",
            "exporter 'broken' of .* cannot be imported: ImportError",
        ),
        (
            "broken",
            "(Exporter)",
            "",
            "is not a subclass of cnpgen.plans.exporter.Exporter",
        ),
        (
            "broken",
            "def write",
            "def save",
            "Durations is abstract, it does not define write",
        ),
        ("broken", 'suffix = ".txt"', "", "Durations must have a suffix and no fields"),
        (
            "broken",
            "single_file = True",
            'single_file: bool = field("?")',
            "must have a suffix and no fields",
        ),
    ],
)
def test_a_broken_format_of_a_package_is_refused(
    name: str,
    old: str,
    new: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    module = tmp_path.name  # unlike those of other tests, which are imported already
    (tmp_path / f"{module}.py").write_text(EXPORTER.replace(old, new, 1))
    with (
        installed_kind(
            tmp_path, name, f"{module}:Durations", monkeypatch, group=registry.EXPORTERS
        ),
        pytest.raises(UsageError, match=message),
    ):
        export_plans(draw_plans(), tmp_path, to=name)


def test_the_highest_rate_still_has_different_stamps(tmp_path: Path) -> None:
    plans = with_duration(draw_plans(n=1), [0.00100049])
    exported = export_plans(plans, tmp_path, to="joint-trajectory", rate=1e6)
    assert len(read_message(exported.files[0])["t"]) in {1001, 1002}


def test_plans_of_robots_with_drives_have_torques_of_joints_and_motors(tmp_path):
    """By Pinocchio with rotors and the exact law of friction; other robots have no such columns."""
    problems = draw_boundary_problems("heavy-object-drive", 1, seed=2)
    plans = Planner("heavy-object-drive").plan_batch(problems.boundary)
    drive, model = (robot := open_problem(plans.problem)[1]).drive, robot.model.copy()
    model.armature = drive.armature
    archive = export_plans(plans, tmp_path / "a.npz", to="npz", rate=50).files[0]
    table = export_plans(plans, tmp_path / "tables", to="csv", rate=50).files[0]
    with np.load(archive) as data:
        q, dq, ddq, joint, motor = (
            data[f"plan_00000_{name}"]
            for name in ("q", "dq", "ddq", "joint_torque", "motor_torque")
        )
    for k in range(len(q)):
        rigid = pin.rnea(robot.model, robot.model.createData(), q[k], dq[k], ddq[k])
        np.testing.assert_allclose(joint[k], rigid, atol=1e-9)
        driven = pin.rnea(model, model.createData(), q[k], dq[k], ddq[k])
        friction = drive.viscous * dq[k] + drive.coulomb * np.sign(dq[k])
        np.testing.assert_allclose(motor[k], driven + friction, atol=1e-9)
    with table.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    first = header.index("motor_torque joint_1 [N m]")
    np.testing.assert_array_equal(np.array(rows, float)[:, first : first + 7], motor)
    rigid_plans = draw_plans()
    with np.load(
        export_plans(rigid_plans, tmp_path / "b.npz", to="npz").files[0]
    ) as data:
        assert not any("torque" in name for name in data)
