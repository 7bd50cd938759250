"""Planning with a trained model: one plan at a time and 1,024 together, with everything around the network.

The clock is the process's CPU time, one BLAS thread; medians over the repetitions, which measure all cases in turn.
What ``Planner`` does by default is held to the targets; of motions from rest to rest that is with the slow-down
afterwards, and the network alone is shown beside it.

    python benchmarks/inference.py
    python benchmarks/inference.py --model model.h5 --dataset folder
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

from common import arguments, at_hand, median, progress, report, table, verdict

from cnpgen.machine.threads import one_thread
from cnpgen.make.make_dataset import make_dataset
from cnpgen.planner.model_file import shipped_models
from cnpgen.planner.plan_requests import read_rows
from cnpgen.planner.planner import Planner

BATCH = 1024
DEFAULT = "default"
TARGETS = {1: 0.3, BATCH: 0.03}  # ms per plan


def measure(model: str, folder: Path, repeat: int) -> list[dict[str, Any]]:
    """Milliseconds per plan, batch by batch, with and without the slow-down."""
    planners = {DEFAULT: Planner(model)}
    if planners[DEFAULT].model.is_rest_to_rest:
        planners["without slow-down"] = Planner(model, scale_time=False)
    asked = read_rows(folder, planners[DEFAULT].model, n=BATCH, split="train").boundary
    found = []
    with one_thread():
        for size in (1, BATCH):
            times: dict[str, list[float]] = {what: [] for what in planners}
            for index in range(repeat if size == 1 else max(repeat // 10, 3)):
                rows = asked[index % BATCH : index % BATCH + 1] if size == 1 else asked
                for what, planner in planners.items():
                    begun = time.process_time()
                    planner.plan_batch(rows)
                    times[what].append(time.process_time() - begun)
            for what, seconds in times.items():
                found.append({"model": model, "what": what, "batch": size, "ms_per_plan": 1e3 * median(seconds) / size})
    return found


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", help="a model file; by default all that are shipped")
    parser.add_argument("--dataset", type=Path, help="a folder with at least 1,024 training rows for it")
    parser.add_argument("--repeat", type=int, default=200)


def main() -> None:
    chosen = arguments(__doc__, options)
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        cases = {chosen.model: chosen.dataset} if chosen.model else dict.fromkeys(at_hand(shipped_models()))
        for model, given in cases.items():
            progress(f"planning with {model}")
            folder = given or Path(make_dataset(model, Path(name) / model, n=1200, workers=1).folder)
            found += measure(model, folder, chosen.repeat)
    rows = []
    for each in found:
        target = TARGETS[each["batch"]] if each["what"] == DEFAULT else None
        cells = (Path(each["model"]).stem, each["what"], str(each["batch"]), f"{each['ms_per_plan']:.4f}")
        ratio = f"{each['ms_per_plan'] / target:.2f}" if target else ""
        rows.append((*cells, *verdict(each["ms_per_plan"], target, at_most=True), ratio))
    head = ("model", "what", "batch", "ms per plan", "target", "", "of it")
    report({"inference": found}, [table("planning", head, rows, left=2)], as_json=chosen.json)


if __name__ == "__main__":
    main()
