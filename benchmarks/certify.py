"""Certified datasets: rows per second of CPU time without initial guess, and from plans of the shipped planners.

The same rows are made in both variants in this process, block by block in turn, with one BLAS thread. Both times
include sampling. Hours of one core for a million rows are extrapolated from the rows that were made, whose number is
printed. ``--base`` certifies the same rows with another checkout, by its .venv/bin/python, right after each dataset.

    python benchmarks/certify.py
    python benchmarks/certify.py --rows 5000 --recipes panda-scenes --base CHECKOUT
"""

import argparse
import json
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, progress, report, table

from cnpgen.kernels.library import choose_backend
from cnpgen.make.certify import CertifiedPlan, certified
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.planner.model_file import shipped_models
from cnpgen.schema.catalogue import list_recipes

MILLION, SECONDS_PER_HOUR = 1_000_000, 3600
MAX_WAIT_S = 300  # for final code of kernels
NO_GUESS, PLANNER = "without initial guess", "from the planner"
BASE = "base: "  # before the variants of another checkout

Figures = dict[str, dict[str, float]]  # variant -> figure -> value


def measure(name: str, rows: int, seed: int) -> Figures:
    """Certify the same rows in both variants."""
    recipe, (backend, folder) = load_dataset_recipe(name), choose_backend(None)
    recipes = {NO_GUESS: certified(recipe)}
    if name in shipped_models():
        recipes[PLANNER] = certified(recipe, model=name)
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
    # Final code may still be generated in the background; an older checkout has no such module.
    with suppress(ImportError):
        from cnpgen.kernels.optimizer import replacer

        replacer.wait(MAX_WAIT_S)
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
    made = size * -(-rows // size)
    return {
        start: {
            "rows": made,
            "rows per second": made / total["seconds"],
            "core hours for a million rows": MILLION
            * total["seconds"]
            / made
            / SECONDS_PER_HOUR,
            "candidates with a valid plan [%]": 100
            * made
            / (made + total["unplanned"]),
            "mean motion time [s]": float(np.concatenate(total["time"]).mean()),
        }
        for start, total in totals.items()
    }


def measure_in(checkout: Path, name: str, rows: int, seed: int) -> Figures:
    """Certify the same rows with another checkout."""
    words = ("--recipes", name, "--rows", str(rows), "--seed", str(seed), "--json")
    done = subprocess.run(
        [checkout.resolve() / ".venv/bin/python", __file__, *words],
        stdout=subprocess.PIPE,
        check=True,
    )
    found: Figures = json.loads(done.stdout)["certify"][name]
    return {BASE + variant: figures for variant, figures in found.items()}


def rows_of(name: str, measured: Figures, variants: list[str]) -> list[tuple[str, ...]]:
    """Return the rows of the table: figures of the variants, empty where there is none, and their ratios to the last."""
    rows = []
    for figure in measured[NO_GUESS]:
        values = [measured.get(each, {}).get(figure) for each in variants]
        reference = values[-1]
        cells = ["" if each is None else f"{each:,.5g}" for each in values]
        ratios = [f"{v / reference:.3f}" if v and reference else "" for v in values]
        rows.append((name, figure, *cells, *ratios[:-1]))
    return rows


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--recipes",
        nargs="+",
        default=list(list_recipes("dataset")),
        help="by default all shipped datasets",
    )
    parser.add_argument("--rows", type=int, default=128, help="rows of each recipe")
    parser.add_argument("--seed", type=int, default=20_000_003, help="seed of the rows")
    parser.add_argument("--base", type=Path, help="another checkout to compare with")


def main() -> None:
    """Run the benchmark."""
    chosen = arguments(__doc__, options)
    figures = {}
    for name in chosen.recipes:
        task = name, chosen.rows, chosen.seed
        figures[name] = measure(*task)
        if chosen.base and (chosen.base / f"datasets/{name}.toml").exists():
            figures[name] |= measure_in(chosen.base, *task)
        progress(f"{name}: {json.dumps(figures[name])}")
    variants = [PLANNER, NO_GUESS]
    if chosen.base:
        variants += [BASE + PLANNER, BASE + NO_GUESS]
    ratios = [f"{variant}, ratio" for variant in variants[:-1]]
    rows = [
        row
        for name, measured in figures.items()
        for row in rows_of(name, measured, variants)
    ]
    head = "recipe", "figure", *variants, *ratios
    report(
        {"certify": figures},
        [table(f"certified rows; ratios to {variants[-1]}", head, rows, left=2)],
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
