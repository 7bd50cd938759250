"""CPU time of a training step, and scores of a training run of limited CPU time.

A step reads the rows of the batch and computes the forward pass, control points and the projection onto the manifold.
The loss with its gradient at 32 nodes, the backward pass, clipping and Adam follow. The clock is the process's CPU time
with one BLAS thread. Times are medians over the steps; the fractions of the parts are of the same steps.

    python benchmarks/training.py
    python benchmarks/training.py --learn airhockey-hit --cpu-seconds 120 --rows 200000
    python benchmarks/training.py --learn heavy-object --cpu-seconds 300 --rows 200000
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from common import arguments, cpu_of, median, progress, report, table, verdict

from cnpgen.machine.threads import one_thread
from cnpgen.make.make_dataset import make_dataset
from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.plan_requests import read_rows
from cnpgen.planner.planner import Planner
from cnpgen.problems.problem_record import as_record
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.training import step as parts
from cnpgen.training.data import open_training_data
from cnpgen.training.prepare import begin_run, prepare_run
from cnpgen.training.settings import Length, TrainingSettings
from cnpgen.training.train import train_model

DATASETS = ("airhockey-hit", "heavy-object")
NETWORKS = (
    (128, 64),
    (256, 128),
    (512, 128),
    (2048, 128),
)  # width and batch; all have a trunk of five layers
TARGETS = {(256, 128): 12.0, (512, 128): 35.0, (2048, 128): 700.0}  # ms
TIMED = {
    "forward": "forward",
    "control_points": "control points",
    "vjp": "control points",
    "backward": "backward",
}
PARTS = ("forward", "backward", "loss", "projection", "control points", "rest")
SCORE_TARGETS = {  # CPU time [s] of training from scratch; figure -> bound, and whether it is an upper bound
    "airhockey-hit": (120.0, {
        "paper_valid": (0.999, False), "valid": (0.9, False), "z_error_mm_s": (0.2, True),
        "duration_over_refined": (1.02, True),
    }),
    "heavy-object": (300.0, {"paper_valid": (0.985, False), "valid": (0.9, False)}),
}  # fmt: skip
REFINED = 200  # plans that are refined for the comparison of motion times


@dataclass
class Clock:
    """CPU time by name [s]."""

    spent: dict[str, float]

    @contextmanager
    def running(self, name: str) -> Iterator[None]:
        """Add the time of the block."""
        start = time.process_time()
        yield
        self.spent[name] = self.spent.get(name, 0.0) + time.process_time() - start

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function and add its time."""

        def run(*positional: Any, **named: Any) -> Any:
            with self.running(name):
                return function(*positional, **named)

        return run


def time_steps(
    folder: Path, hidden: int, batch: int, *, steps: int, backend: str
) -> dict[str, Any]:
    """Measure steps of one network: the time [ms] and the fraction of every part."""
    settings = TrainingSettings(hidden=hidden, batch_size=batch)
    source, clock = open_training_data(folder), Clock({})
    with one_thread(), loaded_problem(as_record(source.problem), backend) as loaded:
        run, _ = prepare_run(source, loaded, settings, check_rows=1)
        state = begin_run(run, Length(steps=10**6))
        gradient = np.empty_like(state.adam.parameters)
        for _ in range(3):
            run.step(state, gradient)
        with patched(clock, run):
            times = [cpu_of(lambda: run.step(state, gradient)) for _ in range(steps)]
    total = sum(times)
    shares = {name: clock.spent.get(name, 0.0) / total for name in PARTS[:-1]}
    return {
        "ms": 1e3 * median(times),
        "shares": shares | {"rest": 1 - sum(shares.values())},
    }


@contextmanager
def patched(clock: Clock, run: Any) -> Iterator[None]:
    """Replace the parts of a step by timed ones."""
    originals = {name: getattr(parts, name) for name in TIMED}
    learner, projection = run.learner, run.learner.projection
    timed = SimpleNamespace(
        project=clock.timed("projection", projection.project),
        vjp=clock.timed("projection", projection.vjp),
    )
    run.learner = replace(
        learner, loss=clock.timed("loss", learner.loss), projection=timed
    )
    for name, function in originals.items():
        setattr(parts, name, clock.timed(TIMED[name], function))
    yield
    for name, function in originals.items():
        setattr(parts, name, function)
    run.learner = learner


def measure_steps(
    folders: dict[str, Path], count: int
) -> tuple[list[dict[str, Any]], str]:
    results, rows = [], []
    for name, folder in folders.items():
        cases = [(*network, "compiled") for network in NETWORKS] + [(128, 64, "numpy")]
        for hidden, batch, backend in cases:
            progress(f"{name}, 5 x {hidden}, batch {batch}, {backend}")
            steps = max(count * 128 // hidden, 5) if backend == "compiled" else 10
            result = time_steps(folder, hidden, batch, steps=steps, backend=backend)
            results.append(
                {
                    "dataset": name,
                    "hidden": hidden,
                    "batch": batch,
                    "backend": backend,
                    **result,
                }
            )
            target = TARGETS.get((hidden, batch)) if backend == "compiled" else None
            shares = " / ".join(f"{100 * result['shares'][part]:.0f}" for part in PARTS)
            cells = (name, f"5 x {hidden}", str(batch), backend, f"{result['ms']:.2f}")
            rows.append((*cells, shares, *compared(result["ms"], target, at_most=True)))
    head = (
        "dataset",
        "network",
        "batch",
        "backend",
        "ms",
        f"% {' / '.join(PARTS)}",
        "target",
        "",
        "ratio",
    )
    return results, table("a training step", head, rows, left=2)


def compared(
    value: float, target: float | None, *, at_most: bool
) -> tuple[str, str, str]:
    """Return a target, whether a value meets it, and their ratio, as cells of a table."""
    return *verdict(
        value, target, at_most=at_most
    ), f"{value / target:.3f}" if target else ""


def learn(
    name: str, seconds: float, rows: int, seed: int, folder: Path
) -> tuple[dict[str, Any], str]:
    """Train on new rows, judge all test rows, and refine some plans."""
    data, out = folder / "rows", folder / "model.h5"
    progress(f"making {rows:,} rows of {name}")
    make_dataset(name, data, n=rows, seed=seed, workers=1)
    progress(f"training for {seconds:g} s of CPU time")
    trained = train_model(data, out, cpu_seconds=seconds)
    planner = Planner(trained.model)
    rows_read = read_rows(data, planner.model, n=REFINED)
    plans = planner.plan_batch(rows_read.boundary)
    progress(f"refining {REFINED} plans")
    refined = refine_plans(plans)
    valid = refined.valid
    ratio = plans.duration[valid].mean() / refined.plans.duration[valid].mean()
    facts = {
        **{
            key: value
            for key, value in trained.score.items()
            if key not in {"score", "broken"}
        },
        "cpu_seconds": trained.model.training["cpu_seconds"],
        "steps": trained.model.training["steps"],
        "duration_over_refined": float(ratio),
        "refined_valid": float(valid.mean()),
    }
    time_limit, targets = SCORE_TARGETS.get(name, (seconds, {}))
    bounds = targets if seconds <= time_limit else {}
    cells = []
    for key, value in facts.items():
        bound, upper = bounds.get(key, (None, False))
        cells.append(
            (
                key.replace("_", " "),
                f"{value:,.4g}",
                *compared(value, bound, at_most=upper),
            )
        )
    return facts, table(
        f"{name} from scratch", ("figure", "value", "target", "", "ratio"), cells
    )


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--steps", type=int, default=100, help="timed steps of the smallest network"
    )
    parser.add_argument(
        "--learn",
        choices=(*DATASETS, "airhockey-replan"),
        help="train on this dataset instead of timing steps",
    )
    parser.add_argument("--cpu-seconds", type=float, default=120.0)
    parser.add_argument("--rows", type=int, default=200_000)
    parser.add_argument(
        "--seed",
        type=int,
        default=1,
        help="seed of the rows; the shipped datasets have another one",
    )


def main() -> None:
    chosen = arguments(__doc__, options)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if chosen.learn:
            facts, text = learn(
                chosen.learn, chosen.cpu_seconds, chosen.rows, chosen.seed, folder
            )
            report({"learned": facts}, [text], as_json=chosen.json)
            return
        folders = {dataset: folder / dataset for dataset in DATASETS}
        for dataset, path in folders.items():
            make_dataset(dataset, path, n=4096, workers=1)
        results, text = measure_steps(folders, chosen.steps)
    report({"steps": results}, [text], as_json=chosen.json)


if __name__ == "__main__":
    main()
