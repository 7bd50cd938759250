"""Rows per second of the loader, with warm files, compared with an upper bound and with torch and h5py.

Every method yields the same normalized float32 rows, slow methods only a part. Rows are counted, and their column means
are compared with the true ones. Every repetition runs all methods in turn. Rates are medians, ratios are medians of the
ratios within one repetition. The best number of workers of a method counts. Methods of torch need torch.

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
from loader_methods import Method, Reader, Tables

import cnpgen
from cnpgen.loader.batch_options import BatchOptions
from cnpgen.loader.dataset import Dataset

SLOW_ROWS = 2 * 1024  # of methods that read row by row
TAKE, OURS, STREAMED = (
    "take, array in memory",
    "cnpgen",
    "cnpgen, files read in every epoch",
)
PER_ROW = (
    "torch DataLoader, rows by h5py",
    "torch DataLoader, rows by h5py, 2 workers",
)


def methods_of(reader: Reader) -> list[Method]:
    """List the methods whose libraries are installed."""
    rows, slow_rows = reader.rows, min(SLOW_ROWS, reader.rows)
    methods = [
        Method(TAKE, "all rows", reader.take, rows),
        Method(
            "h5py, whole shards, raw",
            "none",
            reader.shards,
            reader.dataset.splits["train"],
            None,
        ),
        Method(OURS, "windows", reader.batches, rows),
        Method(STREAMED, "windows", reader.streamed, rows),
        Method(
            f"{STREAMED}, not shuffled",
            "none",
            lambda: reader.streamed(options=BatchOptions(shuffle=False)),
            rows,
        ),
    ]
    if find_spec("torch") is None:
        progress("torch is not installed: its methods are omitted")
        return methods
    return [
        *methods,
        Method(
            "torch DataLoader of cnpgen",
            "windows",
            lambda: reader.torch_batches(0),
            rows,
        ),
        Method(
            "torch DataLoader of cnpgen, 2 workers",
            "windows",
            lambda: reader.torch_batches(2),
            rows,
        ),
        Method(
            "torch DataLoader, rows by cnpgen",
            "all rows",
            lambda: reader.torch_rows(0),
            rows // 4,
            0.02,
        ),
        Method(PER_ROW[0], "all rows", lambda: reader.torch_per_row(0), slow_rows, 0.1),
        Method(PER_ROW[1], "all rows", lambda: reader.torch_per_row(2), slow_rows, 0.1),
    ]


def consume(tables: Tables, rows: int) -> tuple[int, np.ndarray]:
    """Read at least ``rows`` rows; return their number and the sums of the columns."""
    seen, sums = 0, np.zeros(1)
    for batch in tables:
        sums = sums + np.ones(len(batch), batch.dtype) @ batch
        seen += len(batch)
        if seen >= rows:
            break
    return seen, sums


def cpu_seconds() -> float:
    """Return the CPU time of this process and of its ended children [s]; ``os.times`` has a resolution of 10 ms."""
    used = (
        resource.getrusage(resource.RUSAGE_SELF),
        resource.getrusage(resource.RUSAGE_CHILDREN),
    )
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def measure(method: Method, mean: np.ndarray) -> None:
    """Read once with a method."""
    cpu, start = cpu_seconds(), time.perf_counter()
    seen, sums = consume(method.read(), method.rows)
    method.walls.append(seen / (time.perf_counter() - start))
    method.cpus.append(seen / (cpu_seconds() - cpu))
    if seen < method.rows:
        raise SystemExit(f"{method.name} yields {seen} rows instead of {method.rows}")
    if (
        method.tolerance is not None
        and np.abs(sums / seen - mean).max() > method.tolerance
    ):
        raise SystemExit(
            f"{method.name} yields other rows: the means of its columns are {sums / seen}, not {mean}"
        )


def latency(dataset: Dataset, batch_size: int, *, used: int) -> float:
    """Measure the time to the next batch after loading a state in which some batches are used [s]."""
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        batches = dataset.batches(batch_size)
        batches.load_state(batches.state(batch=used))
        next(iter(batches))
        seconds.append(time.perf_counter() - start)
    return median(seconds)


def cold(folder: Path, batch_size: int) -> dict[str, float]:
    """Measure the rows per second of a first epoch from disk, with and without comparing sha256."""
    rates = {}
    for verify in (True, False):
        dataset = cnpgen.load_dataset(folder, verify=verify)
        for shard in dataset.shards["train"]:
            with shard.path.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        start = time.perf_counter()
        seen, _ = consume(
            Reader(dataset, batch_size).streamed(), dataset.splits["train"] - batch_size
        )
        rates["sha256 compared" if verify else "not compared"] = seen / (
            time.perf_counter() - start
        )
    return rates


def shuffling(dataset: Dataset) -> dict[str, float]:
    """Measure the shuffling of an epoch; return the values of a uniform permutation, too."""
    rows, shards = dataset.splits["train"], dataset.shards["train"]
    ids = np.concatenate(
        [
            batch["sample_id"]
            for batch in dataset.batches(
                1024, fields=["sample_id"], options=BatchOptions(drop_last=False)
            )
        ]
    )
    shard_of = np.searchsorted(
        np.cumsum([shard.rows for shard in shards]), ids, side="right"
    )
    return {
        "neighbours of one shard": float(np.mean(shard_of[1:] == shard_of[:-1])),
        "neighbours of one shard, uniform": float(
            sum((shard.rows / rows) ** 2 for shard in shards)
        ),
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
    """Return the peak memory of an epoch in a separate process, with mapped files [MiB]; nan except on Linux."""
    if not Path("/proc/self/status").exists():
        return float("nan")
    command = [sys.executable, "-c", MEMORY, str(folder), str(batch_size)]
    return float(
        subprocess.run(command, check=True, capture_output=True, text=True).stdout
    )


def run(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Run all measurements."""
    dataset = cnpgen.load_dataset(folder)
    reader = Reader(dataset, options.batch_size)
    mean, methods = reader.table.mean(axis=0, dtype=np.float64), methods_of(reader)
    for repetition in range(options.repeat + 1):
        for method in methods:
            progress(f"{method.name}, {repetition or 'warm-up'}")
            measure(method, mean)
    for method in methods:
        del method.walls[0], method.cpus[0]
    return {
        "dataset": repr(dataset),
        "columns": reader.table.shape[1],
        "methods": [vars(method) | {"read": None} for method in methods],
        "first batch": latency(dataset, options.batch_size, used=0),
        "resumed": latency(
            dataset, options.batch_size, used=reader.rows // options.batch_size // 2
        ),
        "cold": cold(folder, options.batch_size),
        "memory": memory(folder, options.batch_size),
        "shuffling": shuffling(dataset),
    }


def ratios(methods: dict[str, dict[str, Any]]) -> list[tuple[str, float, float]]:
    """Return (figure, value, target) of the loader; ratios are medians of the ratios of the repetitions."""

    def ratio(ours: str, clock: str, other: str) -> float:
        return median(
            a / b
            for a, b in zip(methods[ours][clock], methods[other][clock], strict=True)
        )

    figures = []
    for name in (OURS, STREAMED):
        figures += [
            (f"{name}: rows per second", median(methods[name]["walls"]), 500_000.0),
            (f"{name}: of take, by wall time", ratio(name, "walls", TAKE), 0.25),
            (f"{name}: of take, by CPU time", ratio(name, "cpus", TAKE), 0.25),
        ]
    if per_row := [
        ratio(STREAMED, "walls", name) for name in PER_ROW if name in methods
    ]:
        figures.append(
            (f"{STREAMED}: times torch DataLoader, rows by h5py", min(per_row), 20.0)
        )
    return figures


def tables(results: dict[str, Any]) -> list[str]:
    """Return all tables."""
    methods = {method["name"]: method for method in results["methods"]}

    def rate(values: list[float]) -> str:
        return f"{median(values) / 1000:,.1f}"

    rates = [
        (
            name,
            method["order"],
            rate(method["walls"]),
            rate([min(method["walls"])]),
            rate([max(method["walls"])]),
            rate(method["cpus"]),
        )
        for name, method in methods.items()
    ]
    figures = [("time to the first batch [ms]", f"{1000 * results['first batch']:.1f}")]
    figures += [
        (
            "time to the next batch, resumed at 50 % [ms]",
            f"{1000 * results['resumed']:.1f}",
        )
    ]
    figures += [
        (f"cold, {name} [krow/s]", rate([value]))
        for name, value in results["cold"].items()
    ]
    figures += [("memory of an epoch [MiB]", f"{results['memory']:.0f}")]
    figures += [(name, f"{value:.3g}") for name, value in results["shuffling"].items()]
    targets = [
        (name, f"{value:,.3g}", *verdict(value, target))
        for name, value, target in ratios(methods)
    ]
    title = f"{results['dataset']}, {results['columns']} columns: thousands of rows per second"
    return [
        table(
            title,
            ("method", "shuffled", "median", "min", "max", "per CPU s"),
            rates,
            left=2,
        ),
        table("targets", ("", "value", "target", ""), targets),
        table("other figures", ("", "value"), figures),
    ]


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--rows",
        type=int,
        default=1_048_576,
        help="rows of the generated dataset (default: 2^20)",
    )
    parser.add_argument(
        "--folder", type=Path, help="read this dataset instead of a generated one"
    )
    parser.add_argument("--batch-size", type=int, default=1024)
    parser.add_argument("--repeat", type=int, default=5)


def main() -> None:
    """Run the benchmark."""
    options = arguments(__doc__, add)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary) / "dataset"
        if options.folder is None:
            cnpgen.make_dataset("airhockey-replan", folder, n=options.rows, workers=1)
        results = run(folder, options)
    report(results, tables(results), as_json=options.json)


if __name__ == "__main__":
    main()
