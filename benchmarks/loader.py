"""Rows per second of the loader, warm, beside its ceiling and beside what people write with torch and h5py.

Every way delivers the same float32 rows, normalised, which are counted and whose column means are compared with the
true ones; slow ways read a part of them. Every repetition runs all ways in turn; rates are medians, ratios medians of
the ratios within one repetition. The best of a way's numbers of workers counts. torch's ways are left out where torch
is not installed.

    python benchmarks/loader.py
    python benchmarks/loader.py --rows 4000000 --batch-size 256
    python benchmarks/loader.py --folder my-dataset
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, median, progress, report, table, verdict
from loader_ways import Reader, Tables, Way

import cnpgen
from cnpgen.loader.dataset import Dataset

SLOW_ROWS = 2 * 1024  # of ways that read row by row
TAKE, OURS, STREAMED = "take, array in memory", "cnpgen", "cnpgen, files read in every epoch"
PER_ROW = ("torch DataLoader, rows by h5py", "torch DataLoader, rows by h5py, 2 workers")


def ways_of(reader: Reader) -> list[Way]:
    """List the ways that work here."""
    rows, slow = reader.rows, min(SLOW_ROWS, reader.rows)
    found = [
        Way(TAKE, "all rows", reader.take, rows),
        Way("h5py, whole shards, raw", "none", reader.shards, reader.dataset.splits["train"], None),
        Way(OURS, "windows", reader.batches, rows),
        Way(STREAMED, "windows", reader.streamed, rows),
        Way(f"{STREAMED}, not shuffled", "none", lambda: reader.streamed(shuffle=False), rows),
    ]
    if find_spec("torch") is None:
        progress("torch is not installed: its ways are left out")
        return found
    return [
        *found,
        Way("torch DataLoader of cnpgen", "windows", lambda: reader.torch_batches(0), rows),
        Way("torch DataLoader of cnpgen, 2 workers", "windows", lambda: reader.torch_batches(2), rows),
        Way("torch DataLoader, rows by cnpgen", "all rows", lambda: reader.torch_rows(0), rows // 4, 0.02),
        Way(PER_ROW[0], "all rows", lambda: reader.torch_per_row(0), slow, 0.1),
        Way(PER_ROW[1], "all rows", lambda: reader.torch_per_row(2), slow, 0.1),
    ]


def consume(tables: Tables, rows: int) -> tuple[int, np.ndarray]:
    """Add up rows until there are enough; return how many there were, and the sums of the columns."""
    seen, sums = 0, np.zeros(1)
    for batch in tables:
        sums = sums + np.ones(len(batch), batch.dtype) @ batch
        seen += len(batch)
        if seen >= rows:
            break
    return seen, sums


def cpu_seconds() -> float:
    """CPU time of this process and of those that it has waited for [s]; ``os.times`` counts in ticks of 10 ms."""
    used = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return sum(each.ru_utime + each.ru_stime for each in used)


def measure(way: Way, mean: np.ndarray) -> None:
    """Read once in this way."""
    cpu, start = cpu_seconds(), time.perf_counter()
    seen, sums = consume(way.read(), way.rows)
    way.walls.append(seen / (time.perf_counter() - start))
    way.cpus.append(seen / (cpu_seconds() - cpu))
    if seen < way.rows:
        raise SystemExit(f"{way.name} gave {seen} rows instead of {way.rows}")
    if way.tolerance is not None and np.abs(sums / seen - mean).max() > way.tolerance:
        raise SystemExit(f"{way.name} gave other rows: the means of its columns are {sums / seen}, not {mean}")


def latency(dataset: Dataset, batch_size: int, *, used: int) -> float:
    """Time to the next batch after a state was loaded in which some batches of the epoch were used [s]."""
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        batches = dataset.batches(batch_size)
        batches.load_state(batches.state(batch=used))
        next(iter(batches))
        seconds.append(time.perf_counter() - start)
    return median(seconds)


def cold(folder: Path, batch_size: int) -> dict[str, float]:
    """Rows per second of a first epoch whose files are not in memory, with and without comparing sha256."""
    found = {}
    for verify in (True, False):
        dataset = cnpgen.load_dataset(folder, verify=verify)
        for shard in dataset.shards["train"]:
            with shard.path.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        start = time.perf_counter()
        seen, _ = consume(Reader(dataset, batch_size).streamed(), dataset.splits["train"] - batch_size)
        found["sha256 compared" if verify else "not compared"] = seen / (time.perf_counter() - start)
    return found


def shuffling(dataset: Dataset) -> dict[str, float]:
    """Say how thorough an epoch's shuffling is; of a uniform permutation of all rows in the second column."""
    rows, shards = dataset.splits["train"], dataset.shards["train"]
    ids = np.concatenate([batch["sample_id"] for batch in dataset.batches(1024, fields=["sample_id"], drop_last=False)])
    of = np.searchsorted(np.cumsum([shard.rows for shard in shards]), ids, side="right")
    return {
        "neighbours of one shard": float(np.mean(of[1:] == of[:-1])),
        "neighbours of one shard, uniform": float(sum((shard.rows / rows) ** 2 for shard in shards)),
        "mean displacement / rows": float(np.abs(ids - np.arange(rows)).mean() / rows),
        "mean displacement / rows, uniform": 1 / 3,
    }


MEMORY = """
import sys
from pathlib import Path
import cnpgen

def peak():
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 1024

dataset = cnpgen.load_dataset(sys.argv[1])
before = peak()
for batch in dataset.batches(int(sys.argv[2])):
    pass
print(peak() - before)
"""


def memory(folder: Path, batch_size: int) -> float:
    """Peak memory that an epoch takes in a process of its own, mapped files included [MiB]; nan but on Linux."""
    if not Path("/proc/self/status").exists():
        return float("nan")
    command = [sys.executable, "-c", MEMORY, str(folder), str(batch_size)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def run(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Measure everything."""
    dataset = cnpgen.load_dataset(folder)
    reader = Reader(dataset, options.batch_size)
    mean, ways = reader.table.mean(axis=0, dtype=np.float64), ways_of(reader)
    for repetition in range(options.repeat + 1):
        for way in ways:
            progress(f"{way.name}, {repetition or 'warming up'}")
            measure(way, mean)
    for way in ways:
        del way.walls[0], way.cpus[0]
    return {
        "dataset": repr(dataset),
        "columns": reader.table.shape[1],
        "ways": [vars(way) | {"read": None} for way in ways],
        "first batch": latency(dataset, options.batch_size, used=0),
        "resumed": latency(dataset, options.batch_size, used=reader.rows // options.batch_size // 2),
        "cold": cold(folder, options.batch_size),
        "memory": memory(folder, options.batch_size),
        "shuffling": shuffling(dataset),
    }


def ratios(ways: dict[str, dict[str, Any]]) -> list[tuple[str, float, float]]:
    """Compare the loader with its targets: what, value, target; a ratio is the median of those of each repetition."""

    def ratio(ours: str, clock: str, other: str) -> float:
        return median(a / b for a, b in zip(ways[ours][clock], ways[other][clock], strict=True))

    found = []
    for name in (OURS, STREAMED):
        found += [
            (f"{name}: rows per second", median(ways[name]["walls"]), 500_000.0),
            (f"{name}: of take, by wall time", ratio(name, "walls", TAKE), 0.25),
            (f"{name}: of take, by CPU time", ratio(name, "cpus", TAKE), 0.25),
        ]
    if per_row := [ratio(STREAMED, "walls", name) for name in PER_ROW if name in ways]:
        found.append((f"{STREAMED}: times torch DataLoader, rows by h5py", min(per_row), 20.0))
    return found


def tables(results: dict[str, Any]) -> list[str]:
    """Lay out what was measured."""
    ways = {way["name"]: way for way in results["ways"]}

    def rate(values: list[float]) -> str:
        return f"{median(values) / 1000:,.1f}"

    rates = [
        (
            name,
            way["order"],
            rate(way["walls"]),
            rate([min(way["walls"])]),
            rate([max(way["walls"])]),
            rate(way["cpus"]),
        )
        for name, way in ways.items()
    ]
    others = [("time to the first batch [ms]", f"{1000 * results['first batch']:.1f}")]
    others += [("time to the next batch, resumed at 50 % [ms]", f"{1000 * results['resumed']:.1f}")]
    others += [(f"cold, {name} [krow/s]", rate([value])) for name, value in results["cold"].items()]
    others += [("memory of an epoch [MiB]", f"{results['memory']:.0f}")]
    others += [(name, f"{value:.3g}") for name, value in results["shuffling"].items()]
    targets = [(name, f"{value:,.3g}", *verdict(value, target)) for name, value, target in ratios(ways)]
    title = f"{results['dataset']}, {results['columns']} columns: thousands of rows per second"
    return [
        table(title, ("way", "shuffled", "median", "min", "max", "per CPU s"), rates, left=2),
        table("targets", ("", "value", "target", ""), targets),
        table("besides", ("", "value"), others),
    ]


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--rows", type=int, default=1_048_576, help="rows of the dataset that is made (default: 2^20)")
    parser.add_argument("--folder", type=Path, help="read this dataset instead of making one")
    parser.add_argument("--batch-size", type=int, default=1024)
    parser.add_argument("--repeat", type=int, default=5)


def main() -> None:
    """Make a dataset, read it."""
    options = arguments(__doc__, add)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary) / "dataset"
        if options.folder is None:
            cnpgen.make_dataset("airhockey-replan", folder, n=options.rows, workers=1)
        results = run(folder, options)
    report(results, tables(results), as_json=options.json)


if __name__ == "__main__":
    main()
