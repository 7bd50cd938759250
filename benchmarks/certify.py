"""Certified datasets: rows per second of CPU time without initial guess, and from plans of the shipped planners.

The same rows are made in both variants in this process, block by block in turn, with one BLAS thread. Both times
include sampling. "120,000 rows" is extrapolated to two cores; airhockey-replan has a target.

    python benchmarks/certify.py
    python benchmarks/certify.py --rows 512 --recipes airhockey-replan
"""

import argparse
import time
from typing import Any

import numpy as np
from common import arguments, progress, report, table, verdict

from cnpgen.kernels.library import choose_backend
from cnpgen.make.certify import CertifiedPlan, certified
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.prepared import PreparedPipeline

RECIPES = ("airhockey-hit", "airhockey-replan", "heavy-object")
ROWS, CORES, TARGET_MINUTES = 120_000, 2, {"airhockey-replan": 20.0}
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
            "minutes for 120,000 rows on two cores": ROWS
            * total["seconds"]
            / rows_made
            / CORES
            / 60,
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
        goal = TARGET_MINUTES.get(name) if figure.startswith("minutes") else None
        ratio = f"{from_planner / without_guess:.3f}" if without_guess else ""
        rows.append(
            (
                name,
                figure,
                f"{without_guess:,.4g}",
                f"{from_planner:,.4g}",
                ratio,
                *verdict(from_planner, goal, at_most=True),
            )
        )
    return rows


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--recipes",
        nargs="+",
        default=list(RECIPES),
        help="by default all with a shipped planner",
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
    head = ("recipe", "figure", NO_GUESS, PLANNER, "ratio", "target", "")
    report(
        {"certify": figures},
        [table("certified rows", head, rows, left=2)],
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
