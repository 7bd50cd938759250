"""All planners: one problem of each kind here, whole suites with their targets in the extended run."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.benchmark.benchmark_options import BenchmarkOptions
from cnpgen.addons.benchmark.benchmark_planner import PLANNERS
from cnpgen.addons.benchmark.run_suite import Benchmark, run_benchmark
from cnpgen.schema import registry
from tests.conftest import some

pytestmark = pytest.mark.skipif(not find_spec("mujoco"), reason="needs mujoco")
MODULES = {"cbirrt": ("ompl",), "rrtconnect": ("ompl", "toppra"), "ruckig": ("ruckig",)}
MODULES |= {"sscbirrt": ("sscbirrt",), "drake": ("pydrake",)}
NEEDS_A_FILE = "cnp-b-paper"
ALL = tuple(
    name
    for name in registry.names(PLANNERS)
    if name != NEEDS_A_FILE and all(map(find_spec, MODULES.get(name, ())))
)
PLANTS = ("nominal", "heavier", "delayed")


@pytest.mark.slow
@pytest.mark.parametrize("suite", some(["heavy-100", "hits-81"]))  # tests/cli has hits
def test_every_planner_has_a_row_in_one_table(suite: str, tmp_path: Path) -> None:
    planners = [name for name in ALL if name != "aqp" or suite == "hits-81"]
    benchmark = run_benchmark(
        suite,
        tmp_path,
        planners=planners,
        n=1,
        plants=["nominal"],
        workers=1,
        options=BenchmarkOptions(time_limit=1),
    )
    summary = benchmark.summary("nominal")
    assert list(summary) == planners
    for name, (row,) in benchmark.results.items():
        assert row["ending"] in {"planned", "no plan", "out of time"}, (
            name,
            row["error"],
        )
        assert summary[name]["ratios"]["valid"]["p"] <= 1
        assert row["answer"] is None or "failure" not in row["executed"]["nominal"]
    assert {
        name for name in planners if summary[name]["ratios"]["success"]["count"]
    } >= {"cnpgen+refine", "solve"}


def executed_values(
    benchmark: Benchmark, planner: str, plant: str, key: str
) -> np.ndarray:
    return np.array([row["executed"][plant][key] for row in benchmark.results[planner]])


@pytest.mark.extended
def test_hits_81(tmp_path: Path) -> None:
    benchmark = run_benchmark(
        "hits-81", tmp_path, planners=["cnpgen+refine", "aqp", "trajopt"], plants=PLANTS
    )
    rows = benchmark.results["cnpgen+refine"]
    assert sum(row["verdict"]["valid"] for row in rows) == 81
    for plant in PLANTS:
        assert executed_values(benchmark, "cnpgen+refine", plant, "success").all()
        assert executed_values(
            benchmark, "cnpgen+refine", plant, "z_error_mm_s"
        ).max() <= (0.1 if plant == "nominal" else 1.0)
    assert (
        np.median(executed_values(benchmark, "cnpgen+refine", "nominal", "hit_time_s"))
        <= 0.43
    )
    assert executed_values(benchmark, "aqp", "nominal", "scored").sum() >= 75
    assert (
        0.6
        <= np.median(executed_values(benchmark, "aqp", "nominal", "hit_time_s"))
        <= 0.7
    )
    assert executed_values(benchmark, "trajopt", "nominal", "scored").sum() >= 0.91 * 81


@pytest.mark.extended
def test_heavy_100(tmp_path: Path) -> None:
    benchmark = run_benchmark(
        "heavy-100", tmp_path, planners=["cnpgen+refine"], plants=["nominal", "heavier"]
    )
    assert (
        sum(row["verdict"]["valid"] for row in benchmark.results["cnpgen+refine"])
        == 100
    )
    for plant in ("nominal", "heavier"):
        assert executed_values(benchmark, "cnpgen+refine", plant, "success").all()


@pytest.mark.extended
@pytest.mark.parametrize("suite", ["replan", "online"])
def test_replanning_scenarios(suite: str, tmp_path: Path) -> None:
    benchmark = run_benchmark(
        suite, tmp_path, planners=["cnpgen+refine"], plants=["nominal"]
    )
    assert executed_values(benchmark, "cnpgen+refine", "nominal", "success").sum() >= 23


@pytest.mark.extended
def test_sampling_planners_respect_the_time_limit(tmp_path: Path) -> None:
    for suite in ("hits-81", "heavy-100"):
        benchmark = run_benchmark(
            suite,
            tmp_path / suite,
            planners=["sst", "mpc-mpnet"],
            n=3,
            plants=["nominal"],
        )
        for rows in benchmark.results.values():
            assert all(
                row["ending"] in {"planned", "no plan"} and row["planning_s"] < 65
                for row in rows
            )
