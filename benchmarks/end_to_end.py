"""Wall time of whole ``cnpgen make-dataset`` processes: the documentation's table of datasets and its memory figures.

Every repetition runs all cases in turn; times are medians. "Warm" runs load their kernels from the cache; "empty" runs
have a new ``CNPGEN_CACHE`` and build and compile them. The start-up table has the time of every step before the first
row.

    python benchmarks/end_to_end.py
    python benchmarks/end_to_end.py --large 10000000    memory of the workers over time (0.35 GB per million rows)
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from common import arguments, median, progress, report, table, verdict
from process_memory import MARKS, Sample, sample_memory

STEPS = (  # before the first row
    ("Python", "pass"),
    ("NumPy", "import numpy"),
    ("cnpgen.make.make_dataset", "import cnpgen.make.make_dataset"),
    (
        "recipe",
        "from cnpgen.make.recipe import load_dataset_recipe; recipe = load_dataset_recipe({name!r})",
    ),
    ("Pinocchio, Coal", "import pinocchio, coal"),
    (
        "kernels, specification",
        "from pathlib import Path; place = cnpgen.make.make_dataset.find_workspace(Path({out!r}));"
        " cnpgen.make.make_dataset.resolve(recipe, place)",
    ),
    ("h5py", "import h5py"),
    ("joblib", "from joblib import Parallel, delayed"),
    ("2 workers", "Parallel(n_jobs=2)(delayed(abs)(i) for i in range(2))"),
    (
        "cnpgen in workers",
        "Parallel(n_jobs=2)(delayed(cnpgen.make.make_dataset.resolve)(recipe, place) for i in range(2))",
    ),
)


@dataclass
class Case:
    """A dataset that is made repeatedly.

    Attributes:
        walls: Wall times [s].
        cpus: CPU times of all its processes [s].
    """

    name: str
    rows: int
    workers: int
    warm: bool
    target: float | None = None  # s
    walls: list[float] = field(default_factory=list)
    cpus: list[float] = field(default_factory=list)

    @property
    def wall(self) -> float:
        """Median wall time [s]."""
        return median(self.walls)

    def run(self, folder: Path) -> None:
        """Make the dataset once."""
        cache = (
            Path(tempfile.mkdtemp(prefix="empty-cache-", dir=folder))
            if not self.warm
            else folder / "cache"
        )
        with tempfile.TemporaryDirectory(dir=folder) as out:
            command = make_command(
                self.name, self.rows, self.workers, Path(out) / "dataset"
            )
            before, start = _children(), time.perf_counter()
            subprocess.run(
                command, check=True, capture_output=True, env=environment(cache)
            )
            self.walls.append(time.perf_counter() - start)
            self.cpus.append(_children() - before)


CASES = (
    Case("airhockey-replan", 120_000, 2, True, 5.0),
    Case("airhockey-replan", 120_000, 1, True),
    Case("heavy-object", 26_400, 2, True),
    Case("heavy-object", 26_400, 1, True),
    Case("airhockey-hit", 19_800, 2, True),
    Case("airhockey-hit", 19_800, 1, True),
    Case("airhockey-replan", 120_000, 2, False, 20.0),
    Case("heavy-object", 26_400, 2, False),
    Case("airhockey-hit", 19_800, 2, False),
)


def make_command(name: str, rows: int, workers: int, out: Path) -> list[str]:
    """Return the command that makes a dataset."""
    options = [
        "--n",
        str(rows),
        "--workers",
        str(workers),
        "--out",
        str(out),
        "--quiet",
    ]
    return [sys.executable, "-m", "cnpgen", "make-dataset", name, *options]


def environment(cache: Path) -> dict[str, str]:
    """Return the environment of a run; modules keep their bytecode, like those of an installed package."""
    variables = {
        name: value
        for name, value in os.environ.items()
        if name != "PYTHONDONTWRITEBYTECODE"
    }
    return variables | {"CNPGEN_CACHE": str(cache)}


def _children() -> float:
    """Return the CPU time of all processes that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def measure(folder: Path, repeat: int, cold: int) -> list[Case]:
    """Run the warm cases ``repeat`` times in turn, the others ``cold`` times."""
    for case in CASES:
        if case.warm:
            case.run(folder)  # fills the cache
            case.walls.clear()
            case.cpus.clear()
    for number in range(max(repeat, cold)):
        progress(f"repetition {number + 1} of {max(repeat, cold)}")
        for case in CASES:
            if number < (repeat if case.warm else cold):
                case.run(folder)
    return list(CASES)


def measure_start(folder: Path, name: str, repeat: int) -> dict[str, float]:
    """Run the steps of a start in a new process; return the time of each [s]."""
    lines = [
        line.format(name=name, out=str(folder / "none")) + "; print(time.time())"
        for _, line in STEPS
    ]
    command = [sys.executable, "-c", "\n".join(["import time", *lines])]
    clocks: list[list[float]] = []
    for _ in range(repeat):
        start = time.time()
        done = subprocess.run(
            command,
            check=True,
            stdout=subprocess.PIPE,
            env=environment(folder / "cache"),
            text=True,
        )
        clocks.append([start, *map(float, done.stdout.split())])
    return {
        step: median(times[number] - times[number - 1] for times in clocks)
        for number, (step, _) in enumerate(STEPS, start=1)
    }


def case_table(cases: list[Case]) -> str:
    rows = []
    for case in cases:
        single = next(
            (
                c
                for c in cases
                if (c.name, c.workers, c.warm) == (case.name, 1, case.warm)
            ),
            None,
        )
        pairs = (
            zip(case.walls, single.walls, strict=True)
            if single and single is not case
            else ()
        )
        ratio = median(a / b for a, b in pairs)
        rows.append(
            (
                *(
                    case.name,
                    f"{case.rows:,}",
                    str(case.workers),
                    "warm" if case.warm else "empty",
                ),
                *(
                    f"{case.wall:.2f}",
                    f"{min(case.walls):.2f}",
                    f"{median(case.cpus):.2f}",
                ),
                f"{case.rows / case.wall:,.0f}",
                "" if ratio != ratio else f"{ratio:.2f}",
                *verdict(case.wall, case.target, at_most=True),
            )
        )
    head = (
        "dataset", "rows", "workers", "cache", "wall [s]", "best", "CPU [s]", "rows/s", "wall / 1 worker", "target",
        "",
    )  # fmt: skip
    return table("Whole processes, wall time (median)", head, rows)


def start_table(name: str, steps: dict[str, float]) -> str:
    rows = [(step, f"{1e3 * seconds:.0f}") for step, seconds in steps.items()]
    rows.append(("sum", f"{1e3 * sum(steps.values()):.0f}"))
    return table(
        f"Start-up of {name}, warm: wall time of each step (median)",
        ("step", "ms"),
        rows,
    )


def run_large(folder: Path, rows: int) -> tuple[float, list[Sample]]:
    """Make a large dataset once; return its wall time [s] and the samples of memory."""
    Case("airhockey-replan", 1000, 1, True).run(folder)  # fills the cache
    out = folder / "large"
    command = make_command("airhockey-replan", rows, 2, out)
    start = time.perf_counter()
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, env=environment(folder / "cache")
    ) as process:
        samples = sample_memory(process, out, rows)
    if process.returncode:
        sys.exit(f"make-dataset failed with exit code {process.returncode}")
    return time.perf_counter() - start, samples


def large_table(rows: int, wall: float, samples: list[Sample]) -> str:
    lines = [
        (
            f"{mark:.0%}",
            f"{sample.seconds:.1f}",
            str(pid),
            kind,
            f"{peak:.1f}",
            f"{now:.1f}",
        )
        for mark, sample in zip(MARKS, samples, strict=True)
        for pid, (kind, peak, now) in sample.peaks.items()
    ]
    head = ("rows", "after [s]", "process", "", "peak RSS [MiB]", "RSS [MiB]")
    title = f"airhockey-replan, {rows:,} rows, 2 workers: {wall:.1f} s, {rows / wall:,.0f} rows/s"
    return table(title, head, lines)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--repeat", type=int, default=5, help="runs with a warm cache")
    parser.add_argument("--cold", type=int, default=2, help="runs with an empty cache")
    parser.add_argument(
        "--large",
        type=int,
        metavar="N",
        help="make N rows and measure the workers' memory instead",
    )
    parser.add_argument(
        "--folder",
        type=Path,
        help="folder of the datasets, which are deleted; default a temporary one",
    )


def main() -> None:
    options = arguments(__doc__, add_options)
    with tempfile.TemporaryDirectory(
        prefix="cnpgen-benchmark-", dir=options.folder
    ) as name:
        folder = Path(name)
        if options.large:
            wall, samples = run_large(folder, options.large)
            results: dict[str, Any] = {
                "rows": options.large,
                "wall": wall,
                "samples": [vars(s) for s in samples],
            }
            report(
                results,
                [large_table(options.large, wall, samples)],
                as_json=options.json,
            )
            return
        cases = measure(folder, options.repeat, options.cold)
        steps = measure_start(folder, "airhockey-replan", options.repeat)
    results = {"cases": [vars(case) for case in cases], "start": steps}
    report(
        results,
        [case_table(cases), start_table("airhockey-replan", steps)],
        as_json=options.json,
    )


if __name__ == "__main__":
    main()
