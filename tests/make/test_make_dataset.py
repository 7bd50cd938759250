"""Making datasets: the same bytes however they are made, whoever makes which part of them."""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import joblib
import numpy as np
import pytest

from cnpgen.errors import MachineError, UsageError
from cnpgen.kernels.library import choose_backend
from cnpgen.make import make_shards as make
from cnpgen.make.make_dataset import _part as make_part
from cnpgen.make.make_dataset import is_quick, make_dataset, runs
from cnpgen.make.make_shards import Job, make_shards, shard_columns
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.make.resolve_spec import resolve
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.pipelines.stages.ik import StartIK
from cnpgen.pipelines.stages.stage import BLOCK_ROWS
from cnpgen.schema.catalogue import list_recipes
from cnpgen.store.dataset_spec import load_dataset_spec, shards
from cnpgen.store.layout import MANIFEST, SPECIFICATION
from cnpgen.store.manifest import load_manifest
from cnpgen.store.sampling_statistics import SamplingStatistics
from cnpgen.store.shard_record import pending
from cnpgen.store.workspace import find_workspace, open_workspace
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import SHIPPED, TINY_SHARD, columns_of, some, tiny_recipe
from tests.examples.tiny_datasets import SHARDS, digests, make_tiny, snapshot
from tests.refusals import is_refused

# --- the same rows however they are made ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", some(SHIPPED, 1, "slow"))
def test_one_worker_and_two_make_the_same_bytes(
    tiny: Callable[[str], Path], tmp_path, name
):
    made = make_tiny(tmp_path / "two", name, workers=2)
    assert (made.made, made.complete) == (660, True)
    assert digests(tmp_path / "two") == digests(tiny(name))
    assert len(digests(tiny(name))) == SHARDS
    assert (
        load_manifest(tmp_path / "two")["fingerprint"]
        == load_manifest(tiny(name))["fingerprint"]
    )


def test_a_fixed_date_makes_equal_manifests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1795651200")
    folders = [
        make_dataset(
            "airhockey-hit", tmp_path / str(workers) / "hits", n=20, workers=workers
        ).folder
        for workers in (1, 2)
    ]
    first, second = (Path(folder, "manifest.json").read_bytes() for folder in folders)
    assert first == second
    record = json.loads(
        Path(folders[0], "train", "shard-00000.json").read_text(encoding="utf-8")
    )
    assert (record["started"], record["seconds"]) == ("2026-11-26T00:00:00+00:00", 0.0)


def test_threads_make_the_same_bytes(tiny: Callable[[str], Path], tmp_path):
    """Any joblib backend may run the shards; with dask, several at once in one process."""
    make._PREPARED.clear()
    with joblib.parallel_config(backend="threading"):
        make_tiny(tmp_path / "threads", workers=4)
    assert digests(tmp_path / "threads") == digests(tiny("airhockey-hit"))


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20,000 rows in shards of 8192."""
    folder = tmp_path_factory.mktemp("large") / "airhockey-replan"
    make_dataset("airhockey-replan", folder, n=20_000, shard_size=8192, workers=1)
    return folder


@pytest.mark.parametrize(
    "size", some([5001, 4096], 1, "slow") + some([20_000, 3000], 0)
)
def test_rows_do_not_depend_on_the_size_of_the_shards(large, tmp_path, size):
    make_dataset(
        "airhockey-replan", tmp_path / "other", n=20_000, shard_size=size, workers=1
    )
    for split in ("train", "validation"):
        found, expected = (
            columns_of(tmp_path / "other", split),
            columns_of(large, split),
        )
        assert found.keys() == expected.keys()
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values, err_msg=name)
    one, other = (
        load_manifest(folder)["yield"] for folder in (large, tmp_path / "other")
    )
    assert one == other


def test_fewer_rows_are_the_first_of_each_split(large, tmp_path):
    make_dataset("airhockey-replan", tmp_path / "few", n=1000, workers=1)
    assert load_dataset_spec(tmp_path / "few").splits == {
        "train": 934,
        "validation": 66,
    }
    for split, rows in (("train", 934), ("validation", 66)):
        few, many = columns_of(tmp_path / "few", split), columns_of(large, split)
        for name, values in few.items():
            assert len(values) == rows
            np.testing.assert_array_equal(values, many[name][:rows], err_msg=name)


def problems_of(columns: dict[str, np.ndarray]) -> set[bytes]:
    """The boundary states of every row, as what they are stored as."""
    names = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
    return {
        row.tobytes()
        for row in np.concatenate([columns[name] for name in names], axis=1)
    }


def test_splits_share_no_row(large):
    train, validation = (
        problems_of(columns_of(large, split)) for split in ("train", "validation")
    )
    assert len(train) + len(validation) == 20_000
    assert not train & validation


def test_another_seed_makes_other_rows(tiny: Callable[[str], Path], tmp_path):
    make_tiny(tmp_path / "other", seed=7)
    found, expected = columns_of(tmp_path / "other"), columns_of(tiny("airhockey-hit"))
    assert not problems_of(found) & problems_of(expected)


def test_a_pipeline_without_a_dataset_recipe_can_be_made(tmp_path):
    made = make_dataset("airhockey-hit", tmp_path / "a", n=50, workers=1)
    as_pipeline = make_dataset(
        list_recipes("pipeline")["airhockey-hit"], tmp_path / "b", n=50, workers=1
    )
    assert as_pipeline.spec.splits == {"train": 45, "validation": 5}
    assert made.complete
    assert as_pipeline.complete


def test_the_default_folder_is_named_after_the_dataset_and_its_major_version(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert make_dataset(
        tiny_recipe("airhockey-hit", version="3.1.4"), workers=1
    ).folder == Path("airhockey-hit-v3")
    assert (tmp_path / "airhockey-hit-v3" / MANIFEST).is_file()


def test_planning_writes_nothing(tmp_path):
    job = resolve(tiny_recipe("airhockey-hit"), find_workspace(tmp_path / "out"))
    assert sum(job.spec.splits.values()) == 660
    assert list(tmp_path.iterdir()) == []


def test_progress_is_told_of_every_shard_and_its_draws(tmp_path):
    seen: list[tuple[int, SamplingStatistics]] = []
    begun: list[tuple[str, Path, int, int]] = []
    make_tiny(
        tmp_path / "out",
        progress=lambda *x: seen.append(x),
        begin=lambda *x: begun.append(x),
    )
    assert [rows for rows, _ in seen] == [250, 250, 100, 60]
    assert all(sampling.accepted == rows for rows, sampling in seen)
    assert begun == [("making", tmp_path / "out", 660, 0)]
    total = sum(sampling.tried for _, sampling in seen)
    assert load_manifest(tmp_path / "out")["yield"]["tried"] == total


def test_attempts_of_a_dataset_sum_to_the_draws_of_its_manifest(large):
    manifest = load_manifest(large)
    attempts = [
        int(columns_of(large, split)["attempts"].sum())
        for split in ("train", "validation")
    ]
    assert sum(attempts) == manifest["yield"]["tried"]
    assert manifest["yield"]["tried"] == 20_000 + sum(
        manifest["yield"]["rejections"].values()
    )


# --- parts of a job array ---------------------------------------------------------------------------------------------


def test_all_parts_of_a_job_array_make_the_dataset_and_the_last_one_finishes_it(
    tiny, tmp_path
):
    folder = tmp_path / "out"
    first = make_tiny(folder, part=(0, 2))
    assert (first.made, first.complete, first.rows) == (
        500,
        False,
        {"train": 500, "validation": 0},
    )
    assert not (folder / MANIFEST).exists()
    second = make_tiny(folder, part=(1, 2))
    assert (second.made, second.complete, second.rows) == (
        160,
        True,
        {"train": 100, "validation": 60},
    )
    assert digests(folder) == digests(tiny("airhockey-hit"))
    assert validate_dataset(folder).ok


@pytest.mark.parametrize("m", [1, 2, 3, 5, 8])
def test_parts_share_no_shard_and_leave_none(job, m):
    tasks = shards(job.spec)
    parts = [make_part(tasks, (k, m)) for k in range(m)]
    assert [task for part in parts for task in part] == tasks
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_force_would_delete_what_other_parts_made(tiny, tmp_path):
    folder = Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "out"))
    before = snapshot(folder)
    with is_refused(UsageError, argument="force"):
        make_tiny(folder, part=(0, 2), force=True)
    assert snapshot(folder) == before


def test_a_part_without_shards_makes_nothing(tmp_path):
    made = make_tiny(tmp_path / "out", part=(0, 7))
    assert (made.made, made.complete) == (0, False)


# --- the spot check ---------------------------------------------------------------------------------------------------


def test_a_shard_that_pinocchio_disagrees_with_is_not_written(tmp_path, monkeypatch):
    honest = make.shard_columns

    def wrong(*arguments):
        for columns, sampling, scenes in honest(*arguments):
            columns["start_q"][-1, 0] += 1e-6
            yield columns, sampling, scenes

    monkeypatch.setattr(make, "shard_columns", wrong)
    with is_refused(MachineError, argument="backend"):
        make_tiny(tmp_path / "out")
    assert not digests(tmp_path / "out")
    monkeypatch.setattr(
        make, "package_of", lambda _group, kind: "my-hits" if kind is StartIK else ""
    )
    with is_refused(MachineError, argument="backend"):
        make_tiny(tmp_path / "out")


def test_the_worst_violation_of_every_check_is_recorded(tiny):
    found = load_manifest(tiny("airhockey-hit"))["verification"]
    assert 0 <= found["tip position"] < 1e-9
    assert {"joint torque", "vertical velocity", "hit direction"} <= set(found)


# --- tasks ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    folder = tmp_path_factory.mktemp("job") / "out"
    job = resolve(
        tiny_recipe("airhockey-hit"), find_workspace(folder), shard_size=TINY_SHARD
    )
    open_workspace(job.folder, job.spec)
    return job


def test_making_a_shard_twice_is_harmless(job):
    task = shards(job.spec)[1]
    (first,) = make_shards(job, [task])
    before = (job.folder / task.file).read_bytes()
    (second,) = make_shards(job, [task])
    assert (job.folder / task.file).read_bytes() == before
    assert first[0] == second[0] == 250
    assert task not in pending(job.folder, job.spec)


def test_shards_are_the_rows_of_their_blocks_made_together_or_with_gaps(job):
    backend, cache = choose_backend()
    prepared = PreparedPipeline(job.pipeline, backend=backend, cache_folder=cache)
    spec = replace(job.spec, splits={"train": 3 * BLOCK_ROWS}, shard_size=1900)
    blocks = [prepared.block(spec.seed, "train", index) for index in range(3)]
    tasks = [task for task in shards(spec) if task.index != 3]
    assert {task.first_row // BLOCK_ROWS for task in tasks} == {0, 1, 2}
    for task, (columns, sampling, _) in zip(
        tasks, shard_columns(prepared, spec, tasks), strict=True
    ):
        rows = slice(task.first_row, task.first_row + task.rows)
        for name, values in columns.items():
            expected = np.concatenate(
                [block.columns[name] for block in blocks], axis=1
            )[:, rows].T
            np.testing.assert_array_equal(
                values, expected if values.ndim == 2 else expected[:, 0]
            )
        assert (sampling.accepted, sampling.tried) == (
            task.rows,
            columns["attempts"].sum(),
        )


@pytest.fixture
def rounds(monkeypatch) -> Counter:
    """Count how often the first draws of every block are made."""
    seen: Counter = Counter()
    chunks = PreparedPipeline.chunks

    def counted(self, seed, split, index, ranges):
        seen[split, index] += 1
        return chunks(self, seed, split, index, ranges)

    monkeypatch.setattr(PreparedPipeline, "chunks", counted)
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("size", some([500, 512, 4095]))
def test_a_block_is_drawn_once_however_small_the_shards(tmp_path, rounds, size):
    recipe = replace(
        load_dataset_recipe("airhockey-hit"),
        splits={"train": 2 * BLOCK_ROWS, "validation": 600},
    )
    made = make_dataset(recipe, tmp_path / "out", shard_size=size, workers=1)
    drawn = sum(rounds.values())
    assert made.complete
    assert drawn == 3


@pytest.mark.slow
def test_small_shards_have_the_rows_and_counts_of_large_ones(large, tmp_path):
    make_dataset(
        "airhockey-replan", tmp_path / "small", n=20_000, shard_size=500, workers=2
    )
    for split in ("train", "validation"):
        found, expected = (
            columns_of(tmp_path / "small", split),
            columns_of(large, split),
        )
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values, err_msg=name)
    one, other = (
        load_manifest(folder)["yield"] for folder in (large, tmp_path / "small")
    )
    assert one == other


def test_a_second_process_is_started_for_many_rows_or_slow_ones_only(job):
    spec = replace(job.spec, backend="compiled", splits={"train": 200_000})
    assert is_quick(spec, shards(spec))
    assert not is_quick(replace(spec, backend="numpy"), shards(spec))
    assert not is_quick(replace(spec, block_rows=64), shards(spec)[:1])
    more = replace(spec, splits={"train": 200_001})
    assert not is_quick(more, shards(more))


@pytest.mark.parametrize("size", [64, 1000, 4096, 5000, 8192, 100_000])
@pytest.mark.parametrize("workers", [1, 2, 16])
def test_runs_are_the_shards_in_order_and_long_enough_to_share_blocks(
    job, size, workers
):
    spec = replace(
        job.spec,
        splits={"train": 100_000, "validation": 5000, "test": 0},
        shard_size=size,
    )
    tasks = shards(spec)
    groups = runs(spec, tasks, workers)
    assert [task for group in groups for task in group] == tasks
    for group in groups:
        assert len({task.split for task in group}) == 1
        assert group[-1].first_row - group[0].first_row < 8 * BLOCK_ROWS
    if size % BLOCK_ROWS == 0:
        assert len(groups) == len(tasks)
    elif size < BLOCK_ROWS:
        assert len(groups) <= 1 + 100_000 // BLOCK_ROWS + 2
        assert len(groups) >= min(4 * workers * (workers > 1), 20)


def test_the_specification_records_the_source_of_the_rows(tiny):
    spec = load_dataset_spec(tiny("airhockey-replan"))
    assert (tiny("airhockey-replan") / SPECIFICATION).is_file()
    assert spec.recipe["pipeline"]["name"] == "airhockey-replan"
    assert spec.robot["joint_names"] == [f"joint_{k}" for k in range(1, 7)]
    assert spec.robot["urdf"].startswith("<?xml") or "<robot" in spec.robot["urdf"]
    assert spec.versions["numpy"] == np.__version__
    assert spec.seed == load_dataset_recipe("airhockey-replan").seed
    assert replace(spec, title="another title").fingerprint == spec.fingerprint
