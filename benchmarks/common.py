"""Shared parts of the benchmarks: the line about the machine, medians, tables and ``--json``."""

import argparse
import json
import os
import platform
import statistics
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cnpgen

LIBRARIES = ("numpy", "scipy", "casadi", "pin", "coal", "h5py", "joblib")
NEED_ROBOTS = ("panda-cup", "ur5-wipe")  # recipes of robots that come with the extra cnpgen[robots]
INSTRUCTION_SETS = ("avx512f", "avx2", "avx", "asimd")  # best first


def arguments(text: str | None, add: Callable[[argparse.ArgumentParser], None]) -> argparse.Namespace:
    """Parse the command line: what ``add`` adds, and ``--json``."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    add(parser)
    parser.add_argument("--json", action="store_true", help="write JSON instead of tables")
    return parser.parse_args()


def machine() -> dict[str, Any]:
    """Describe the machine as it is now."""
    lines = _cpuinfo()
    flags = next((set(line.split()) for line in lines if line.startswith(("flags", "Features"))), set())
    return {
        "cores": os.cpu_count(),
        "cpu": next(
            (line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine()
        ),
        "instructions": next((name for name in INSTRUCTION_SETS if name in flags), platform.machine()),
        "load": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "versions": {"cnpgen": cnpgen.__version__, **{name: _version(name) for name in LIBRARIES}},
    }


def _cpuinfo() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def machine_line() -> str:
    """Describe the machine in a line."""
    found = machine()
    versions = ", ".join(f"{name} {value}" for name, value in found["versions"].items())
    head = f"{found['cores']} cores, {found['cpu']}, {found['instructions']}, load {found['load']}"
    return f"machine: {head}; Python {found['python']}, {versions}"


def at_hand(names: Iterable[str]) -> list[str]:
    """Leave out recipes whose robots are not installed, and say so."""
    chosen = list(names)
    if _version("example-robot-data") != "not installed":
        return chosen
    progress(f"without {', '.join(NEED_ROBOTS)}, which need pip install 'cnpgen[robots]'")
    return [name for name in chosen if name not in NEED_ROBOTS]


def median(values: Iterable[float]) -> float:
    """Median, nan of nothing."""
    numbers = list(values)
    return statistics.median(numbers) if numbers else float("nan")


def verdict(value: float, target: float | None, *, at_most: bool = False) -> tuple[str, str]:
    """Return a target and whether a value meets it, as cells of a table."""
    if target is None:
        return "", ""
    met = value <= target if at_most else value >= target
    return f"{target:,.10g}", "PASS" if met else "BELOW"


def table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1) -> str:
    """Lay out a table: the first ``left`` columns aligned to the left, the others to the right."""
    cells = [tuple(head), *(tuple(row) for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    lines = [
        "  ".join(
            text.ljust(w) if i < left else text.rjust(w) for i, (text, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in cells
    ]
    return "\n".join([f"\n{title}", *(line.rstrip() for line in lines)])


def report(results: dict[str, Any], tables: Iterable[str], *, as_json: bool) -> None:
    """Print what was measured."""
    if as_json:
        print(json.dumps({"machine": machine(), **results}, indent=2))
    else:
        print("\n".join([machine_line(), *tables]))


def progress(text: str) -> None:
    """Say on stderr what is being measured."""
    print(f"... {text}", file=sys.stderr, flush=True)
