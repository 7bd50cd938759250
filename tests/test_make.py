"""Making datasets: the same bytes however they are made, whatever happens in between, and nothing lost by mistake."""

import errno
import hashlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import joblib
import numpy as np
import pytest
from conftest import SHIPPED, TINY_SHARD, columns_of, tiny_recipe

from cnpgen import make_shard as make
from cnpgen.errors import MachineError, RecipeError, UsageError
from cnpgen.kernels.library import choose_backend
from cnpgen.library import load_dataset_recipe
from cnpgen.make import make_dataset, plan_dataset, worker_count
from cnpgen.make_shard import Job, make_shard, shard_columns
from cnpgen.outcome import Outcome
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.store.layout import MANIFEST, PLAN
from cnpgen.store.manifest import load_manifest
from cnpgen.store.plan import load_plan, shards
from cnpgen.store.record import pending
from cnpgen.store.workspace import open_workspace
from cnpgen.validation import validate_dataset

ROOT = Path(__file__).parents[1]
SHARDS = 4  # of a tiny dataset: 250, 250 and 100 rows of training, 60 of validation


def digests(folder: Path) -> dict[str, str]:
    """Shard -> sha256."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("*/*.h5"))
    }


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def make_tiny(folder: Path, name: str = "airhockey-hit", **options):
    return make_dataset(tiny_recipe(name), folder, **{"shard_size": TINY_SHARD, "workers": 1, **options})


# --- the same rows however they are made ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_one_worker_and_two_make_the_same_bytes(tiny: Callable[[str], Path], tmp_path, name):
    made = make_tiny(tmp_path / "two", name, workers=2)
    assert (made.made, made.complete) == (660, True)
    assert digests(tmp_path / "two") == digests(tiny(name))
    assert len(digests(tiny(name))) == SHARDS
    assert load_manifest(tmp_path / "two")["fingerprint"] == load_manifest(tiny(name))["fingerprint"]


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


@pytest.mark.parametrize("size", [4096, 20_000, 3000, 5001])
def test_rows_do_not_depend_on_the_size_of_the_shards(large, tmp_path, size):
    make_dataset("airhockey-replan", tmp_path / "other", n=20_000, shard_size=size, workers=1)
    for split in ("train", "validation"):
        found, expected = columns_of(tmp_path / "other", split), columns_of(large, split)
        assert found.keys() == expected.keys()
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values, err_msg=name)
    one, other = (load_manifest(folder)["yield"] for folder in (large, tmp_path / "other"))
    assert one == other


def test_fewer_rows_are_the_first_of_each_split(large, tmp_path):
    make_dataset("airhockey-replan", tmp_path / "few", n=1000, workers=1)
    assert load_plan(tmp_path / "few").splits == {"train": 934, "validation": 66}
    for split, rows in (("train", 934), ("validation", 66)):
        few, many = columns_of(tmp_path / "few", split), columns_of(large, split)
        for name, values in few.items():
            assert len(values) == rows
            np.testing.assert_array_equal(values, many[name][:rows], err_msg=name)


def test_splits_share_no_row(large):
    train, validation = (columns_of(large, split)["goal_xyz"] for split in ("train", "validation"))
    assert not np.isin(train[:, 0], validation[:, 0]).any()


def test_another_seed_makes_other_rows(tiny: Callable[[str], Path], tmp_path):
    make_tiny(tmp_path / "other", seed=7)
    found, expected = columns_of(tmp_path / "other"), columns_of(tiny("airhockey-hit"))
    assert not np.isin(found["start_xyz"][:, 0], expected["start_xyz"][:, 0]).any()


def test_a_pipeline_without_a_dataset_recipe_can_be_made(tmp_path):
    made = make_dataset("airhockey-hit", tmp_path / "a", n=50, workers=1)
    from cnpgen.library import find_recipe

    as_pipeline = make_dataset(find_recipe("pipeline", "airhockey-hit"), tmp_path / "b", n=50, workers=1)
    assert as_pipeline.plan.splits == {"train": 45, "validation": 5}
    assert made.complete
    assert as_pipeline.complete


def test_the_default_folder_is_named_after_the_dataset_and_its_major_version(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert make_dataset(tiny_recipe("airhockey-hit", version="3.1.4"), workers=1).folder == Path("airhockey-hit-v3")
    assert (tmp_path / "airhockey-hit-v3" / MANIFEST).is_file()


def test_planning_writes_nothing(tmp_path):
    job = plan_dataset(tiny_recipe("airhockey-hit"), tmp_path / "out")
    assert sum(job.plan.splits.values()) == 660
    assert list(tmp_path.iterdir()) == []


def test_progress_is_told_of_every_shard_and_its_draws(tmp_path):
    seen: list[tuple[int, Outcome]] = []
    begun: list[tuple[Path, int, int]] = []
    make_tiny(tmp_path / "out", progress=lambda *x: seen.append(x), begin=lambda *x: begun.append(x))
    assert [rows for rows, _ in seen] == [250, 250, 100, 60]
    assert all(outcome.accepted == rows for rows, outcome in seen)
    assert begun == [(tmp_path / "out", 660, 0)]
    total = sum(outcome.tried for _, outcome in seen)
    assert load_manifest(tmp_path / "out")["yield"]["tried"] == total


def test_attempts_of_a_dataset_sum_to_the_draws_of_its_manifest(large):
    manifest = load_manifest(large)
    attempts = [int(columns_of(large, split)["attempts"].sum()) for split in ("train", "validation")]
    assert sum(attempts) == manifest["yield"]["tried"]
    assert manifest["yield"]["tried"] == 20_000 + sum(manifest["yield"]["rejections"].values())


# --- interruptions ----------------------------------------------------------------------------------------------------


class Interrupted(Exception):
    pass


def times(folder: Path) -> dict[str, int]:
    return {path.name + path.parent.name: path.stat().st_mtime_ns for path in folder.glob("*/*.h5")}


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("error", [KeyboardInterrupt, Interrupted])
def test_an_interrupted_dataset_is_finished_with_the_same_bytes(tiny, tmp_path, workers, error):
    folder = tmp_path / "out"

    def interrupt(_rows: int, _outcome: Outcome) -> None:
        raise error

    with pytest.raises(error):
        make_tiny(folder, workers=workers, progress=interrupt)
    assert not (folder / MANIFEST).exists()
    before = times(folder)
    assert 1 <= len(before) <= SHARDS
    made = make_tiny(folder)
    assert made.complete
    assert made.made < 660
    assert digests(folder) == digests(tiny("airhockey-hit"))
    after = times(folder)
    assert sum(after[name] == time for name, time in before.items()) >= 1
    assert not (folder / "_work").exists()


def test_a_finished_dataset_is_left_as_it_is(tmp_path):
    make_tiny(tmp_path / "out")
    before = snapshot(tmp_path / "out")
    made = make_tiny(tmp_path / "out")
    assert (made.made, made.complete) == (0, True)
    assert snapshot(tmp_path / "out") == before


def test_shard_size_and_backend_of_an_unfinished_dataset_are_kept(tmp_path):
    def interrupt(_rows: int, _outcome: Outcome) -> None:
        raise Interrupted

    with pytest.raises(Interrupted):
        make_dataset(
            tiny_recipe("airhockey-hit"), tmp_path, shard_size=77, backend="numpy", workers=1, progress=interrupt
        )
    made = make_dataset(tiny_recipe("airhockey-hit"), tmp_path, workers=1)
    assert made.complete
    assert (made.plan.shard_size, made.plan.backend) == (77, "numpy")


def test_a_lost_shard_is_made_again(tiny, tmp_path):
    folder = Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "out"))
    (folder / "train" / "shard-00001.h5").unlink()
    (folder / "validation" / "shard-00000.json").write_text("{")
    made = make_tiny(folder)
    assert (made.made, made.complete) == (310, True)
    assert digests(folder) == digests(tiny("airhockey-hit"))
    assert validate_dataset(folder).ok


CHILD = """
import sys
from dataclasses import replace
from cnpgen.library import load_dataset_recipe
from cnpgen.make import make_dataset
if __name__ == "__main__":
    recipe = replace(load_dataset_recipe("airhockey-hit"), splits={"train": 600, "validation": 60})
    def tell(rows, outcome):
        print(rows, flush=True)
        sys.stdin.readline()
    make_dataset(recipe, sys.argv[1], shard_size=int(sys.argv[3]), workers=int(sys.argv[2]), progress=tell)
    print("finished", flush=True)
"""


def children(pid: int) -> list[int]:
    """Descendants of a process, by /proc."""
    found: list[int] = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in map(int, path.read_text().split()):
            found += [child, *children(child)]
    return found


@contextmanager
def running(folder: Path, *, workers: int, shard_size: int = TINY_SHARD) -> Iterator[subprocess.Popen]:
    """Run make_dataset in another process, which waits after every shard; it has finished one."""
    command = [sys.executable, "-c", CHILD, str(folder), str(workers), str(shard_size)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline().strip().isdigit()
        offspring = children(process.pid)
        try:
            yield process
        finally:
            process.kill()
            for pid in offspring:  # joblib's workers wait for another five minutes for a parent that is gone
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)


linux = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")


@linux
@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_run_is_finished_with_the_same_bytes(tiny, tmp_path, workers):
    folder = tmp_path / "out"
    with running(folder, workers=workers) as process:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not (folder / MANIFEST).exists()
    assert len(digests(folder)) >= 1
    made = make_tiny(folder)
    assert made.complete
    assert digests(folder) == digests(tiny("airhockey-hit"))
    assert validate_dataset(folder).ok
    assert not (folder / "_work").exists()


@linux
def test_a_killed_worker_is_a_machine_error_that_says_to_go_on(tiny, tmp_path):
    killed: list[int] = []

    def kill(_rows: int, _outcome: Outcome) -> None:
        if not killed:
            workers = [pid for pid in children(os.getpid()) if "popen_loky" in Path(f"/proc/{pid}/cmdline").read_text()]
            killed.extend(workers)
            for pid in workers:
                os.kill(pid, signal.SIGKILL)

    folder = tmp_path / "out"
    with pytest.raises(MachineError, match=r"a worker died .*finished are safe in .*run the same command again"):
        make_tiny(folder, workers=2, shard_size=20, progress=kill)
    assert len(killed) == 2
    assert len(digests(folder)) >= 1
    made = make_tiny(folder, workers=2, shard_size=20)
    assert made.complete
    found, expected = columns_of(folder), columns_of(tiny("airhockey-hit"))
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS])
def test_a_full_disk_is_a_machine_error_and_the_dataset_is_finished_later(tiny, tmp_path, monkeypatch, number):
    folder, calls, flush = tmp_path / "out", [], os.fsync

    def full(descriptor: int) -> None:
        calls.append(descriptor)
        if len(calls) > 10:
            raise OSError(number, os.strerror(number))
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(MachineError, match=os.strerror(number)):
        make_tiny(folder)
    monkeypatch.undo()
    assert not (folder / MANIFEST).exists()
    assert not list(folder.rglob("*.tmp"))
    assert make_tiny(folder).complete
    assert digests(folder) == digests(tiny("airhockey-hit"))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of a megabyte."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("this user cannot mount a small file system")
    try:
        yield disk
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_disk_that_is_really_full_loses_nothing(tiny, tmp_path, small_disk):
    folder = small_disk / "out"
    (small_disk / "ballast").write_bytes(bytes(750_000))
    with pytest.raises(MachineError, match="No space left on device; free some space and run the same command again"):
        make_tiny(folder)
    assert not (folder / MANIFEST).exists()
    assert not list(folder.rglob("*.tmp"))
    (small_disk / "ballast").unlink()
    made = make_tiny(folder)
    assert made.complete
    assert digests(folder) == digests(tiny("airhockey-hit"))


# --- parts of a job array ---------------------------------------------------------------------------------------------


def test_all_parts_of_a_job_array_make_the_dataset_and_the_last_one_finishes_it(tiny, tmp_path):
    folder = tmp_path / "out"
    first = make_tiny(folder, part=(0, 2))
    assert (first.made, first.complete) == (350, False)
    assert not (folder / MANIFEST).exists()
    second = make_tiny(folder, part=(1, 2))
    assert (second.made, second.complete) == (310, True)
    assert digests(folder) == digests(tiny("airhockey-hit"))
    assert validate_dataset(folder).ok


def test_force_would_delete_what_other_parts_made(tiny, tmp_path):
    folder = Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "out"))
    before = snapshot(folder)
    with pytest.raises(UsageError, match="--force would delete what the other parts have made"):
        make_tiny(folder, part=(0, 2), force=True)
    assert snapshot(folder) == before


def test_a_part_without_shards_makes_nothing(tmp_path):
    made = make_tiny(tmp_path / "out", part=(6, 7))
    assert (made.made, made.complete) == (0, False)


# --- folders that hold something else ---------------------------------------------------------------------------------


CHANGES = {
    "seed": {"seed": 1},
    "dtype": {"dtype": "float32"},
    "backend": {"backend": "numpy"},
    "shard_size": {"shard_size": 100},
}


@pytest.mark.parametrize("what", CHANGES)
def test_another_dataset_in_the_folder_is_refused_and_not_touched(tiny, tmp_path, what):
    folder = Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "out"))
    if CHANGES[what] == {"backend": load_plan(folder).backend}:
        pytest.skip("this is the only backend here")
    before = snapshot(folder)
    with pytest.raises(UsageError, match=f"holds another dataset .*{what} .* instead of .*--force"):
        make_tiny(folder, **CHANGES[what])
    assert snapshot(folder) == before


def test_another_recipe_in_the_folder_is_refused_and_not_touched(tiny, tmp_path):
    folder = Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "out"))
    before = snapshot(folder)
    with pytest.raises(UsageError, match="name airhockey-hit instead of heavy-object"):
        make_tiny(folder, "heavy-object")
    assert snapshot(folder) == before


def test_force_replaces_another_dataset(tiny, tmp_path):
    folder = Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "out"))
    made = make_tiny(folder, "airhockey-replan", force=True, shard_size=400)
    assert made.complete
    assert validate_dataset(folder).ok
    assert sorted(digests(folder)) == ["train/shard-00000.h5", "train/shard-00001.h5", "validation/shard-00000.h5"]


@pytest.mark.parametrize("force", [False, True])
def test_a_folder_that_is_no_dataset_is_refused_and_not_touched(tmp_path, force):
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "shard-00000.h5").write_text("somebody else's")
    before = snapshot(tmp_path)
    with pytest.raises(UsageError, match=r"not a dataset of cnpgen|not empty"):
        make_tiny(tmp_path, force=force)
    assert snapshot(tmp_path) == before


def test_force_does_not_delete_a_dataset_with_foreign_files(tiny, tmp_path):
    folder = Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "out"))
    (folder / "train" / "notes.txt").write_text("mine")
    before = snapshot(folder)
    with pytest.raises(UsageError, match=r"train/notes\.txt, which is not part of the dataset"):
        make_tiny(folder, seed=3, force=True)
    assert snapshot(folder) == before


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(UsageError, match="is a file, not a folder"):
        make_tiny(tmp_path / "out")


WRONG = {
    "n": ({"n": 0}, "n must be between 1 and"),
    "negative n": ({"n": -5}, "n must be between 1 and"),
    "seed": ({"seed": -1}, "seed must not be negative, got -1"),
    "shard size": ({"shard_size": 0}, "shard size must be at least 1, got 0"),
    "dtype": ({"dtype": "float16"}, "dtype must be 'float64' or 'float32', got 'float16'"),
    "backend": ({"backend": "cuda"}, "backend 'cuda' does not exist"),
    "workers": ({"workers": 0}, "workers must be at least 1, got 0"),
    "part beyond the last": ({"part": (2, 2)}, "part must be K/M with 0 <= K < M, got 2/2|--force would delete"),
    "part of nothing": ({"part": (0, 0)}, "part must be K/M|--force would delete"),
}


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("what", WRONG)
def test_arguments_that_make_no_sense_are_refused_before_anything_is_touched(tiny, tmp_path, what, force):
    folder = Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "out"))
    before = snapshot(folder)
    options, text = WRONG[what]
    with pytest.raises(UsageError, match=text):
        make_tiny(folder, force=force, **options)
    assert snapshot(folder) == before


def test_a_recipe_that_does_not_exist_is_a_recipe_error(tmp_path):
    with pytest.raises(RecipeError, match="airhockey-replan"):
        make_dataset("airhockey-replay", tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- the spot check ---------------------------------------------------------------------------------------------------


def test_a_shard_that_pinocchio_disagrees_with_is_not_written(tmp_path, monkeypatch):
    honest = make.shard_columns

    def wrong(*arguments):
        columns, outcome = honest(*arguments)
        columns["start_q"][-1, 0] += 1e-6
        return columns, outcome

    monkeypatch.setattr(make, "shard_columns", wrong)
    with pytest.raises(MachineError, match=r"row 249 of split 'train' fails Pinocchio's check .*try another --backend"):
        make_tiny(tmp_path / "out")
    assert not digests(tmp_path / "out")


def test_the_worst_violation_of_every_check_is_recorded(tiny):
    found = load_manifest(tiny("airhockey-hit"))["verification"]
    assert 0 <= found["tip position"] < 1e-9
    assert {"joint torque", "vertical velocity", "hit direction"} <= set(found)


# --- tasks ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    folder = tmp_path_factory.mktemp("job") / "out"
    job = plan_dataset(tiny_recipe("airhockey-hit"), folder, shard_size=TINY_SHARD)
    open_workspace(job.folder, job.plan)
    return job


def test_running_a_task_twice_is_harmless(job):
    task = shards(job.plan)[1]
    first = make_shard(job, task)
    before = (job.folder / task.file).read_bytes()
    second = make_shard(job, task)
    assert (job.folder / task.file).read_bytes() == before
    assert first[0] == second[0] == 250
    assert task not in pending(job.folder, job.plan)


def test_a_shard_is_the_rows_of_its_blocks(job):
    backend, cache = choose_backend()
    prepared = PreparedPipeline(job.pipeline, backend=backend, cache_folder=cache)
    block = prepared.block(job.plan.seed, "train", 0, stop=600)
    for task in shards(job.plan)[:3]:
        columns, outcome = shard_columns(prepared, job.plan, task)
        rows = slice(task.first_row, task.first_row + task.rows)
        for name, values in columns.items():
            expected = block.columns[name][:, rows].T
            np.testing.assert_array_equal(values, expected if values.ndim == 2 else expected[:, 0])
        assert outcome.accepted == task.rows


def test_there_are_no_more_workers_than_tasks(monkeypatch):
    assert worker_count(8, 3) == 3
    assert worker_count(2, 300) == 2
    assert worker_count(5, 0) == 1
    assert 1 <= worker_count(None, 1000) <= (os.cpu_count() or 1)


def test_the_plan_says_what_the_rows_came_from(tiny):
    plan = load_plan(tiny("airhockey-replan"))
    assert (tiny("airhockey-replan") / PLAN).is_file()
    assert plan.recipe["pipeline"]["name"] == "airhockey-replan"
    assert plan.robot["joint_names"] == [f"joint_{k}" for k in range(1, 7)]
    assert plan.robot["urdf"].startswith("<?xml") or "<robot" in plan.robot["urdf"]
    assert plan.versions["numpy"] == np.__version__
    assert plan.seed == load_dataset_recipe("airhockey-replan").seed
    assert replace(plan, title="another title").fingerprint == plan.fingerprint
