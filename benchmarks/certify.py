"""Certified datasets: rows per second of CPU time without initial guess, and from plans of the shipped planners.

The same rows are made in both variants in this process, block by block in turn, with one BLAS thread. Both times
include sampling. Hours of one core for a million rows are extrapolated from the rows that were made.

    python benchmarks/certify.py
    python benchmarks/certify.py --rows 5000 --recipes panda-scenes
"""

import argparse
import time
from typing import Any

import numpy as np
from common import arguments, progress, report, table

from cnpgen.kernels.library import choose_backend
from cnpgen.make.certify import CertifiedPlan, certified
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.prepared import PreparedPipeline

# All shipped datasets, each with a planner of the same name.
RECIPES = (
    "airhockey-hit",
    "airhockey-replan",
    "airhockey-online",
    "airhockey-tables",
    "heavy-object",
    "heavy-object-anywhere",
    "heavy-object-loads",
    "panda-cup",
    "panda-scenes",
    "ur5-wipe",
)
MILLION, SECONDS_PER_HOUR = 1_000_000, 3600
NO_GUESS, PLANNER = "without initial guess", "from the planner"


def measure(name: str, rows: int, seed: int) -> dict[str, dict[str, float]]:
    """Certify the same rows in both variants."""
    recipe, (backend, folder) = load_dataset_recipe(name), choose_backend(None)
    recipes = {NO_GUESS: certified(recipe), PLANNER: certified(recipe, model=name)}
    prepared = {
        start: PreparedPipeline(variant.pipeline, backend=backend, cache_folder=folder)
        for start, variant in recipes.items()
    }
    totals: dict[str, dict[str, Any]] = {
        start: {"seconds": 0.0, "unplanned": 0, "time": []} for start in recipes
    }
    size = CertifiedPlan.block_rows
    for pipeline in prepared.values():
        pipeline.block(seed, "warm-up", 0, stop=1)
    for index in range(-(-rows // size)):
        progress(f"{name}: {min((index + 1) * size, rows)} of {rows} rows")
        for start, pipeline in prepared.items():
            clock = time.process_time()
            block = pipeline.block(seed, "train", index)
            totals[start]["seconds"] += time.process_time() - clock
            totals[start]["time"].append(block.columns["duration"][0])
            totals[start]["unplanned"] += block.sampling.rejections.get(
                "no plan found", 0
            )
    rows_made = size * -(-rows // size)
    return {
        start: {
            "rows per second": rows_made / total["seconds"],
            "core hours for a million rows": MILLION
            * total["seconds"]
            / rows_made
            / SECONDS_PER_HOUR,
            "no plan found": total["unplanned"],
            "mean motion time [s]": float(np.concatenate(total["time"]).mean()),
        }
        for start, total in totals.items()
    }


def rows_of(name: str, figures: dict[str, dict[str, float]]) -> list[tuple[str, ...]]:
    """Return the rows of the table."""
    rows: list[tuple[str, ...]] = []
    for figure in figures[NO_GUESS]:
        without_guess, from_planner = (
            figures[start][figure] for start in (NO_GUESS, PLANNER)
        )
        ratio = f"{from_planner / without_guess:.3f}" if without_guess else ""
        rows.append(
            (
                name,
                figure,
                f"{without_guess:,.4g}",
                f"{from_planner:,.4g}",
                ratio,
            )
        )
    return rows


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--recipes",
        nargs="+",
        default=list(RECIPES),
        help="by default all shipped datasets",
    )
    parser.add_argument("--rows", type=int, default=128, help="rows of each recipe")
    parser.add_argument("--seed", type=int, default=20_000_003, help="seed of the rows")


def main() -> None:
    """Run the benchmark."""
    chosen = arguments(__doc__, options)
    figures = {name: measure(name, chosen.rows, chosen.seed) for name in chosen.recipes}
    rows = [
        row for name, measured in figures.items() for row in rows_of(name, measured)
    ]
    head = ("recipe", "figure", NO_GUESS, PLANNER, "ratio")
    report(
        {"certify": figures},
        [table("certified rows", head, rows, left=2)],
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
