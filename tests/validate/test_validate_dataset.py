"""Validation: every change of a dataset is found by its files, by Pinocchio or by regeneration."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cnpgen.errors import MachineError, UsageError
from cnpgen.make.generation_options import GenerationOptions
from cnpgen.make.make_dataset import make_dataset
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.store.check import REMAKE_HINT
from cnpgen.store.dataset_spec import load_dataset_spec, shards
from cnpgen.store.layout import MANIFEST
from cnpgen.store.shard import read_shard
from cnpgen.validate.validate_dataset import ValidationReport, validate_dataset
from tests.conftest import (
    SHIPPED,
    TINY_SHARD,
    Arm,
    needs_compiled_code,
    some,
    tiny_recipe,
)
from tests.examples.forged_shards import edit
from tests.refusals import is_refused

Tiny = Callable[[str], Path]
FILES = [
    "train/shard-00001.h5", "manifest.json", "train/shard-00001.json", "README.md", "croissant.json",
    "specification.json", "stats.json", "train/shard-00000.h5", "train/shard-00000.json",
    "train/shard-00002.h5", "train/shard-00002.json", "validation/shard-00000.h5", "validation/shard-00000.json",
]  # fmt: skip
KINDS = some(FILES, 7)  # the others are shards, too


def named(report: ValidationReport) -> dict[str, str]:
    """Return file -> problem, without notes."""
    return {
        finding.file: finding.problem for finding in report.findings if not finding.note
    }


def copied(tiny: Tiny, tmp_path: Path, name: str = "airhockey-hit") -> Path:
    return Path(shutil.copytree(tiny(name), tmp_path / name))


# --- good datasets ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", some(["float64", "float32"], 1, "slow"))
@pytest.mark.parametrize("name", some(SHIPPED, 1, "slow"))
def test_made_datasets_are_valid_and_regenerated_blocks_are_identical(
    tiny: Tiny, tmp_path, name, dtype
):
    folder = tiny(name)
    if dtype == "float32":
        folder = tmp_path / name
        make_dataset(
            tiny_recipe(name),
            folder,
            shard_size=TINY_SHARD,
            workers=1,
            options=GenerationOptions(dtype=dtype),
        )
    report = validate_dataset(folder, deep=True, regenerate=4, workers=1)
    assert report.ok, report.summary()
    assert report.findings == ()
    assert (report.rows, report.regenerated, report.identical) == (660, 4, 4)
    assert report.deep is not None
    assert (report.deep.rows, len(report.deep.failed_rows)) == (660, 0)
    assert {"tip position", "joint torque"} <= {
        check.name for check in report.deep.checks
    }
    assert all(np.isfinite(check.worst) for check in report.deep.checks)


@pytest.mark.extended
def test_thousands_of_float32_rows_are_valid(tmp_path):
    for name in SHIPPED:
        make_dataset(
            name,
            tmp_path / name,
            n=4000,
            workers=1,
            options=GenerationOptions(dtype="float32"),
        )
        report = validate_dataset(tmp_path / name, deep=True, workers=2)
        assert report.ok, report.summary()


@pytest.mark.slow
def test_one_worker_and_two_report_the_same(tiny: Tiny):
    one, two = (
        validate_dataset(tiny("airhockey-hit"), deep=True, workers=workers)
        for workers in (1, 2)
    )
    assert one.to_dict() == two.to_dict()


def test_a_report_converts_to_text_and_json(tiny: Tiny):
    report = validate_dataset(tiny("airhockey-hit"), deep=True, regenerate=1, workers=1)
    assert json.loads(json.dumps(report.to_dict()))["ok"] is True
    text = report.summary()
    assert "660 rows, no findings" in text
    assert "recomputed with Pinocchio and Coal: 660 rows, 0 out" in text
    assert "made again: 1 of 4 blocks, 1 identical to the bit" in text
    assert "plan" not in text
    assert report.to_dict()["plans"] is None


def test_at_most_all_blocks_are_regenerated_and_the_report_states_it(tiny: Tiny):
    report = validate_dataset(tiny("airhockey-hit"), regenerate=100_000)
    assert (report.regenerated, report.blocks) == (4, 4)
    assert (
        "made again: 4 of 4 blocks (100,000 were requested), 4 identical to the bit"
        in report.summary()
    )
    assert report.to_dict()["blocks"] == 4


def test_requested_blocks_that_do_not_exist_are_reported(damaged: Path):
    for shard in damaged.glob("*/*.h5"):
        shard.unlink()
    text = validate_dataset(damaged, regenerate=2).summary()
    assert (
        "made again: 0 of 0 blocks (2 were requested), 0 identical to the bit" in text
    )


def test_findings_have_consistent_hints(damaged: Path, another_seed: Path):
    shutil.copy(another_seed / "train/shard-00001.h5", damaged / "train/shard-00001.h5")
    assert {finding.hint for finding in validate_dataset(damaged).findings} == {
        REMAKE_HINT
    }
    (damaged / "specification.json").unlink()
    assert (
        "hint: without its specification the dataset cannot be repaired"
        in validate_dataset(damaged).summary()
    )


def test_progress_is_called_for_every_shard(tiny: Tiny):
    seen: list[int] = []
    validate_dataset(tiny("airhockey-hit"), deep=True, workers=1, progress=seen.append)
    assert seen == [250, 250, 100, 60]


def test_the_finished_shards_of_an_unfinished_dataset_are_checked(tmp_path):
    make_dataset(
        tiny_recipe("airhockey-hit"),
        tmp_path / "out",
        shard_size=TINY_SHARD,
        workers=1,
        options=GenerationOptions(part=(0, 2)),
    )
    report = validate_dataset(tmp_path / "out", deep=True, regenerate=2, workers=1)
    assert report.rows == 500
    assert list(named(report)) == [MANIFEST]
    assert report.identical == 2
    assert not report.ok


# --- damaged files ----------------------------------------------------------------------------------------------------


def test_the_files_of_a_dataset_are_all_tested(tiny: Tiny):
    folder = tiny("airhockey-hit")
    assert sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file()
    ) == sorted(FILES)


@pytest.mark.parametrize("file", some(KINDS, 3, "slow"))
def test_a_flipped_byte_is_found_in_every_file(damaged: Path, file):
    whole = (damaged / file).read_bytes()
    random = np.random.default_rng(len(file))
    for position in [
        0,
        len(whole) // 2,
        len(whole) - 1,
        *random.integers(len(whole), size=1).tolist(),
    ]:
        flipped = bytearray(whole)
        flipped[position] ^= 0x04
        (damaged / file).write_bytes(bytes(flipped))
        report = validate_dataset(damaged)
        assert not report.ok, (file, position)
        assert file in named(report), (file, position, named(report))
    (damaged / file).write_bytes(whole)
    assert validate_dataset(damaged).ok


@pytest.mark.parametrize("file", [kind for kind in KINDS if kind != "croissant.json"])
def test_a_missing_file_is_named(damaged: Path, file):
    (damaged / file).unlink()
    report = validate_dataset(damaged)
    assert not report.ok
    assert "missing" in named(report)[file]


@pytest.mark.parametrize("file", some(KINDS, 3, "slow"))
@pytest.mark.parametrize("keep", some([0.3, 0.0, 0.999], 2))
def test_a_cut_off_file_is_named(damaged: Path, file, keep):
    whole = (damaged / file).read_bytes()
    (damaged / file).write_bytes(whole[: int(keep * len(whole))])
    report = validate_dataset(damaged)
    assert not report.ok
    assert file in named(report)


@pytest.mark.parametrize("file", some(KINDS, 1, "slow"))
def test_damaged_files_are_findings_and_not_exceptions_in_all_checks(
    damaged: Path, file
):
    """Also where the damage keeps the size, so that a shard seems to be there."""
    whole = bytearray((damaged / file).read_bytes())
    whole[: len(whole) // 2] = bytes(len(whole) // 2)
    (damaged / file).write_bytes(bytes(whole))
    report = validate_dataset(damaged, deep=True, regenerate=6, workers=1)
    assert not report.ok
    assert file in named(report)


@pytest.fixture(scope="module")
def another_seed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("other") / "airhockey-hit"
    make_dataset(
        tiny_recipe("airhockey-hit"), folder, shard_size=TINY_SHARD, workers=1, seed=4
    )
    return folder


def test_a_shard_of_another_seed_is_named(damaged: Path, another_seed: Path):
    shutil.copy(another_seed / "train/shard-00001.h5", damaged / "train/shard-00001.h5")
    assert list(named(validate_dataset(damaged))) == ["train/shard-00001.h5"]
    shutil.copy(
        another_seed / "train/shard-00001.json", damaged / "train/shard-00001.json"
    )
    assert set(named(validate_dataset(damaged))) == {
        "train/shard-00001.h5",
        "train/shard-00001.json",
    }


def test_a_shard_in_the_place_of_another_is_named(damaged: Path):
    for ending in ("h5", "json"):
        shutil.copy(
            damaged / f"train/shard-00000.{ending}",
            damaged / f"train/shard-00001.{ending}",
        )
    assert {"train/shard-00001.h5", "train/shard-00001.json"} <= set(
        named(validate_dataset(damaged))
    )


def test_two_shards_that_changed_places_are_named_even_if_the_manifest_is_rewritten(
    damaged: Path,
):
    first, second = (read_shard(damaged / f"train/shard-0000{k}.h5") for k in (0, 1))
    for file, values in (
        ("train/shard-00000.h5", second),
        ("train/shard-00001.h5", first),
    ):

        def exchange(shard: h5py.File, values=values) -> None:
            for name, column in values.items():
                if name != "sample_id":
                    shard[name][...] = column

        edit(damaged, file, exchange)
    assert validate_dataset(damaged).ok
    report = validate_dataset(damaged, regenerate=30)
    assert {"train/shard-00000.h5", "train/shard-00001.h5"} == set(named(report))


def test_files_that_do_not_belong_to_the_dataset_are_notes_and_no_problems(
    damaged: Path,
):
    (damaged / "train" / "notes.txt").write_text("mine")
    report = validate_dataset(damaged)
    assert report.ok
    assert [(finding.file, finding.note) for finding in report.findings] == [
        ("train/notes.txt", True)
    ]


# --- rows that are wrong ----------------------------------------------------------------------------------------------


def add(
    column: str, row: int, amount: float, component: int | None = None
) -> Callable[[h5py.File], None]:
    def change(shard: h5py.File) -> None:
        shard[column][(row,) if component is None else (row, component)] += amount

    return change


# dataset, change of row 17, and the check that must fail
WRONG = [
    (
        "airhockey-replan",
        add("start_q", 17, 1e-6, 1),
        "vertical acceleration",
    ),  # 5 mm up or down are no fault here
    ("airhockey-replan", add("goal_q", 17, 1e-6, 3), "table height"),
    ("airhockey-replan", add("start_dq", 17, 1e-6, 1), "vertical velocity"),
    ("airhockey-replan", add("start_dq", 17, 9.0, 0), "joint velocity"),
    ("airhockey-replan", add("start_ddq", 17, 1e-5, 1), "vertical acceleration"),
    ("airhockey-replan", add("start_ddq", 17, 99.0, 0), "joint acceleration"),
    ("airhockey-replan", add("start_ddq", 17, 2000.0, 0), "joint torque"),
    ("airhockey-replan", add("start_xyz", 17, 1e-6, 0), "tip position"),
    ("airhockey-replan", add("goal_xyz", 17, -1e-6, 1), "tip position"),
    ("airhockey-replan", add("hit_angle", 17, 1e-5), "hit direction"),
    ("airhockey-replan", add("hit_speed", 17, 1e-6), "hit speed"),
    ("airhockey-hit", add("goal_q", 17, 7.0, 5), "joint position"),
    ("airhockey-replan", add("hit_speed_max", 17, 1e-7), "highest hit speed"),
    ("heavy-object", add("start_q", 17, 1e-5, 5), "tilt"),
    ("heavy-object", add("start_xyz", 17, 0.03, 2), "robot clearance"),
    ("heavy-object", add("goal_xyz", 17, 0.008, 2), "object contact"),
    ("heavy-object", add("start_torque_ratio", 17, -1e-7), "holding torque ratio"),
    ("heavy-object", add("goal_torque_ratio", 17, -1e-7), "holding torque ratio"),
    ("heavy-object", add("start_clearance", 17, 1e-7), "clearance"),
    ("heavy-object", add("goal_clearance", 17, -1e-7), "clearance"),
]


@pytest.mark.parametrize(
    ("name", "change", "check"),
    some(WRONG, 3, "slow"),
    ids=[f"{index} {check}" for index, (_, _, check) in enumerate(WRONG)],
)
def test_deep_finds_a_wrong_number_whose_checksums_were_rewritten(
    tiny: Tiny, tmp_path, name, change, check
):
    folder = copied(tiny, tmp_path, name)
    edit(folder, "train/shard-00001.h5", change)
    assert validate_dataset(folder).ok
    report = validate_dataset(folder, deep=True, workers=1)
    assert set(named(report)) == {"train/shard-00001.h5"}
    found = [finding.problem for finding in report.findings]
    row = TINY_SHARD + 17
    assert any(
        problem.startswith(f"{check}: 1 row out") and f"in row {row}" in problem
        for problem in found
    ), found
    assert report.deep is not None
    assert report.deep.failed_rows.tolist() == [row]


def put_nan(column: str) -> Callable[[h5py.File], None]:
    def change(shard: h5py.File) -> None:
        shard[column][5, 0] = np.nan

    return change


@pytest.mark.parametrize("column", ["goal_q", "goal_dq"])
@pytest.mark.parametrize(
    "options", [{}, {"deep": True, "workers": 1}, {"regenerate": 40}], ids=str
)
def test_values_that_are_not_finite_are_named(
    damaged: Path, column: str, options: dict[str, Any]
):
    edit(damaged, "train/shard-00000.h5", put_nan(column))
    report = validate_dataset(damaged, **options)
    assert named(report) == {
        "train/shard-00000.h5": f"field '{column}' is not finite in 1 rows, first in row 5"
    }


def test_sample_ids_of_other_rows_are_named(damaged: Path):
    edit(
        damaged,
        "train/shard-00001.h5",
        lambda shard: shard["sample_id"].__setitem__(7, 3),
    )
    assert named(validate_dataset(damaged)) == {
        "train/shard-00001.h5": "sample_id is not the index of the row in the split"
    }


def test_a_field_that_is_gone_is_a_finding_of_the_deep_check_too(damaged: Path):
    def change(shard: h5py.File) -> None:
        del shard["goal_q"]

    edit(damaged, "train/shard-00001.h5", change)
    report = validate_dataset(damaged, deep=True, workers=1)
    assert set(named(report)) == {"train/shard-00001.h5"}
    assert "goal_q" in named(report)["train/shard-00001.h5"]


# --- blocks made again ------------------------------------------------------------------------------------------------


def exchange_two_rows(shard: h5py.File) -> None:
    """Every row is as good as before, and the statistics are the same."""
    for name, item in shard.items():
        if name != "sample_id":
            values = item[()]
            item[...] = np.concatenate([values[1:2], values[:1], values[2:]])


def test_regeneration_finds_changes_that_satisfy_checksums_and_constraints(
    damaged: Path,
):
    edit(damaged, "train/shard-00001.h5", exchange_two_rows)
    assert validate_dataset(damaged, deep=True, workers=1).ok
    report = validate_dataset(damaged, regenerate=40)
    assert set(named(report)) == {"train/shard-00001.h5"}
    assert "made again from the seed" in named(report)["train/shard-00001.h5"]
    assert 0 < report.identical < report.regenerated


def test_differences_by_rounding_are_accepted_but_not_identical(damaged: Path):
    def change(shard: h5py.File) -> None:
        shard["start_q"][5, 0] += 1e-12

    for task in shards(load_dataset_spec(damaged)):
        edit(damaged, task.file, change)
    report = validate_dataset(damaged, regenerate=8)
    assert report.ok
    assert report.regenerated >= 4
    assert report.identical == 0


def test_all_rows_of_shards_that_begin_within_a_block_are_regenerated(tmp_path):
    """Shards of 3000 rows: the second one lies in two blocks, 3000 to 4096 and 4096 to 6000."""
    recipe = replace(tiny_recipe("airhockey-hit"), splits={"train": 6000})
    make_dataset(recipe, tmp_path / "out", shard_size=3000, workers=1)
    for row in (2000, 2990):

        def change(shard: h5py.File, row=row) -> None:
            shard["attempts"][row] += 1

        folder = Path(shutil.copytree(tmp_path / "out", tmp_path / f"changed-{row}"))
        edit(folder, "train/shard-00001.h5", change)
        assert not validate_dataset(folder, regenerate=40).ok, row


@pytest.mark.slow
def test_blocks_are_regenerated_with_the_backend_of_the_specification(tmp_path):
    make_dataset(
        tiny_recipe("airhockey-hit"),
        tmp_path / "out",
        workers=1,
        options=GenerationOptions(backend="numpy"),
    )
    report = validate_dataset(tmp_path / "out", regenerate=2)
    assert (report.ok, report.identical) == (True, 2)


@pytest.mark.slow
@needs_compiled_code
def test_blocks_of_compiled_kernels_need_no_compiler(
    tiny: Tiny, monkeypatch, fresh_compiler
):
    folder = tiny("airhockey-hit")
    monkeypatch.setenv("CC", "no-such-compiler")
    assert validate_dataset(folder, deep=True, regenerate=1, workers=1).ok


# --- arguments --------------------------------------------------------------------------------------------------------


def test_missing_folders_and_negative_counts_are_refused(damaged: Path, tmp_path):
    with is_refused(UsageError, argument="folder"):
        validate_dataset(tmp_path / "nowhere")
    with is_refused(UsageError, argument="regenerate"):
        validate_dataset(damaged, regenerate=-1)
    with is_refused(UsageError, argument="workers"):
        validate_dataset(damaged, deep=True, workers=0)


def test_a_folder_that_holds_something_else_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("no dataset")
    with is_refused(UsageError, argument="folder"):
        validate_dataset(tmp_path, deep=True, regenerate=3)


def test_a_backend_that_does_not_work_here_is_a_machine_error(
    damaged: Path, monkeypatch
):
    def fail(*_: object) -> None:
        raise MachineError("LLVM cannot be loaded")

    monkeypatch.setattr("cnpgen.kernels.compiled_kernel.find_final", fail)
    with is_refused(MachineError, argument="regenerate"):
        validate_dataset(damaged, regenerate=1)
    assert validate_dataset(damaged, deep=True, workers=1).ok


def test_the_robot_of_the_specification_is_used_instead_of_the_shipped_one(
    damaged: Path,
):
    """The specification contains recipe and URDF, and these are used for the validation."""
    robot = load_robot(load_problem("airhockey"))
    with h5py.File(damaged / "train/shard-00000.h5") as shard:
        q, xyz = shard["start_q"][0], shard["start_xyz"][0]
    np.testing.assert_allclose(Arm(robot).pose(q).translation, xyz, atol=1e-9)
    spec = load_dataset_spec(damaged)
    assert spec.robot["urdf"] == robot.urdf.read_text()
