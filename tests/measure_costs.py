"""Measure the CPU time of tests and list the costly ones, which ``pytest -m quick`` leaves out.

``python -m tests.measure_costs [PATH ...]`` runs the tests without the tiers ``slow`` and
``extended`` and writes ``tests/data/costly.txt``: one function a line, with all its
parameters. A function that is not listed is quick, so a new test needs no entry. With
paths only the entries of these files change.

A value that several tests share (``functools.cache``, a dataset) is paid by the first of
them. Without that test the next one pays, so the quick tests are measured once more, and
those that pay for much are listed, too.
"""

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).parent / "data" / "costly.txt"
RESULT = "CNPGEN_TEST_COSTS"  # environment variable: file of the measured costs
# CPU time of a quick test, the mean of the parameters of its function.
MAX_MEAN_S = 0.05
MAX_SUM_S = 0.5  # of all parameters of a function
MAX_SHARED_S = 0.3  # of a quick test that pays for what others share


def read_costly() -> frozenset[str]:
    """Read the names of the functions that are not quick."""
    return frozenset(LIST.read_text(encoding="utf-8").split())


def write_costly(names: Iterable[str]) -> None:
    """Write the names of the functions that are not quick."""
    text = "".join(f"{name}\n" for name in sorted(names))
    LIST.write_text(text, encoding="utf-8")


def function_of(node_id: str) -> str:
    """Return the name of a test without its parameters."""
    return node_id.partition("[")[0]


def costly(
    costs: Mapping[str, float], max_mean: float, max_sum: float = math.inf
) -> set[str]:
    """Return the functions whose tests need too much CPU time, from node ID -> time [s]."""
    times: dict[str, list[float]] = defaultdict(list)
    for node_id, cost in costs.items():
        times[function_of(node_id)].append(cost)
    return {
        name
        for name, values in times.items()
        if sum(values) > min(max_sum, max_mean * len(values))
    }


class CostMeter:
    """Measures tests; a fixture of a module or session counts for every test that uses it."""

    def __init__(self) -> None:
        self.costs: dict[str, float] = {}
        self._fixtures: dict[tuple[str, str], float] = defaultdict(float)
        self._shared = 0.0  # CPU time of shared fixtures within the present test [s]

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """Measure a fixture that several tests share."""
        before, shared = cpu_time(), self._shared
        try:
            return (yield)
        finally:
            own = cpu_time() - before - (self._shared - shared)
            if fixturedef.scope != "function":
                self._fixtures[_key(fixturedef)] += own
                self._shared += own

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Function) -> Iterator[None]:
        """Measure a test."""
        before, self._shared = cpu_time(), 0.0
        result = yield
        own = cpu_time() - before - self._shared
        used = item._fixtureinfo.name2fixturedefs.values()
        fixtures = sum(self._fixtures[_key(found[-1])] for found in used)
        self.costs[item.nodeid] = own + fixtures
        return result

    def pytest_sessionfinish(self) -> None:
        """Write the costs for the process that started this one."""
        Path(os.environ[RESULT]).write_text(json.dumps(self.costs), encoding="utf-8")


def _key(fixturedef: Any) -> tuple[str, str]:
    """Identify a fixture: modules have fixtures of the same name."""
    return fixturedef.baseid, fixturedef.argname


def cpu_time() -> float:
    """Return the CPU time of this process and of those that it waited for [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def pytest_configure(config: pytest.Config) -> None:
    """Register the meter in the processes that ``measure`` starts."""
    if RESULT in os.environ:
        config.pluginmanager.register(CostMeter())


def measure(tier: str, paths: Iterable[str]) -> dict[str, float]:
    """Run the tests of a tier in a new process; return node ID -> CPU time [s]."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "costs.json"
        command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.measure_costs"]
        subprocess.run(
            [*command, "-m", tier, *paths],
            cwd=ROOT,
            env=os.environ | {RESULT: str(file)},
            check=False,  # a test that fails has its cost, too
        )
        costs: dict[str, float] = json.loads(file.read_text(encoding="utf-8"))
    return costs


def main(paths: list[str]) -> None:
    """Write the list."""
    costs = measure("not slow and not extended", paths)
    measured = {function_of(node_id) for node_id in costs}
    listed = set(read_costly() - measured if paths else ())
    listed |= costly(costs, MAX_MEAN_S, MAX_SUM_S)
    write_costly(listed)
    write_costly(listed | costly(measure("quick", paths), MAX_SHARED_S))
    quick = [node_id for node_id in costs if function_of(node_id) not in read_costly()]
    print(f"{len(quick) / len(costs):.0%} of {len(costs)} tests are quick")


if __name__ == "__main__":
    main(sys.argv[1:])
