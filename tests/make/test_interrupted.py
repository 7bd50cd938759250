"""Making that is cut off: by an exception, a killed process, a full disk. What is committed stays; the rest follows."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import MachineError, UsageError
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.store.layout import MANIFEST
from cnpgen.store.sampling_statistics import SamplingStatistics
from cnpgen.validate.validate_dataset import validate_dataset
from tests.cli.test_interruption import descendants
from tests.conftest import TINY_SHARD, columns_of, some, tiny_recipe
from tests.examples.tiny_datasets import SHARDS, digests, make_tiny
from tests.refusals import is_refused

ROOT = Path(__file__).parents[2]
linux = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")


class Interrupted(Exception):
    pass


def times(folder: Path) -> dict[str, int]:
    return {
        path.name + path.parent.name: path.stat().st_mtime_ns
        for path in folder.glob("*/*.h5")
    }


@pytest.mark.parametrize(
    ("error", "workers"),
    [(KeyboardInterrupt, 2), (Interrupted, 1)]
    + [
        pytest.param(*each, marks=pytest.mark.extended)
        for each in ((KeyboardInterrupt, 1), (Interrupted, 2))
    ],
)
def test_an_interrupted_dataset_is_finished_with_the_same_bytes(
    tiny, tmp_path, workers, error
):
    folder = tmp_path / "out"

    def interrupt(_rows: int, _sampling: SamplingStatistics | None) -> None:
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


CHILD = """
import sys
from dataclasses import replace
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.make.make_dataset import make_dataset
if __name__ == "__main__":
    recipe = replace(load_dataset_recipe("airhockey-hit"), splits={"train": 600, "validation": 60})
    def tell(rows, sampling):
        print(rows, flush=True)
        sys.stdin.readline()
    make_dataset(recipe, sys.argv[1], shard_size=int(sys.argv[3]), workers=int(sys.argv[2]), progress=tell)
    print("finished", flush=True)
"""


@contextmanager
def running(
    folder: Path, *, workers: int, shard_size: int = TINY_SHARD
) -> Iterator[subprocess.Popen]:
    """Run make_dataset in another process, which waits after every shard; it has finished one."""
    command = [sys.executable, "-c", CHILD, str(folder), str(workers), str(shard_size)]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline().strip().isdigit()
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.slow
@linux
@pytest.mark.parametrize("workers", some([2, 1]))
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


@pytest.mark.slow
@linux
def test_a_killed_worker_is_a_machine_error_that_says_to_go_on(tmp_path):
    killed: list[int] = []

    def kill(_rows: int, _sampling: SamplingStatistics | None) -> None:
        if not killed:
            names = {
                pid: Path(f"/proc/{pid}/cmdline").read_text()
                for pid in descendants(os.getpid())
            }
            killed.extend(pid for pid, name in names.items() if "popen_loky" in name)
            for pid in killed:
                os.kill(pid, signal.SIGKILL)

    recipe = replace(
        load_dataset_recipe("airhockey-hit"),
        splits={"train": 12_000, "validation": 1000},
    )
    folder = tmp_path / "out"
    with is_refused(MachineError):
        make_dataset(recipe, folder, shard_size=1000, workers=2, progress=kill)
    assert len(killed) == 2
    assert 1 <= len(digests(folder)) < 13
    assert make_dataset(recipe, folder, workers=1).complete
    make_dataset(recipe, tmp_path / "uncut", shard_size=1000, workers=1)
    assert digests(folder) == digests(tmp_path / "uncut")


@pytest.mark.parametrize(
    "number", some([errno.ENOSPC, errno.EDQUOT, errno.EROFS], 1, "slow")
)
def test_a_full_disk_is_a_machine_error_and_the_dataset_is_finished_later(
    tiny, tmp_path, monkeypatch, number
):
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
    if (
        shutil.which("mount") is None
        or subprocess.run(mount, capture_output=True, check=False).returncode
    ):
        pytest.skip("this user cannot mount a small file system")
    try:
        yield disk
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_disk_that_is_really_full_loses_nothing(tiny, small_disk):
    folder = small_disk / "out"
    (small_disk / "ballast").write_bytes(bytes(750_000))
    with is_refused(MachineError):
        make_tiny(folder)
    assert not (folder / MANIFEST).exists()
    assert not list(folder.rglob("*.tmp"))
    (small_disk / "ballast").unlink()
    made = make_tiny(folder)
    assert made.complete
    assert digests(folder) == digests(tiny("airhockey-hit"))


@pytest.mark.slow
def test_another_dataset_in_the_same_folder_meanwhile_stops_the_first(tmp_path):
    folder = tmp_path / "out"

    def replace_it(_rows: int, _sampling: SamplingStatistics | None) -> None:
        make_dataset(
            tiny_recipe("airhockey-replan"),
            folder,
            shard_size=400,
            workers=1,
            force=True,
        )

    with is_refused(UsageError, argument="out"):
        make_tiny(folder, progress=replace_it)
    assert validate_dataset(folder).ok
    np.testing.assert_equal(len(columns_of(folder)["start_q"]), 600)
