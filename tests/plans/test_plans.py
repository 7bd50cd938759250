"""Plans and their file: anybody can write one, what is wrong with it is said, and values are not judged on loading."""

import copy
import json
import pickle
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import h5py
import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import DatasetError, RecipeError, UsageError
from cnpgen.planner.model_file import load_model, save_model
from cnpgen.plans import (
    Plans,
    PlanStatus,
    ProblemRecord,
    concatenate,
    load_plans,
    make_plans,
    record_problem,
    save_plans,
    screen,
)
from cnpgen.plans.boundary_problems import load_boundary_problems
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.export import export_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem, resolved
from cnpgen.problems.problem_file import load_problem
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.robots.plausible_values import UnitError
from cnpgen.store.files.checksum_file import with_checksum
from cnpgen.trajectory.boundary import Boundary, anchor_line, assemble
from tests.examples.plan_files import remove_checksum
from tests.examples.shipped import PROBLEMS
from tests.refusals import is_refused

DOCS = Path(__file__).parents[2] / "docs" / "reference" / "plan-format.md"


@cache
def record() -> ProblemRecord:
    return record_problem(PROBLEMS["airhockey"])


N = 7
ARRAYS = (
    "path_control_points",
    "rate_control_points",
    "sample_id",
    "status",
    "duration",
)


def draw_plans(
    seed: int = 0,
    *,
    n: int = N,
    goal_ddq: bool = False,
    problem: Problem | str = "airhockey",
    **others: Any,
) -> Plans:
    if isinstance(problem, str):
        problem = PROBLEMS[problem]
    numbers = np.random.default_rng(seed)
    joints, spec = len(problem.robot.joints), problem.trajectory
    parts = numbers.uniform(-1, 1, (6, n, joints))
    boundary = Boundary(*parts[:5], parts[5] if goal_ddq else None)
    rate = np.exp(numbers.normal(0.5, 0.2, (n, spec.rate_control_points)))
    path = assemble(boundary, anchor_line(boundary, rate, spec), rate, spec)
    return make_plans(
        problem, boundary, path_control_points=path, rate_control_points=rate, **others
    )


def assert_equal(one: Plans, other: Plans) -> None:
    for name, values in vars(one.boundary).items():
        assert (
            np.array_equal(values, getattr(other.boundary, name), equal_nan=True)
            if values is not None
            else True
        )
        assert (values is None) == (getattr(other.boundary, name) is None)
    for name in (
        "path_control_points",
        "rate_control_points",
        "sample_id",
        "status",
        "duration",
    ):
        assert np.array_equal(
            getattr(one, name), getattr(other, name), equal_nan=True
        ), name
    assert one.columns.keys() == other.columns.keys()
    assert all(
        np.array_equal(values, other.columns[name], equal_nan=True)
        for name, values in one.columns.items()
    )
    assert one.degree == other.degree
    assert one.problem == other.problem


# --- there and back ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("goal_ddq", [False, True])
@pytest.mark.parametrize("name", ["airhockey", "heavy-object"])
def test_plans_come_back_as_they_were(
    tmp_path: Path, name: str, goal_ddq: bool
) -> None:
    problem = PROBLEMS[name]
    columns = {
        "hit_angle": np.linspace(-1, 1, N),
        "puck": np.arange(2.0 * N).reshape(N, 2),
    }
    status = [
        PlanStatus.VALID,
        PlanStatus.INVALID,
        *[PlanStatus.UNKNOWN] * (N - 3),
        PlanStatus.NOT_FORWARD,
    ]
    plans = draw_plans(
        goal_ddq=goal_ddq,
        problem=problem,
        columns=columns,
        sample_id=np.arange(N) * 1000 - 3,
        status=status,
    )
    save_plans(tmp_path / "deep" / "plan.h5", plans)
    found = load_plans(tmp_path / "deep" / "plan.h5", problem=problem)
    assert_equal(found, plans)
    assert sorted(found.columns) == ["goal_xyz", "hit_angle", "puck", "start_xyz"]
    assert [item.name for item in (tmp_path / "deep").iterdir()] == ["plan.h5"]


def test_equal_plans_are_equal_bytes_whatever_the_order_of_columns_and_the_folder(
    tmp_path: Path,
) -> None:
    columns = {"b": np.zeros(N), "a": np.ones(N)}
    plans, turned = (
        draw_plans(columns=dict(items))
        for items in (columns.items(), [*columns.items()][::-1])
    )
    for name, item in (
        ("one.h5", plans),
        ("two.h5", turned),
        ("sub/three.h5", load_after(tmp_path, plans)),
    ):
        save_plans(tmp_path / name, item)
    assert (tmp_path / "one.h5").read_bytes() == (tmp_path / "two.h5").read_bytes()
    assert (tmp_path / "one.h5").read_bytes() == (
        tmp_path / "sub" / "three.h5"
    ).read_bytes()
    assert str(tmp_path).encode() not in (tmp_path / "one.h5").read_bytes()


def load_after(folder: Path, plans: Plans) -> Plans:
    save_plans(folder / "saved.h5", plans)
    return load_plans(folder / "saved.h5")


def test_a_file_needs_no_other_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "mine"
    shutil.copytree(PROBLEMS["airhockey"].path.parent, folder)
    text = (
        (folder / "problem.toml")
        .read_text(encoding="utf-8")
        .replace('name = "airhockey"', 'name = "mine"')
    )
    (folder / "problem.toml").write_text(
        text.replace("velocity_scale = 0.8", "velocity_scale = 0.7"), encoding="utf-8"
    )
    problem = load_problem(folder / "problem.toml")
    plans = draw_plans(problem=problem)
    save_plans(tmp_path / "plan.h5", plans)
    shutil.rmtree(folder)
    found = load_plans(tmp_path / "plan.h5")
    with found.problem.restored() as restored:
        robot = load_robot(restored)
        assert restored.name == "mine"
        assert np.allclose(robot.velocity_limit, 0.7 * robot.rated_velocity)
        assert resolved(restored) == resolved(
            replace(problem, robot=replace(problem.robot, urdf="robot.urdf"))
        )
    assert found.problem.comparable_sha256 == plans.problem.comparable_sha256
    with is_refused(DatasetError):
        load_plans(tmp_path / "plan.h5", problem="airhockey")


def test_no_plans_at_all_are_a_file_too(tmp_path: Path) -> None:
    none = draw_plans()[np.zeros(N, bool)]
    assert len(none) == 0
    assert len(load_after(tmp_path, none)) == 0
    assert screen(none).shape == (0,)


def test_every_dataset_says_what_it_is(tmp_path: Path) -> None:
    save_plans(tmp_path / "plan.h5", draw_plans(columns={"hit_speed": np.ones(N)}))
    with h5py.File(tmp_path / "plan.h5") as file:
        units = {name: item.attrs["units"].decode() for name, item in file.items()}
        assert units["start_ddq"] == "rad/s^2"
        assert units["rate_control_points"] == "1/s"
        assert units["hit_speed"] == "m/s"
        assert json.loads(file["goal_q"].attrs["names"]) == list(
            PROBLEMS["airhockey"].robot.joints
        )
        assert file["goal_xyz"].attrs["frame"] == b"world"
        assert file["duration"].dtype == "<f8"
        assert file["status"].dtype == "u1"
        assert file.attrs["format"] == b"cnpgen-plans"
        assert file.attrs["problem"] == b"airhockey"
        assert file.attrs["problem_sha256"].decode() == record().comparable_sha256


# --- files of others --------------------------------------------------------------------------------------------------


def test_ten_lines_of_any_trainer_write_a_valid_file(tmp_path: Path) -> None:
    block = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.S)[
        0
    ]
    assert "cnpgen" not in block
    assert sum(bool(line.strip()) for line in block.splitlines()) <= 10
    subprocess.run([sys.executable, "-c", block], cwd=tmp_path, check=True)
    plans = load_plans(tmp_path / "written.h5", problem="airhockey")
    assert len(plans) == 8
    assert plans.sample_id.tolist() == list(range(8))
    assert not plans.status.any()
    assert plans.degree == 7
    assert np.allclose(plans.duration, 1 / np.linspace(0.5, 1, 8))
    robot = load_robot(PROBLEMS["airhockey"])
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, plans.boundary.goal_q[3])
    tip = data.oMf[robot.model.getFrameId(robot.tip)].translation
    assert np.abs(plans.columns["goal_xyz"][3] - tip).max() < 1e-14
    ends = plans.motion.at(np.array([0.0, 1.0]))
    assert np.abs(ends.q[:, 0] - plans.boundary.start_q).max() < 1e-15
    assert np.abs(ends.dq).max() < 1e-12


def write_minimal(path: Path, **changes: Any) -> Path:
    """Write the least that is a plan file, with changes: name -> values, None to leave a dataset out."""
    content: dict[str, Any] = {
        name: np.zeros((3, 6))
        for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
    }
    content |= {
        "path_control_points": np.zeros((3, 15, 6)),
        "rate_control_points": np.ones((3, 20)),
    }
    attributes = {"problem": "airhockey"} | changes.pop("attributes", {})
    with h5py.File(path, "w") as file:
        for name, values in (content | changes).items():
            if values is not None:
                file[name] = values
        file.attrs.update(
            {name: value for name, value in attributes.items() if value is not None}
        )
    return path


def test_other_float_types_and_sizes_are_welcome(tmp_path: Path) -> None:
    path = write_minimal(
        tmp_path / "a.h5",
        start_q=np.full((3, 6), 0.1, np.float32),
        path_control_points=np.zeros((3, 30, 6), ">f8"),
        rate_control_points=np.ones((3, 12), np.float16),
        sample_id=np.array([5, 6, 7], np.uint16),
        attempts=np.array([1, 2, 3]),
        attributes={"degree": np.int32(5), "note": "mine", "weights": [1.0, 2.0]},
    )
    with h5py.File(path, "a") as file:
        file["log/loss"] = np.zeros(1000)
    plans = load_plans(path)
    assert plans.degree == 5
    assert plans.path_control_points.dtype == plans.boundary.start_q.dtype == np.float64
    assert plans.boundary.start_q[0, 0] == np.float32(0.1)
    assert plans.sample_id.tolist() == [5, 6, 7]
    assert plans.columns["attempts"].tolist() == [1, 2, 3]
    assert_equal(load_after(tmp_path, plans), plans)


def test_a_problem_beside_the_file_or_in_the_call(tmp_path: Path) -> None:
    shutil.copytree(PROBLEMS["heavy-object"].path.parent, tmp_path / "heavy")
    fields = {
        name: np.zeros((3, 7))
        for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
    }
    fields |= {"path_control_points": np.zeros((3, 15, 7))}
    beside = write_minimal(
        tmp_path / "a.h5", **fields, attributes={"problem": "heavy/problem.toml"}
    )
    missing = write_minimal(tmp_path / "b.h5", **fields, attributes={"problem": None})
    assert load_plans(beside).problem.name == "heavy-object"
    assert (
        load_plans(beside, problem="heavy-object").problem.comparable_sha256
        == record_problem(PROBLEMS["heavy-object"]).comparable_sha256
    )
    assert load_plans(
        missing, problem=PROBLEMS["heavy-object"]
    ).problem == record_problem(PROBLEMS["heavy-object"])
    with is_refused(UsageError, argument="problem"):
        load_plans(missing)


def test_tolerances_of_the_call_count_and_do_not_make_another_problem(
    tmp_path: Path,
) -> None:
    save_plans(tmp_path / "plan.h5", draw_plans())
    loose = replace(
        PROBLEMS["airhockey"],
        name="loose",
        constraint=tuple(
            replace(item, tolerance=0.5, budget=1.0)
            for item in PROBLEMS["airhockey"].constraint
        ),
    )
    plans = load_plans(tmp_path / "plan.h5", problem=loose)
    with plans.problem.restored() as problem:
        assert all(item.tolerance == 0.5 for item in problem.constraint)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (
            lambda p: replace(p, limits=replace(p.limits, torque_scale=0.5)),
            "limits.torque_scale",
        ),
        (lambda p: replace(p, robot=replace(p.robot, tip="F_link_6")), "robot.tip"),
        (
            lambda p: replace(p, constraint=p.constraint[:-2] + p.constraint[-1:]),
            "constraint.table",
        ),
    ],
)
def test_another_problem_s_file_is_refused(
    tmp_path: Path, change: Callable[[Any], Any], key: str
) -> None:
    save_plans(tmp_path / "plan.h5", draw_plans())
    with pytest.raises(
        DatasetError,
        match=rf"plan\.h5 has plans of problem 'airhockey'.*they differ in {key}$",
    ):
        load_plans(tmp_path / "plan.h5", problem=change(PROBLEMS["airhockey"]))
    with is_refused(DatasetError):
        load_plans(tmp_path / "plan.h5", problem="heavy-object")


def test_constraints_of_one_kind_all_count() -> None:
    once = json.loads(record().recipe)
    table = next(each for each in once["constraint"] if each["use"] == "table")
    twice, others = (
        once | {"constraint": [*once["constraint"], table | {"x": x}]}
        for x in (table["x"], [0.9, 1.0])
    )
    narrow = once | {"constraint": [table | {"x": [0.9, 1.0]}, *once["constraint"]]}
    records = [
        ProblemRecord(json.dumps(each), record().urdf)
        for each in (once, twice, others, narrow)
    ]
    assert len({record.comparable_sha256 for record in records}) == 4
    assert records[1].differences(records[2]) == ["constraint.table 2.x"]


def test_another_robot_file_is_another_problem() -> None:
    other = ProblemRecord(record().recipe, record().urdf.replace("iiwa14", "iiwa15", 1))
    assert other.urdf != record().urdf
    assert record().differences(other) == ["robot.urdf"]
    renamed = json.loads(record().recipe) | {
        "name": "x",
        "title": "y",
        "trajectory": {"degree": 5},
    }
    assert (
        ProblemRecord(json.dumps(renamed), record().urdf).comparable_sha256
        == record().comparable_sha256
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start_dq": None}, "lacks start_dq: plans need start_q, start_dq"),
        ({"goal_dq": None, "goal_xyz": np.zeros((3, 3))}, "lacks goal_dq: plans need"),
        (
            {"goal_dqq": np.zeros((3, 6))},
            r"'goal_dqq' is almost 'goal_ddq', which the file lacks",
        ),
        (
            {"rate_control_points": None, "rate_control_pionts": np.ones((3, 20))},
            r"did you mean 'rate_control_pionts'",
        ),
        (
            {"start_q": np.zeros((3, 7))},
            r"start_q must have shape \(3, 6\) .* got \(3, 7\)",
        ),
        ({"goal_q": np.zeros((2, 6))}, r"goal_q must have shape \(3, 6\)"),
        ({"goal_dq": np.zeros(6)}, r"goal_dq must have shape \(3, 6\)"),
        ({"goal_ddq": np.zeros((3, 5))}, r"goal_ddq must have shape \(3, 6\)"),
        (
            {"path_control_points": np.zeros((3, 90))},
            r"path_control_points must have shape \(N, C, n\), got \(3, 90\)",
        ),
        (
            {"path_control_points": np.zeros((3, 15, 7))},
            "has 7 joints, but 'airhockey' plans 6",
        ),
        ({"path_control_points": np.zeros((3, 8, 6))}, "at least 9 of degree 7"),
        (
            {"path_control_points": 1.0},
            r"path_control_points must have shape \(N, C, n\)",
        ),
        (
            {"rate_control_points": np.zeros((3, 7))},
            r"rate_control_points must have shape \(3, R\) with R > 7",
        ),
        (
            {"rate_control_points": np.zeros((3, 20, 1))},
            r"rate_control_points must have shape \(3, R\)",
        ),
        ({"duration": np.zeros(4)}, r"duration must have shape \(3,\), got \(4,\)"),
        ({"sample_id": np.zeros((3, 1), int)}, r"sample_id must have shape \(3,\)"),
        ({"status": np.zeros(2, int)}, r"status must have shape \(3,\), got \(2,\)"),
        ({"start_xyz": np.zeros((3, 2))}, r"start_xyz must have shape \(3, 3\)"),
        (
            {"loss": np.zeros(1000)},
            r"loss must have shape \(3,\) or \(3, w\), got \(1000,\)",
        ),
        ({"loss": np.zeros((3, 2, 2))}, r"loss must have shape \(3,\) or \(3, w\)"),
        ({"loss": 0.5}, r"loss must have shape \(3,\)"),
        ({"start_q": np.zeros((3, 6), int)}, "start_q must hold floats, got int64"),
        (
            {"start_q": np.zeros((3, 6), complex)},
            "start_q must hold numbers, got complex128",
        ),
        ({"start_q": np.full((3, 6), b"x")}, r"start_q must hold numbers, got \|S1"),
        ({"sample_id": np.zeros(3)}, "sample_id must hold integers, got float64"),
        (
            {"sample_id": np.full(3, 2**63, np.uint64)},
            r"sample_id must hold integers below 2\^63, got 9223372036854",
        ),
        ({"names": np.array([b"a", b"b", b"c"])}, "names must hold numbers"),
        (
            {"attributes": {"problem": "airhokey"}},
            "attribute 'problem': unknown problem 'airhokey' .did you mean 'airhockey'",
        ),
        (
            {"attributes": {"problem": "no/problem.toml"}},
            "no such file: .*problem.toml",
        ),
        ({"attributes": {"problem": 3}}, "attribute 'problem' must be a text, got"),
        ({"attributes": {"degree": 7.5}}, "attribute 'degree' must be an integer, got"),
        (
            {"attributes": {"degree": 1}},
            "degree must be an integer from 3 to 20, got 1",
        ),
        ({"attributes": {"degree": [7, 7]}}, "attribute 'degree' must be an integer"),
        (
            {"attributes": {"format": "other-plans"}},
            "is a other-plans file, not one of plans",
        ),
        (
            {"attributes": {"format_version": 2}},
            "format version 2, this cnpgen reads 1: upgrade",
        ),
        (
            {"attributes": {"problem_recipe": "{}"}},
            "has an attribute 'problem_recipe' but no problem_urdf and no",
        ),
    ],
)
def test_wrong_files_are_refused_by_name_and_field(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = write_minimal(tmp_path / "theirs.h5", **changes)
    with pytest.raises(DatasetError, match=message) as caught:
        load_plans(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "recipe", ["{", "[]", "{}", '{"name": 1, "robot": 2, "constraint": 3}', b"\xff\xfe"]
)
def test_a_damaged_problem_is_said(tmp_path: Path, recipe: Any) -> None:
    texts = {
        "problem_recipe": recipe,
        "problem_urdf": "<robot/>",
        "problem_sha256": "0" * 64,
    }
    if isinstance(recipe, bytes):
        texts["problem_recipe"] = np.bytes_(recipe)
    with is_refused(DatasetError):
        load_plans(write_minimal(tmp_path / "theirs.h5", attributes=texts))


def test_a_changed_problem_is_said(tmp_path: Path) -> None:
    save_plans(tmp_path / "plan.h5", draw_plans())
    with h5py.File(remove_checksum(tmp_path / "plan.h5"), "a") as file:
        file.attrs["problem_recipe"] = record().recipe.replace(
            '"velocity_scale": 0.8', '"velocity_scale": 0.9'
        )
    with is_refused(DatasetError):
        load_plans(tmp_path / "plan.h5")


@pytest.mark.parametrize("end", ["start", "goal"])
def test_tip_positions_of_a_file_are_those_of_its_joints(
    tmp_path: Path, end: str
) -> None:
    plans = load_plans(write_minimal(tmp_path / "right.h5"))
    right, other = plans.columns[f"{end}_xyz"], "goal" if end == "start" else "start"
    stale = right + np.array([[0.0, 0.0, 1e-7], [0.0, 0.2, 0.0], [np.nan, 0.0, 0.0]])
    file = write_minimal(tmp_path / "stale.h5", **{f"{end}_xyz": stale})
    with pytest.warns(
        RuntimeWarning,
        match=f"{end}_xyz of 2 plans is not where {end}_q puts .* plan 1, 0.2 m off",
    ):
        found = load_plans(file)
    np.testing.assert_array_equal(
        found.columns[f"{end}_xyz"], np.concatenate([stale[:1], right[1:]])
    )
    np.testing.assert_array_equal(
        found.columns[f"{other}_xyz"], plans.columns[f"{other}_xyz"]
    )


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        (
            "path_control_points",
            (2, 15, 6),
            r"path_control_points must have shape \(3, C, n\) like the other fields",
        ),
        (
            "rate_control_points",
            (2, 20),
            r"rate_control_points must have shape \(3, R\) ",
        ),
        ("goal_q", (4, 6), r"goal_q must have shape \(3, 6\)"),
        ("duration", (2,), r"duration must have shape \(3,\), got \(2,\)"),
        ("loss", (2,), r"loss must have shape \(3,\)"),
    ],
)
def test_the_field_that_does_not_fit_the_others_is_named(
    tmp_path: Path, name: str, shape: tuple[int, ...], message: str
) -> None:
    file = write_minimal(tmp_path / "theirs.h5", **{name: np.ones(shape)})
    with pytest.raises(DatasetError, match=message):
        load_plans(file)


def test_a_link_to_nothing_is_damage(tmp_path: Path) -> None:
    with h5py.File(write_minimal(tmp_path / "theirs.h5"), "a") as file:
        file["start_xyz"] = h5py.SoftLink("/nowhere")
    with is_refused(DatasetError):
        load_plans(tmp_path / "theirs.h5")


def test_missing_and_foreign_files_are_said(tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_bytes(b"hello")
    with is_refused(UsageError, argument="path"):
        load_plans(tmp_path / "text.h5")
    (tmp_path / "empty.h5").write_bytes(b"")
    with is_refused(DatasetError):
        load_plans(tmp_path / "empty.h5")
    with is_refused(UsageError, argument="path"):
        load_plans(tmp_path / "none.h5")
    with is_refused(UsageError, argument="path"):
        load_plans(tmp_path)
    with pytest.raises(RecipeError):
        load_plans(write_minimal(tmp_path / "good.h5"), problem="airhokey")


@pytest.mark.filterwarnings("ignore:.* puts the tip:RuntimeWarning")
@pytest.mark.filterwarnings(
    "ignore:start_|goal_:UserWarning"
)  # a changed byte may give an implausible angle
def test_cut_off_and_changed_files_never_give_anything_but_plans_or_an_error(
    tmp_path: Path,
) -> None:
    save_plans(tmp_path / "plan.h5", draw_plans(columns={"x": np.ones(N)}))
    content, path, draws = (
        remove_checksum(tmp_path / "plan.h5").read_bytes(),
        tmp_path / "broken.h5",
        random.Random(0),
    )
    for length in [*range(0, len(content), len(content) // 40), len(content) - 1]:
        path.write_bytes(content[:length])
        with pytest.raises(DatasetError, match=r"broken\.h5"):
            load_plans(path)
    outcomes = {True: 0, False: 0}
    for _ in range(250):
        changed = bytearray(content)
        for _ in range(draws.choice([1, 3, 30])):
            changed[draws.randrange(len(changed))] = draws.randrange(256)
        path.write_bytes(changed)
        try:
            outcomes[len(load_plans(path, problem=PROBLEMS["airhockey"])) == N] += 1
        except DatasetError as error:
            assert "broken.h5" in str(error)  # noqa: PT017
            outcomes[False] += 1
    assert outcomes[True] > 20
    assert outcomes[False] > 20


def test_a_changed_bit_anywhere_in_a_file_with_a_checksum_is_detected(
    tmp_path: Path,
) -> None:
    plans = draw_plans()
    save_plans(tmp_path / "plan.h5", plans)
    content, path, draws = (
        (tmp_path / "plan.h5").read_bytes(),
        tmp_path / "broken.h5",
        random.Random(1),
    )
    for place in [
        *range(100),
        *(draws.randrange(len(content)) for _ in range(300)),
        len(content) - 1,
    ]:
        changed = bytearray(content)
        changed[place] ^= 1 << draws.randrange(8)
        path.write_bytes(changed)
        with pytest.raises(DatasetError, match=r"broken\.h5"):
            load_plans(path)
    path.write_bytes(
        b"written by another lab, sha256 unknown".ljust(512, b"\0") + content[512:]
    )
    found = load_plans(path)
    assert not found.has_checksum
    assert_equal(found, plans)


def test_the_reader_says_whether_a_file_has_a_checksum(tmp_path: Path) -> None:
    plans = draw_plans()
    save_plans(tmp_path / "plan.h5", plans)
    found = load_plans(tmp_path / "plan.h5")
    assert found.has_checksum
    assert found[:2].has_checksum
    assert load_boundary_problems(tmp_path / "plan.h5").has_checksum
    assert evaluate_plans(found[:1], workers=1).summary()["checksum"] == "right"
    assert not plans.has_checksum
    with h5py.File(remove_checksum(tmp_path / "plan.h5"), "a") as file:
        file["loss"] = np.arange(float(N))
    found = load_plans(tmp_path / "plan.h5")
    assert not found.has_checksum
    assert found.columns["loss"].tolist() == list(range(N))
    assert evaluate_plans(found[:1], workers=1).summary()["checksum"] == "none"


def test_a_file_of_a_newer_format_asks_for_an_upgrade(tmp_path: Path) -> None:
    save_plans(tmp_path / "plan.h5", draw_plans())
    content = (tmp_path / "plan.h5").read_bytes()
    (tmp_path / "plan.h5").write_bytes(
        with_checksum(content, kind="cnpgen-plans", version=2)
    )
    with is_refused(DatasetError):
        load_plans(tmp_path / "plan.h5")


# --- values -----------------------------------------------------------------------------------------------------------


def garbage() -> Plans:
    """Plans 1 to 8 are each broken in one way; 0 and 9 are good."""
    plans = draw_plans(n=10)
    path, rate, boundary = (
        plans.path_control_points,
        plans.rate_control_points,
        copy.deepcopy(plans.boundary),
    )
    path[1, 4, 2], path[2, 0, 0], rate[3, 5] = np.nan, np.inf, np.nan
    rate[4], rate[5, 7], rate[6] = -1.0, -50.0, 0.0
    boundary.goal_dq[7, 0] = np.nan
    rate[8] = 1e-320  # positive, but 1 / r is not a number that can be had
    rate[4, 7] = -1e308  # finite, but its differences are not
    return make_plans(
        PROBLEMS["airhockey"],
        boundary,
        path_control_points=path,
        rate_control_points=rate,
    )


def test_garbage_values_load_and_are_found_one_by_one(tmp_path: Path) -> None:
    plans = load_after(tmp_path, garbage())
    assert_equal(plans, garbage())
    found = [PlanStatus(status) for status in screen(plans)]
    finite, forward = PlanStatus.NOT_FINITE, PlanStatus.NOT_FORWARD
    ok = PlanStatus.UNKNOWN
    assert found == [
        ok,
        finite,
        finite,
        finite,
        forward,
        forward,
        forward,
        finite,
        forward,
        ok,
    ]
    good = draw_plans(n=10)
    assert np.array_equal(plans.duration[[0, 9]], good.duration[[0, 9]])
    assert np.array_equal(
        plans.motion.at(np.linspace(0, 1, 9)).q[9],
        good.motion.at(np.linspace(0, 1, 9)).q[9],
    )


def test_control_points_metres_away_and_a_goal_equal_to_the_start_are_plans(
    tmp_path: Path,
) -> None:
    plans = draw_plans()
    plans.path_control_points[0, 5] = 1e6
    plans.boundary.goal_q[1] = plans.boundary.start_q[1]
    plans.columns["goal_xyz"][1] = plans.columns["start_xyz"][1]
    found = load_after(tmp_path, plans)
    assert not screen(found).any()
    assert_equal(found, plans)


def test_a_wrong_duration_in_the_file_is_not_believed(tmp_path: Path) -> None:
    path = write_minimal(tmp_path / "a.h5", duration=np.full(3, 77.0))
    assert np.allclose(load_plans(path).duration, 1.0)


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        ({}, ["UNKNOWN", "VALID", "UNKNOWN"]),
        (
            {"flag_values": [0, 1, 77], "flag_meanings": "unknown invalid valid"},
            ["UNKNOWN", "INVALID", "VALID"],
        ),
        (
            {"flag_values": [0, 1, 77], "flag_meanings": "unknown valid gave_up"},
            ["UNKNOWN", "VALID", "UNKNOWN"],
        ),
        (
            {"flag_values": [77, 78], "flag_meanings": "valid"},
            ["UNKNOWN", "UNKNOWN", "VALID"],
        ),
    ],
)
def test_the_numbers_of_a_status_mean_what_the_file_says(
    tmp_path: Path, attributes: dict[str, Any], expected: list[str]
) -> None:
    path = write_minimal(tmp_path / "a.h5", status=np.array([0, 1, 77]))
    with h5py.File(path, "a") as file:
        file["status"].attrs.update(attributes)
    assert [PlanStatus(status).name for status in load_plans(path).status] == expected


def test_every_status_is_documented() -> None:
    rows = re.findall(
        r"^\| (\d) \| `(\w+)` \| (.*) \|$", DOCS.read_text(encoding="utf-8"), re.M
    )
    assert rows == [
        (str(int(status)), status.name.lower(), status.text) for status in PlanStatus
    ]


def test_every_status_has_a_text() -> None:
    assert len({status.text for status in PlanStatus}) == len(PlanStatus)
    assert PlanStatus.UNKNOWN == 0


# --- in memory --------------------------------------------------------------------------------------------------------


def test_selected_plans_joined_again_are_the_same() -> None:
    plans = draw_plans(
        goal_ddq=True,
        columns={"w": np.arange(2.0 * N).reshape(N, 2)},
        sample_id=np.arange(N) + 100,
    )
    mask = np.arange(N) % 2 == 0
    even, odd = plans[mask], plans[~mask]
    assert even.sample_id.tolist() == [100, 102, 104, 106]
    joined = concatenate([even, odd])[
        np.argsort(np.r_[np.flatnonzero(mask), np.flatnonzero(~mask)])
    ]
    assert_equal(joined, plans)
    assert_equal(concatenate([plans[:2], plans[2:]]), plans)
    assert_equal(concatenate([plans]), plans)
    parts = [
        replace(plans, source=source, refined_with="{}")
        for source in ("a", "", "b", "a")
    ]
    assert (concatenate(parts).source, concatenate(parts).refined_with) == (
        "a; b",
        "{}",
    )
    assert not concatenate([plans, *parts]).refined_with
    assert plans[np.array([3, 3, 0])].sample_id.tolist() == [103, 103, 100]


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ({"problem": "heavy-object"}, "the problem is"),
        ({"goal_ddq": True}, "goal_ddq is True in part 1, but False in part 0"),
        ({"columns": {"x": np.zeros(N)}}, "the set of columns is"),
    ],
)
def test_plans_that_do_not_fit_are_not_joined(
    others: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        concatenate([draw_plans(), draw_plans(**others)])
    with is_refused(UsageError):
        concatenate([])


@pytest.mark.parametrize(
    ("which", "message"),
    [
        (
            np.ones(3, bool),
            r"a mask must have shape \(7,\) as there are 7 plans, got \(3,\)",
        ),
        (np.array([0, 7]), "there is no plan 7: 7 plans, numbered from 0"),
        (np.array([-8]), "there is no plan -8"),
        (7, "there is no plan 7"),
        (
            np.array([0.0]),
            r"selected by a number, numbers, a mask or a slice, got float64 of shape \(1,\)",
        ),
        (
            [[1, 2]],
            r"selected by a number, numbers, a mask or a slice, got int64 of shape \(1, 2\)",
        ),
        (
            True,
            r"selected by a number, numbers, a mask or a slice, got bool of shape \(\)",
        ),
        (
            "first",
            r"selected by a number, numbers, a mask or a slice, got <U5 of shape \(\)",
        ),
    ],
)
def test_plans_that_are_not_there_cannot_be_selected(which: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        draw_plans()[which]
    assert isinstance(caught.value, IndexError)


@pytest.mark.parametrize(
    ("which", "numbers"),
    [
        (3, [3]),
        (np.int64(-1), [6]),
        (np.array(2), [2]),
        (slice(2, 5), [2, 3, 4]),
        ([0, 4], [0, 4]),
        (np.array([5, 5, -7]), [5, 5, 0]),
        (np.arange(N) == 1, [1]),
        ((np.arange(N) > 4).tolist(), [5, 6]),
    ],
)
def test_everything_that_is_known_of_plans_follows_them_as_numpy_would_have_it(
    which: Any, numbers: list[int]
) -> None:
    columns = {
        "w": np.arange(2.0 * N).reshape(N, 2),
        "refine_outcome": np.arange(N) / 2,
    }
    given = {
        "sample_id": np.arange(N) + 100,
        "status": np.arange(N) % 5,
        "source": "here",
    }
    plans = replace(
        draw_plans(goal_ddq=True, columns=columns, **given), refined_with="{}"
    )
    plans.duration  # noqa: B018 - what was computed of all of them must not stay
    found = plans[which]
    assert isinstance(found, Plans)
    assert (found.source, found.refined_with) == ("here", "{}")
    assert set(found.columns) == {"w", "refine_outcome", "start_xyz", "goal_xyz"}
    parts = (
        plans.boundary.arrays()
        | plans.columns
        | {name: getattr(plans, name) for name in ARRAYS}
    )
    for name, values in (
        found.boundary.arrays()
        | found.columns
        | {name: getattr(found, name) for name in ARRAYS}
    ).items():
        np.testing.assert_array_equal(values, parts[name][numbers], err_msg=name)
    np.testing.assert_array_equal(found.motion.path, plans.motion[numbers].path)


def test_plans_can_be_gone_through_one_by_one() -> None:
    plans = draw_plans(sample_id=np.arange(N) + 100)
    assert [(len(each), each.sample_id[0]) for each in plans] == [
        (1, 100 + index) for index in range(N)
    ]


def test_no_plans_can_be_selected() -> None:
    assert len(draw_plans()[np.array([])]) == len(draw_plans()[:0]) == 0


@pytest.mark.parametrize("name", ["start_q", "goal_dq"])
def test_boundary_conditions_of_other_joints_and_ragged_ones_are_no_plans(
    name: str,
) -> None:
    plans = draw_plans()
    points = {
        each: getattr(plans, each)
        for each in ("path_control_points", "rate_control_points")
    }
    others = replace(plans.boundary, **{name: np.zeros((N, 7))})
    with is_refused(UsageError, argument="boundary"):
        make_plans(plans.problem, others, **points)
    with is_refused(UsageError, argument=ANY):
        make_plans(
            plans.problem,
            replace(plans.boundary, **{name: [[1.0], [1.0, 2.0]]}),
            **points,
        )


def test_what_is_not_plans_is_refused_by_name(tmp_path: Path) -> None:
    calls: list[Callable[[Any], Any]] = [
        evaluate_plans,
        refine_plans,
        lambda plans: export_plans(plans, tmp_path / "a.npz", to="npz"),
        lambda plans: save_plans(tmp_path / "a.h5", plans),
    ]
    for call in calls:
        with is_refused(UsageError, argument="plans"):
            call("plans.h5")


def test_where_plans_are_from_is_kept_in_the_file(tmp_path: Path) -> None:
    plans = replace(
        draw_plans(), source="my trainer, seed 3", refined_with='{"solver": "own"}'
    )
    save_plans(tmp_path / "a.h5", plans)
    found = load_plans(tmp_path / "a.h5")
    assert (found.source, found.refined_with) == (plans.source, plans.refined_with)
    with is_refused(UsageError, argument="source"):
        replace(plans, source=3)  # type: ignore[arg-type]


def test_a_column_may_hold_integers_of_any_size(tmp_path: Path) -> None:
    path = write_minimal(tmp_path / "a.h5", key=np.array([0, 1, 2**63], np.uint64))
    assert load_plans(path).columns["key"].tolist() == [0.0, 1.0, 2.0**63]


def test_a_problem_by_name_that_is_not_the_one_of_the_digest_is_refused(
    tmp_path: Path,
) -> None:
    path = write_minimal(tmp_path / "a.h5", attributes={"problem_sha256": "0" * 64})
    with is_refused(DatasetError):
        load_plans(path)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            {"sample_id": [0.7, 1.2, 2.9]},
            "sample_id must hold integers from .* got float64",
        ),
        (
            {"sample_id": np.full(3, 2**63, np.uint64)},
            "sample_id must hold integers from .* to 9223372036854775807",
        ),
        ({"sample_id": ["a", "b", "c"]}, "sample_id must be an array of integers"),
        ({"status": [300, 0, 0]}, "status must hold integers from 0 to 255"),
        ({"degree": 7.5}, "degree must be an integer from 3 to 20, got 7.5"),
        ({"columns": {".": np.zeros(3)}}, "a column cannot be called '.'"),
    ],
)
def test_numbers_that_would_change_when_stored_are_refused(
    wrong: dict[str, Any], message: str
) -> None:
    plans = draw_plans(3)
    points = {
        name: getattr(plans, name)
        for name in ("path_control_points", "rate_control_points")
    }
    with pytest.raises(UsageError, match=message):
        make_plans(plans.problem, plans.boundary, **points, **wrong)


@pytest.mark.parametrize(
    "content", [b"precious", b"cnpgen-model 1\n", b"\x89HDF\r\n\x1a\n", "shard"]
)
def test_only_files_of_plans_are_replaced(tmp_path: Path, content: bytes | str) -> None:
    path = tmp_path / "mine.h5"
    if isinstance(content, str):
        with h5py.File(path, "w") as file:
            file.attrs["format"] = "cnpgen-shard"
    else:
        path.write_bytes(content)
    before = path.read_bytes()
    with is_refused(UsageError, argument="path"):
        save_plans(path, draw_plans())
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["mine.h5"]


def test_plans_of_anybody_and_empty_files_are_replaced_and_folders_are_made(
    tmp_path: Path,
) -> None:
    theirs = write_minimal(tmp_path / "theirs.h5")
    (tmp_path / "empty.h5").touch()
    for path in (
        theirs,
        theirs,
        tmp_path / "empty.h5",
        tmp_path / "new" / "folder" / "plans.h5",
    ):
        save_plans(path, draw_plans())
        assert_equal(load_plans(path), draw_plans())
    with is_refused(UsageError, argument="path"):
        save_plans(tmp_path / "new", draw_plans())


def test_a_model_is_said_to_be_one(tmp_path: Path) -> None:
    path = tmp_path / "mine.h5"
    save_model(path, load_model("airhockey-hit"))
    for use in (load_plans, lambda path: save_plans(path, draw_plans())):
        with is_refused(UsageError, argument="path"):
            use(path)


def test_sizes_and_degrees_that_differ_are_not_joined() -> None:
    plans = draw_plans()
    shorter = replace(plans, path_control_points=plans.path_control_points[:, :12])
    with is_refused(UsageError):
        concatenate([plans, shorter])
    with is_refused(UsageError):
        concatenate([plans, replace(plans, degree=5)])


@pytest.mark.parametrize("name", ["duration", "start_q", "status", "a/b", ""])
def test_columns_cannot_have_the_name_of_something_else(name: str) -> None:
    with is_refused(UsageError, argument="columns"):
        draw_plans(columns={name: np.zeros(N)})


def test_a_replaced_rate_has_its_own_duration() -> None:
    plans = draw_plans()
    slower = replace(plans, rate_control_points=plans.rate_control_points / 2)
    assert np.allclose(slower.duration, 2 * plans.duration, rtol=1e-14)


def test_plans_travel_to_other_processes() -> None:
    plans = draw_plans()
    assert_equal(pickle.loads(pickle.dumps(plans)), plans)
    assert hash(plans.problem) == hash(record_problem(PROBLEMS["airhockey"]))


def test_importing_plans_imports_nothing_heavy() -> None:
    code = "import sys, cnpgen.plans; sys.exit(bool({'h5py', 'scipy', 'pinocchio', 'casadi'} & set(sys.modules)))"
    subprocess.run([sys.executable, "-c", code], check=True)


class Tensor:
    """Imitation of a torch tensor with a gradient: NumPy cannot convert it, until it is detached."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.shape = values, values.shape

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        raise RuntimeError("Can't call numpy() on Tensor that requires grad")

    def detach(self) -> np.ndarray:
        return self.values


def test_plans_are_made_of_tensors_that_carry_gradients() -> None:
    plans = draw_plans(goal_ddq=True)
    boundary = Boundary(
        **{name: Tensor(part) for name, part in plans.boundary.arrays().items()}
    )
    given = {
        name: Tensor(getattr(plans, name))
        for name in ("path_control_points", "rate_control_points")
    }
    assert_equal(make_plans(PROBLEMS["airhockey"], boundary, **given), plans)


@pytest.mark.slow
def test_plans_are_made_of_arrays_of_jax_and_tensors_of_torch() -> None:
    jnp, torch = pytest.importorskip("jax.numpy"), pytest.importorskip("torch")
    plans = draw_plans()
    path, rate = plans.path_control_points, plans.rate_control_points
    with_gradient = torch.tensor(path, requires_grad=True)
    found = make_plans(
        PROBLEMS["airhockey"],
        plans.boundary,
        path_control_points=with_gradient,
        rate_control_points=jnp.asarray(rate),
    )
    np.testing.assert_array_equal(found.path_control_points, path)
    np.testing.assert_allclose(found.rate_control_points, rate, rtol=1e-6)


@pytest.mark.parametrize("end", ["start_q", "goal_q"])
def test_joint_positions_in_degrees_are_refused_where_they_come_in(
    tmp_path: Path, end: str
) -> None:
    plans = draw_plans()
    degrees = getattr(plans.boundary, end).copy()
    degrees[2, 3] = 40.0
    boundary = replace(plans.boundary, **{end: degrees})
    points = {
        name: getattr(plans, name)
        for name in ("path_control_points", "rate_control_points")
    }
    message = rf"^{end} must be from -4.19 to 4.19 rad, got 40 rad in plan 2 of joint_4; .* 40 deg = 0.698 rad"
    with pytest.raises(
        UnitError, match=message + r"\? allow_large_angles=True accepts such values"
    ) as caught:
        make_plans(PROBLEMS["airhockey"], boundary, **points)
    assert caught.value.argument == "boundary"
    with pytest.warns(UserWarning, match=message):
        made = make_plans(
            PROBLEMS["airhockey"], boundary, **points, allow_large_angles=True
        )
    save_plans(tmp_path / "degrees.h5", made)
    with pytest.warns(UserWarning, match=message):  # the verdict reports it
        load_plans(tmp_path / "degrees.h5")


@pytest.mark.parametrize("value", [2.5, 3.9, np.nan])
def test_joint_positions_that_are_only_outside_are_not_suspicious(value: float) -> None:
    plans = draw_plans()
    q = plans.boundary.start_q.copy()
    q[0, 3] = value
    boundary = replace(plans.boundary, start_q=q)
    points = {
        name: getattr(plans, name)
        for name in ("path_control_points", "rate_control_points")
    }
    assert (
        len(make_plans(PROBLEMS["airhockey"], boundary, **points)) == N
    )  # warnings are errors in tests


@pytest.mark.parametrize(
    "problem",
    [
        "../heavy/problem.toml",
        "{tmp}/heavy/problem.toml",
        "link/problem.toml",
        "/dev/zero",
        "/etc/passwd",
    ],
)
def test_a_problem_in_another_folder_is_not_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, problem: str
) -> None:
    shutil.copytree(PROBLEMS["heavy-object"].path.parent, tmp_path / "heavy")
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "link").symlink_to(tmp_path / "heavy")
    fields = {
        name: np.zeros((3, 7))
        for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
    }
    fields |= {"path_control_points": np.zeros((3, 15, 7))}
    attributes = {"problem": problem.format(tmp=tmp_path)}
    path = write_minimal(tmp_path / "theirs" / "a.h5", **fields, attributes=attributes)
    with monkeypatch.context() as patch:
        patch.setattr(
            "cnpgen.plans.plan_file.load_problem",
            lambda *_, **__: pytest.fail("opened"),
        )
        for read in (load_plans, load_boundary_problems):
            with is_refused(DatasetError, argument="problem"):
                read(path)
    assert load_plans(path, problem=PROBLEMS["heavy-object"]).problem == record_problem(
        PROBLEMS["heavy-object"]
    )
