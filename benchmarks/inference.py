"""Planning with a trained model: the whole inference pipeline, one plan at a time and 1,024 together.

The clock is the process's CPU time with one BLAS thread. Times are medians over the repetitions, which measure all
cases in turn. The targets hold for the default of ``Planner``. Motions from rest to rest are by default scaled in time;
they are also measured without.

    python benchmarks/inference.py
    python benchmarks/inference.py --model model.h5 --dataset folder
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

from common import arguments, installed_recipes, median, progress, report, table, verdict

from cnpgen.machine.threads import one_thread
from cnpgen.make.make_dataset import make_dataset
from cnpgen.planner.model_file import shipped_models
from cnpgen.planner.plan_requests import read_rows
from cnpgen.planner.planner import Planner

BATCH = 1024
DEFAULT = "default"
TARGETS = {1: 0.3, BATCH: 0.03}  # ms per plan


def measure(model: str, folder: Path, repeat: int) -> list[dict[str, Any]]:
    """Measure the CPU time per plan [ms] for both batch sizes, with and without time scaling."""
    planners = {DEFAULT: Planner(model)}
    if planners[DEFAULT].model.is_rest_to_rest:
        planners["without time scaling"] = Planner(model, scale_time=False)
    boundary = read_rows(folder, planners[DEFAULT].model, n=BATCH, split="train").boundary
    results = []
    with one_thread():
        for size in (1, BATCH):
            times: dict[str, list[float]] = {variant: [] for variant in planners}
            for index in range(repeat if size == 1 else max(repeat // 10, 3)):
                rows = boundary[index % BATCH : index % BATCH + 1] if size == 1 else boundary
                for variant, planner in planners.items():
                    start = time.process_time()
                    planner.plan_batch(rows)
                    times[variant].append(time.process_time() - start)
            for variant, seconds in times.items():
                results.append(
                    {"model": model, "variant": variant, "batch": size, "ms_per_plan": 1e3 * median(seconds) / size}
                )
    return results


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", help="a model file; by default all shipped models")
    parser.add_argument("--dataset", type=Path, help="a dataset with at least 1,024 training rows for the model")
    parser.add_argument("--repeat", type=int, default=200)


def main() -> None:
    chosen = arguments(__doc__, options)
    results: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        cases = {chosen.model: chosen.dataset} if chosen.model else dict.fromkeys(installed_recipes(shipped_models()))
        for model, dataset in cases.items():
            progress(f"planning with {model}")
            folder = dataset or Path(make_dataset(model, Path(name) / model, n=1200, workers=1).folder)
            results += measure(model, folder, chosen.repeat)
    rows = []
    for result in results:
        target = TARGETS[result["batch"]] if result["variant"] == DEFAULT else None
        cells = (Path(result["model"]).stem, result["variant"], str(result["batch"]), f"{result['ms_per_plan']:.4f}")
        ratio = f"{result['ms_per_plan'] / target:.2f}" if target else ""
        rows.append((*cells, *verdict(result["ms_per_plan"], target, at_most=True), ratio))
    head = ("model", "variant", "batch", "ms per plan", "target", "", "ratio")
    report({"inference": results}, [table("planning", head, rows, left=2)], as_json=chosen.json)


if __name__ == "__main__":
    main()
