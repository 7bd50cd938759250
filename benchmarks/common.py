"""Shared parts of the benchmarks: description of the machine, medians, tables and ``--json``."""

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from cnpgen.machine.versions import __version__, installed_version, processor_entry

LIBRARIES = ("numpy", "scipy", "casadi", "pin", "coal", "h5py", "joblib")
ROBOT_RECIPES = (
    "panda-cup",
    "panda-scenes",
    "ur5-wipe",
)  # recipes of robots that come with the extra cnpgen[robots]
INSTRUCTION_SETS = ("avx512f", "avx2", "avx", "asimd")  # best first


def arguments(
    text: str | None, add: Callable[[argparse.ArgumentParser], None]
) -> argparse.Namespace:
    """Parse the command line: the options that ``add`` adds, and ``--json``."""
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add(parser)
    parser.add_argument(
        "--json", action="store_true", help="write JSON instead of tables"
    )
    return parser.parse_args()


def machine() -> dict[str, Any]:
    """Describe the machine and its present load."""
    flags = processor_entry("flags", "features").split()
    return {
        "cores": os.cpu_count(),
        "cpu": processor_entry("model name").strip() or platform.machine(),
        "instructions": next(
            (name for name in INSTRUCTION_SETS if name in flags), platform.machine()
        ),
        "load": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "versions": {"cnpgen": __version__}
        | {name: installed_version(name) or "not installed" for name in LIBRARIES},
    }


def machine_line() -> str:
    """Describe the machine in one line."""
    facts = machine()
    versions = ", ".join(f"{name} {value}" for name, value in facts["versions"].items())
    head = f"{facts['cores']} cores, {facts['cpu']}, {facts['instructions']}, load {facts['load']}"
    return f"machine: {head}; Python {facts['python']}, {versions}"


def installed_recipes(names: Iterable[str]) -> list[str]:
    """Return the recipes whose robots are installed; report the others on stderr."""
    recipes = list(names)
    if installed_version("example-robot-data"):
        return recipes
    progress(
        f"without {', '.join(ROBOT_RECIPES)}, which need pip install 'cnpgen[robots]'"
    )
    return [name for name in recipes if name not in ROBOT_RECIPES]


def cpu_of(function: Callable[[], object]) -> float:
    """Return the CPU time of a call [s]."""
    start = time.process_time()
    function()
    return time.process_time() - start


def median(values: Iterable[float]) -> float:
    """Return the median; nan without values."""
    numbers = list(values)
    return statistics.median(numbers) if numbers else float("nan")


def verdict(
    value: float, target: float | None, *, at_most: bool = False
) -> tuple[str, str]:
    """Return a target and whether a value meets it, as cells of a table."""
    if target is None:
        return "", ""
    met = value <= target if at_most else value >= target
    return f"{target:,.10g}", "PASS" if met else "BELOW"


def table(
    title: str, head: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1
) -> str:
    """Format a table: the first ``left`` columns aligned to the left, the others to the right."""
    cells = [tuple(head), *(tuple(row) for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    lines = [
        "  ".join(
            text.ljust(w) if i < left else text.rjust(w)
            for i, (text, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in cells
    ]
    return "\n".join([f"\n{title}", *(line.rstrip() for line in lines)])


def report(results: dict[str, Any], tables: Iterable[str], *, as_json: bool) -> None:
    """Print the results as tables or as JSON."""
    if as_json:
        print(json.dumps({"machine": machine(), **results}, indent=2))
    else:
        print("\n".join([machine_line(), *tables]))


def progress(text: str) -> None:
    """Print a progress message on stderr."""
    print(f"... {text}", file=sys.stderr, flush=True)
