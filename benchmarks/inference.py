"""Planning with a trained model: the whole inference pipeline, one plan at a time and 1,024 together; or its tails.

The clock is the process's CPU time with one BLAS thread. Times are medians over the repetitions, which measure all
cases in turn. The targets hold for the default of ``Planner``. Motions from rest to rest are by default scaled in time;
they are also measured without.

``--tails N`` plans for N different problems instead, one after the other, with garbage collection as it is by default.
If the model plans from moving states, each plan is then replanned at a random time, every second one to another goal.
The tables have CPU and wall-clock times.

    python benchmarks/inference.py
    python benchmarks/inference.py --model model.h5 --dataset folder
    python benchmarks/inference.py --tails 100000 --model airhockey-online
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    arguments,
    cpu_of,
    installed_recipes,
    median,
    progress,
    report,
    table,
    verdict,
)

from cnpgen.machine.threads import one_thread
from cnpgen.make.make_dataset import make_dataset
from cnpgen.planner.model_file import shipped_models
from cnpgen.planner.plan_requests import read_rows
from cnpgen.planner.planner import Planner

BATCH = 1024
DEFAULT = "default"
TARGETS = {1: 0.3, BATCH: 0.03}  # ms per plan
ROWS_PER_PROBLEM = 1.2  # of a dataset: a part of its rows is not for training
TAILS = {"median": 50.0, "p99": 99.0, "p99.9": 99.9, "maximum": 100.0}
REPLANNING_RANGE = (0.05, 0.95)  # of the motion time
REPLANNING_SEED = 577_215_664
WARM_UP = 100


def measure(model: str, folder: Path, repeat: int) -> list[dict[str, Any]]:
    """Measure the CPU time per plan [ms] for both batch sizes, with and without time scaling."""
    planners = {DEFAULT: Planner(model)}
    if planners[DEFAULT].model.is_rest_to_rest:
        planners["without time scaling"] = Planner(model, scale_time=False)
    boundary = read_rows(
        folder, planners[DEFAULT].model, n=BATCH, split="train"
    ).boundary
    results = []
    with one_thread():
        for size in (1, BATCH):
            times: dict[str, list[float]] = {variant: [] for variant in planners}
            for index in range(repeat if size == 1 else max(repeat // 10, 3)):
                rows = (
                    boundary[index % BATCH : index % BATCH + 1]
                    if size == 1
                    else boundary
                )
                for variant, planner in planners.items():
                    times[variant].append(cpu_of(partial(planner.plan_batch, rows)))
            for variant, seconds in times.items():
                results.append(
                    {
                        "model": model,
                        "variant": variant,
                        "batch": size,
                        "ms_per_plan": 1e3 * median(seconds) / size,
                    }
                )
    return results


def measure_tails(model: str, folder: Path, count: int) -> list[dict[str, Any]]:
    """Measure the time of every plan and replan [ms]; return quantiles of CPU and wall-clock time."""
    planner, random = Planner(model), np.random.default_rng(REPLANNING_SEED)
    boundary = read_rows(folder, planner.model, n=count, split="train").boundary
    plans = planner.plan_batch(boundary)
    times = random.uniform(*REPLANNING_RANGE, count) * plans.duration
    rows = np.arange(count)
    goals = np.where(rows % 2, np.roll(rows, -1), rows)

    def plan(index: int) -> Callable[[], Any]:
        row = boundary[index : index + 1]
        return lambda: planner.plan_batch(row)

    def replan(index: int) -> Callable[[], Any]:
        executed, goal = plans[index], boundary[goals[index] : goals[index] + 1]
        return lambda: planner.replan(
            executed, times[index], goal_q=goal.goal_q, goal_dq=goal.goal_dq
        )

    actions = {"plan": plan} | (
        {} if "start_dq" in planner.model.zero_conditions else {"replan": replan}
    )
    results = []
    with one_thread():
        for name, action in actions.items():
            progress(f"{model}: {count} times {name}")
            seconds = np.array(
                [
                    time_call(action(index))
                    for index in (*range(min(WARM_UP, count)), *range(count))
                ]
            )
            for clock, values in zip(
                ("CPU", "wall clock"), seconds[-count:].T, strict=True
            ):
                quantiles = np.percentile(
                    1e3 * values, list(TAILS.values()), method="higher"
                ).tolist()
                facts = {"model": model, "action": name, "count": count, "clock": clock}
                results.append(facts | dict(zip(TAILS, quantiles, strict=True)))
    return results


def time_call(call: Callable[[], Any]) -> tuple[float, float]:
    """Return the CPU time and the wall-clock time of a call [s]."""
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.process_time() - cpu, time.perf_counter() - wall


def print_tails(results: list[dict[str, Any]], *, as_json: bool) -> None:
    """Print the results of ``measure_tails``."""
    rows = [
        (
            Path(result["model"]).stem,
            result["action"],
            result["clock"],
            *(f"{result[name]:.3f}" for name in TAILS),
        )
        for result in results
    ]
    head = ("model", "action", "clock", *(f"{name} [ms]" for name in TAILS))
    report(
        {"tails": results},
        [table(f"{results[0]['count']} planning times", head, rows, left=3)],
        as_json=as_json,
    )


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", help="a model file; by default all shipped models")
    parser.add_argument(
        "--dataset",
        type=Path,
        help="a dataset with at least 1,024 training rows for the model",
    )
    parser.add_argument("--repeat", type=int, default=200)
    parser.add_argument(
        "--tails",
        type=int,
        metavar="N",
        help="measure tails of N plans and replans instead",
    )


def main() -> None:
    chosen = arguments(__doc__, options)
    results: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        cases = (
            {chosen.model: chosen.dataset}
            if chosen.model
            else dict.fromkeys(installed_recipes(shipped_models()))
        )
        for model, dataset in cases.items():
            progress(f"planning with {model}")
            count = int(ROWS_PER_PROBLEM * max(chosen.tails or 0, BATCH))
            folder = dataset or Path(
                make_dataset(model, Path(name) / model, n=count, workers=1).folder
            )
            if chosen.tails:
                results += measure_tails(model, folder, chosen.tails)
            else:
                results += measure(model, folder, chosen.repeat)
    if chosen.tails:
        print_tails(results, as_json=chosen.json)
        return
    rows = []
    for result in results:
        target = TARGETS[result["batch"]] if result["variant"] == DEFAULT else None
        cells = (
            Path(result["model"]).stem,
            result["variant"],
            str(result["batch"]),
            f"{result['ms_per_plan']:.4f}",
        )
        ratio = f"{result['ms_per_plan'] / target:.2f}" if target else ""
        rows.append(
            (*cells, *verdict(result["ms_per_plan"], target, at_most=True), ratio)
        )
    head = ("model", "variant", "batch", "ms per plan", "target", "", "ratio")
    report(
        {"inference": results},
        [table("planning", head, rows, left=2)],
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
