"""Measure the CPU time of every test and list the costly ones, which ``pytest -m quick`` leaves out.

``python -m tests.measure_costs [PATH ...]`` runs the tests that no tier excludes and writes ``tests/data/costly.txt``:
one function per line, ``tests/plans/test_plans.py::test_x``, its parameters together. A function that is not listed is quick,
so a new test needs no entry. With paths only the entries of these files change.
"""

import resource
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).parent / "data" / "costly.txt"
MAX_QUICK_S = 0.15  # CPU of one test with its own fixtures and processes


def read_costly() -> frozenset[str]:
    """Read the names of the functions that are not quick."""
    return frozenset(LIST.read_text(encoding="utf-8").split())


def function_of(node_id: str) -> str:
    """Return the name of a test without its parameters."""
    return node_id.partition("[")[0]


class CostMeter:
    """Measure the CPU time of each test, processes that it started and waited for included."""

    def __init__(self) -> None:
        self.costs: dict[str, list[float]] = defaultdict(list)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Add the cost of one test."""
        before = cpu_seconds()
        result = yield
        self.costs[item.nodeid].append(cpu_seconds() - before)
        return result


def cpu_seconds() -> float:
    """Return the CPU time of this process and of those that it waited for."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime
