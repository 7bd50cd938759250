"""Cost of large datasets: core-hours, disk, files and memory, extrapolated from small datasets.

A small dataset of each kind is made and checked in this process, with shards of the size of the large dataset. The
clock is the process's CPU time.

    python benchmarks/scale.py
    python benchmarks/scale.py --rows 1e8 --certified 1e7 --sample 262144 --certified-sample 256
"""

import argparse
import resource
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from common import arguments, cpu_of, progress, report, table

import cnpgen
from cnpgen.cli.dry_run import row_bytes
from cnpgen.make.generation_options import GenerationOptions
from cnpgen.make.make_dataset import find_damaged, finish
from cnpgen.store.dataset_spec import default_shard_size, load_dataset_spec, shards
from cnpgen.store.layout import DOCUMENTS

CERTIFIED_BLOCK = 64  # rows


@dataclass(frozen=True)
class Costs:
    """Resources of a dataset.

    Attributes:
        name: Recipe and type.
        rows: Number of rows.
        make: CPU time per row [s].
        check: CPU time per row of the comparison with the records [s].
        deep: CPU time per row of ``validate --deep`` [s].
        finish: CPU time per shard of the manifest [s].
        row_bytes: Bytes per row.
        shard_bytes: Bytes per shard in addition to its rows, with its record.
        shard_rows: Rows per shard.
        memory: Peak memory of the process [MB].
    """

    name: str
    rows: int
    make: float
    check: float
    deep: float
    finish: float
    row_bytes: int
    shard_bytes: float
    shard_rows: int
    memory: float

    @property
    def shards(self) -> int:
        """Number of shards of one split; every further split may add one."""
        return -(-self.rows // self.shard_rows)

    @property
    def bytes(self) -> float:
        """Disk space, without the documents."""
        return self.rows * self.row_bytes + self.shards * self.shard_bytes

    @property
    def files(self) -> int:
        """Number of files: two per shard, and the documents."""
        return 2 * self.shards + len(DOCUMENTS)


def measure(
    name: str, rows: int, sample: int, *, dtype: str = "float64", **options: Any
) -> Costs:
    """Make a small dataset and extrapolate to a large one."""
    block = CERTIFIED_BLOCK if options.get("certify") else 4096
    shard_rows = default_shard_size(rows, block)
    with tempfile.TemporaryDirectory(prefix="cnpgen-scale-") as temporary:
        folder = Path(temporary) / "out"
        generation = GenerationOptions(dtype=dtype)
        settings = {"workers": 1, "shard_size": min(shard_rows, sample), **options}
        cnpgen.make_dataset(
            name,
            Path(temporary) / "first",
            n=block,
            **{**settings, "shard_size": block},
            options=generation,
        )  # compiles kernels
        start_times: list[float] = []  # times after the preparation, which is done once
        cnpgen.make_dataset(
            name,
            folder,
            n=sample,
            **settings,
            options=replace(
                generation, begin=lambda *_: start_times.append(time.process_time())
            ),
        )
        make = time.process_time() - start_times[-1]
        deep = cpu_of(lambda: cnpgen.validate_dataset(folder, deep=True, workers=1))
        spec = load_dataset_spec(folder)
        tasks = shards(spec)
        check = cpu_of(lambda: find_damaged(folder, spec, tasks))
        summed = cpu_of(lambda: finish(folder, spec, "", made=1, exclusive=True))
        size = sum(path.stat().st_size for path in folder.glob("*/*"))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    title = (
        f"{name}, certified"
        if options.get("certify")
        else f"{name}, {options.get('dtype', 'float64')}"
    )
    per_row, width = (make / sample, check / sample, deep / sample), row_bytes(spec)
    overhead = (size - sample * width) / len(tasks)
    return Costs(
        title, rows, *per_row, summed / len(tasks), width, overhead, shard_rows, memory
    )


def rows_of(costs: list[Costs]) -> list[list[str]]:
    return [
        [
            cost.name,
            f"{cost.rows:.0e}",
            f"{1 / cost.make:,.0f}",
            f"{cost.rows * cost.make / 3600:,.2f}",
            f"{cost.rows * cost.deep / 3600:,.2f}",
            f"{cost.rows * cost.check / 60:,.1f}",
            f"{cost.shards * cost.finish / 60:,.2f}",
            f"{cost.bytes / 1e9:,.1f}",
            f"{cost.shard_rows:,}",
            f"{cost.files:,}",
            f"{cost.memory:,.0f}",
        ]
        for cost in costs
    ]


HEAD = (
    "dataset", "rows", "rows per core-second", "core-hours to make", "for --deep", "core-minutes to compare",
    "for the manifest", "disk [GB]", "rows per shard", "files", "memory per worker [MB]",
)  # fmt: skip


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rows", type=float, default=1e8, help="rows of the datasets without plans"
    )
    parser.add_argument(
        "--certified", type=float, default=1e7, help="rows of the certified dataset"
    )
    parser.add_argument(
        "--sample", type=int, default=131072, help="rows of the small datasets"
    )
    parser.add_argument(
        "--certified-sample",
        type=int,
        default=128,
        help="rows of the small certified dataset",
    )


def main() -> None:
    options = arguments(__doc__, add_options)
    costs = []
    for name in ("airhockey-hit", "heavy-object"):
        progress(f"{name}: {options.sample} rows")
        costs.append(measure(name, int(options.rows), options.sample, dtype="float32"))
    progress(f"airhockey-hit: {options.certified_sample} rows with plans")
    costs.append(
        measure(
            "airhockey-hit",
            int(options.certified),
            options.certified_sample,
            certify=True,
        )
    )
    report(
        {"datasets": [asdict(cost) for cost in costs]},
        [table("datasets", HEAD, rows_of(costs))],
        as_json=options.json,
    )


if __name__ == "__main__":
    main()
