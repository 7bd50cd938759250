"""Certified datasets: rows per second of CPU time from nothing, and from the plans of the shipped planners.

The same rows are made both ways in this process, block by block in turn, with one BLAS thread; what drawing them takes
is in both. "120,000 rows" is what that comes to on two cores; the goal is for airhockey-replan.

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
from cnpgen.make.recipe_file import load_dataset_recipe
from cnpgen.pipelines.prepared import PreparedPipeline

RECIPES = ("airhockey-hit", "airhockey-replan", "heavy-object")
ROWS, CORES, MINUTES = 120_000, 2, {"airhockey-replan": 20.0}
NOTHING, PLANNER = "from nothing", "from the planner"


def measure(name: str, rows: int, seed: int) -> dict[str, dict[str, float]]:
    """Certify the same rows both ways."""
    recipe, (backend, folder) = load_dataset_recipe(name), choose_backend(None)
    ways = {NOTHING: certified(recipe), PLANNER: certified(recipe, model=name)}
    prepared = {
        way: PreparedPipeline(each.pipeline, backend=backend, cache_folder=folder) for way, each in ways.items()
    }
    found: dict[str, dict[str, Any]] = {way: {"seconds": 0.0, "tried": 0, "unplanned": 0, "time": []} for way in ways}
    size = CertifiedPlan.block_rows
    for each in prepared.values():
        each.block(seed, "warm-up", 0, stop=1)
    for index in range(-(-rows // size)):
        progress(f"{name}: {min((index + 1) * size, rows)} of {rows} rows")
        for way, each in prepared.items():
            begun = time.process_time()
            block = each.block(seed, "train", index)
            found[way]["seconds"] += time.process_time() - begun
            found[way]["time"].append(block.columns["duration"][0])
            found[way]["unplanned"] += block.sampling.rejections.get("no plan found", 0)
    made = size * -(-rows // size)
    return {
        way: {
            "rows per second": made / each["seconds"],
            "minutes for 120,000 rows on two cores": ROWS * each["seconds"] / made / CORES / 60,
            "no plan found": each["unplanned"],
            "mean motion time [s]": float(np.concatenate(each["time"]).mean()),
        }
        for way, each in found.items()
    }


def rows_of(name: str, found: dict[str, dict[str, float]]) -> list[tuple[str, ...]]:
    """Lay out what was found."""
    rows: list[tuple[str, ...]] = []
    for what in found[NOTHING]:
        one, other = (found[way][what] for way in (NOTHING, PLANNER))
        goal = MINUTES.get(name) if what.startswith("minutes") else None
        ratio = f"{other / one:.3f}" if one else ""
        rows.append((name, what, f"{one:,.4g}", f"{other:,.4g}", ratio, *verdict(other, goal, at_most=True)))
    return rows


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--recipes", nargs="+", default=list(RECIPES), help="by default all with a shipped planner")
    parser.add_argument("--rows", type=int, default=128, help="of each")
    parser.add_argument("--seed", type=int, default=20_000_003, help="of the rows")


def main() -> None:
    """Run."""
    chosen = arguments(__doc__, options)
    found = {name: measure(name, chosen.rows, chosen.seed) for name in chosen.recipes}
    rows = [row for name, each in found.items() for row in rows_of(name, each)]
    head = ("recipe", "figure", NOTHING, PLANNER, "ratio", "goal", "")
    report({"certify": found}, [table("certified rows", head, rows, left=2)], as_json=chosen.json)


if __name__ == "__main__":
    main()
