"""Print the tables of docs/benchmarks/planners.md from the archived results of ``cnpgen benchmark``.

    python benchmarks/planner_tables.py [benchmarks/results] [--archive OUT/work]

--archive first replaces the archive by the ``results.csv`` and ``runs.json`` of the suites in a folder of results, for
example that of ``benchmarks/figures.py OUT --pages planners``. Times to plan, motion times and errors are
medians. The tables have the first repetition of every planner.
"""

import argparse
import csv
import gzip
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from common import arguments

from cnpgen.addons.benchmark.result_tables import PYTHON_LOOPS

ARCHIVE = Path(__file__).resolve().parent / "results"
CHALLENGE, NOMINAL = "challenge", "nominal"
ANY_PLANT = "any"
ORDER = (
    *(
        "cnpgen+refine",
        "cnpgen",
        "solve",
        "aqp",
        "trajopt",
        "ruckig",
        "rrtconnect",
        "cbirrt",
    ),
    *("sscbirrt", "drake", "crocoddyl", "sst", "mpc-mpnet"),
)

Rows = list[dict[str, str]]
"""Rows of one planner and plant, with the columns of ``results.csv``."""
Column = tuple[str, Callable[["Suite", str], str]]


class Suite:
    """Archived results of one suite.

    Attributes:
        name: Name of the suite.
        planners: Names of the planners with any plan, in the order of the tables.
        plants: Names of the plants.
    """

    def __init__(self, path: Path) -> None:
        self.name = path.name.removesuffix(".csv.gz")
        with gzip.open(path, "rt", encoding="utf-8", newline="") as file:
            rows = list(
                csv.DictReader(line for line in file if not line.startswith("#"))
            )
        rows = [row for row in rows if row["repetition"] == "0"]
        names = {row["planner"] for row in rows if row["planned"] == "1"}
        self.planners = [name for name in ORDER if name in names]
        self.plants = list(dict.fromkeys(row["plant"] for row in rows if row["plant"]))
        self._rows: dict[tuple[str, str], Rows] = {}
        plans = set()
        for row in rows:
            self._rows.setdefault((row["planner"], row["plant"]), []).append(row)
            plan = row["planner"], row["problem"]
            if plan not in plans:
                plans.add(plan)
                self._rows.setdefault((row["planner"], ANY_PLANT), []).append(row)

    def rows(self, planner: str, plant: str = ANY_PLANT) -> Rows:
        """Return the rows of a planner on a plant; by default one row per problem, for what the plan alone determines.

        A problem without plan has no plant, and counts on each.
        """
        found = self._rows.get((planner, plant), [])
        return (
            found
            if plant == ANY_PLANT
            else [*found, *self._rows.get((planner, ""), [])]
        )

    def count(self, key: str, planner: str, plant: str = ANY_PLANT) -> str:
        """Count the problems with a flag; empty if the plant has executed no plan."""
        if (planner, plant) not in self._rows:
            return ""
        return str(sum(row[key] == "1" for row in self.rows(planner, plant)))

    def numbers(self, key: str, planner: str, plant: str = ANY_PLANT) -> list[float]:
        """Return the known values of a figure."""
        return [float(row[key]) for row in self.rows(planner, plant) if row[key]]

    def median(self, key: str, planner: str, plant: str = ANY_PLANT) -> str:
        """Format the median of a figure; empty without values."""
        numbers = self.numbers(key, planner, plant)
        return number_text(float(np.median(numbers))) if numbers else ""

    def median_and_largest(self, key: str, planner: str, plant: str = ANY_PLANT) -> str:
        """Format median and largest value of a figure; empty without values."""
        numbers = self.numbers(key, planner, plant)
        return (
            f"{number_text(float(np.median(numbers)))}, {number_text(max(numbers))}"
            if numbers
            else ""
        )


def number_text(value: float) -> str:
    """Format a number with three digits, or as an integer with separators from a thousand on."""
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"


def planning_time(suite: Suite, planner: str) -> str:
    """Format the CPU time of planning; an asterisk marks inner loops in Python."""
    return suite.median_and_largest("planning_cpu_ms", planner) + (
        "*" if planner in PYTHON_LOOPS else ""
    )


def pair(key: str, plants: Iterable[str]) -> Callable[[Suite, str], str]:
    """Return a column with the counts on several plants."""
    return lambda suite, planner: ", ".join(
        text for plant in plants if (text := suite.count(key, planner, plant))
    )


def flag(key: str, plant: str = ANY_PLANT) -> Callable[[Suite, str], str]:
    """Return a column with counts."""
    return lambda suite, planner: suite.count(key, planner, plant)


def median(key: str, plant: str = ANY_PLANT) -> Callable[[Suite, str], str]:
    """Return a column with medians."""
    return lambda suite, planner: suite.median(key, planner, plant)


PLANS: tuple[Column, ...] = (
    ("planned", flag("planned")),
    ("valid by the verdict", flag("valid")),
    ("valid by the paper's rules", flag("paper_valid")),
)
TIME: Column = ("CPU time to plan: median, largest [ms]", planning_time)
HIT_TIME: Column = ("time to hit [s]", median("hit_time_s", NOMINAL))
HEIGHT_ERROR: Column = ("height error [mm]", median("plane_error_mm", NOMINAL))
MOTION_TIME: Column = ("motion time [s]", median("duration_s"))
SUCCESS: Column = ("success", flag("success", NOMINAL))
TABLES: dict[str, tuple[Column, ...]] = {
    "hits-81": (
        *PLANS,
        ("success: nominal, Challenge", pair("success", (NOMINAL, CHALLENGE))),
        ("touched the puck early", flag("touched_early", CHALLENGE)),
        TIME,
        HIT_TIME,
        HEIGHT_ERROR,
    ),
    "heavy-100": (
        *PLANS,
        ("at the goal, executed", flag("finished", NOMINAL)),
        SUCCESS,
        TIME,
        MOTION_TIME,
    ),
    "replans-200": (
        *PLANS,
        ("touched the puck early", flag("touched_early", NOMINAL)),
        SUCCESS,
        TIME,
        HIT_TIME,
    ),
    "clutter": (*PLANS[:2], TIME, MOTION_TIME),
}
ARCHIVED = (*TABLES, "hits-110", "replan", "online")


def table(suite: Suite) -> str:
    """Return the Markdown table of a suite: a row per planner."""
    columns = TABLES[suite.name]
    lines = [
        f"| {suite.name} | {' | '.join(text for text, _ in columns)} |",
        f"|{'---|' * (len(columns) + 1)}",
    ]
    lines.extend(
        f"| `{planner}` | {' | '.join(column(suite, planner) for _, column in columns)} |"
        for planner in suite.planners
    )
    return "\n".join(lines)


def archive(results: Path, folder: Path) -> None:
    """Copy the results of all suites into the archive.

    Args:
        results: Folder with one folder per suite.
        folder: The archive.
    """
    folder.mkdir(exist_ok=True)
    for name in ARCHIVED:
        if (results / name / "results.csv").exists():
            text = (results / name / "results.csv").read_bytes()
            (folder / f"{name}.csv.gz").write_bytes(gzip.compress(text, mtime=0))
            shutil.copy(results / name / "runs.json", folder / f"{name}-runs.json")


def main() -> None:
    """Print the tables of all archived suites."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("folder", nargs="?", type=Path, default=ARCHIVE)
        parser.add_argument("--archive", type=Path, metavar="RESULTS")

    given = arguments(__doc__, add)
    if given.archive:
        archive(given.archive, given.folder)
    for name in TABLES:
        path = given.folder / f"{name}.csv.gz"
        if path.exists():
            print(table(Suite(path)), end="\n\n")


if __name__ == "__main__":
    main()
