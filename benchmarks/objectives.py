"""Planners trained for other objectives: what they save, and the time it costs.

The shipped planner of a dataset is trained further for each objective, with the same rows, settings and CPU time.

    python benchmarks/objectives.py FOLDER
    python benchmarks/objectives.py FOLDER --seconds 120 --objectives time effort=2 path-length=1
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, progress, report, table

import cnpgen
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.refine.objective_values import objective_values
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.training.settings import TrainingSettings
from cnpgen.training.train import train_model

PROBLEM_SEED, DATA_SEED = 16_180, 33_988  # used nowhere else
REPORTED = "effort,jerk,path-length"
VALIDATION_ROWS = 200


def measured(plans: Plans, problems: Plans) -> dict[str, Any]:
    """Judge plans and refine them for time; evaluate the terms of objectives."""
    evaluation = evaluate_plans(plans, workers=1)
    values = {
        name: float(np.mean(terms))
        for name, terms in objective_values(plans, REPORTED).items()
    }
    return {"plans": len(problems), "valid": float(evaluation.valid.mean()), **values}


def trained_for(
    objective: str, data: Path, options: argparse.Namespace
) -> cnpgen.Planner:
    """Train the shipped planner further for an objective."""
    progress(f"{objective}, {options.seconds:g} CPU seconds")
    shipped = cnpgen.load_model(options.dataset)
    stored = shipped.training["settings"]
    outputs = (
        "hidden",
        "layers",
        "batch_size",
        "path_scale",
        "line_projection_steps",
        "projection_steps",
    )
    others = ("expected_time", "rate_bias", "margins")
    settings = TrainingSettings(
        **{name: stored[name] for name in (*outputs, *others) if name in stored},
        objective=objective,
        learning_rate=options.learning_rate,
        seed=options.seed,
        validations=4,
    )
    name = objective.replace("=", "-").replace(",", "-").replace(" ", "")
    trained = train_model(
        data,
        options.folder / f"{options.dataset}-{name}-{options.seed}.h5",
        settings=settings,
        start_from=options.dataset,
        cpu_seconds=options.seconds,
        check_rows=VALIDATION_ROWS // 2,
        workers=1,
    )
    return cnpgen.Planner(trained.path)


def main() -> None:
    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "folder",
            type=Path,
            help="folder of rows and models; an interrupted run resumes",
        )
        parser.add_argument(
            "--dataset", default="heavy-object", help="dataset and shipped model"
        )
        parser.add_argument("--objectives", nargs="+", default=["time", "effort=2"])
        parser.add_argument(
            "--seconds", type=float, default=90.0, help="CPU time of each training [s]"
        )
        parser.add_argument("--learning-rate", type=float, default=7e-4)
        parser.add_argument("--rows", type=int, default=24_000)
        parser.add_argument("--n", type=int, default=1000, help="new problems")
        parser.add_argument("--seed", type=int, default=0)
        parser.add_argument(
            "--refined",
            type=int,
            default=200,
            help="plans that are also refined for the objective",
        )

    options = arguments(__doc__, add)
    data = options.folder / "rows"
    splits = {"train": options.rows, "validation": VALIDATION_ROWS}
    make_dataset(
        replace(load_dataset_recipe(options.dataset), splits=splits, seed=DATA_SEED),
        data,
        workers=1,
    )
    problems = cnpgen.draw_boundary_problems(
        options.dataset, options.n, seed=PROBLEM_SEED
    )
    results = {}
    for objective in options.objectives:
        planner = trained_for(objective, data, options)
        plans = planner.plan_batch(problems.boundary, columns=problems.columns)
        results[objective] = measured(plans, problems)
        progress(f"refining {options.refined} plans")
        some = plans[: options.refined]
        refined = refine_plans(
            some, options=cnpgen.RefineOptions(objective=objective), workers=1
        ).plans
        results[f"{objective}, refined"] = measured(refined, some)
    base = {
        "": results[options.objectives[0]],
        ", refined": results[f"{options.objectives[0]}, refined"],
    }
    rows = []
    for name, values in results.items():
        reference = base[", refined" if name.endswith(", refined") else ""]
        changes = (
            f"{values[key]:.4g} ({100 * (values[key] / reference[key] - 1):+.1f} %)"
            for key in list(values)[2:]
        )
        rows.append(
            (name, f"{values['plans']:,}", f"{100 * values['valid']:.1f} %", *changes)
        )
    head = (
        "trained for",
        "plans",
        "valid",
        "time s",
        "effort s",
        "jerk s",
        "path length m",
    )
    title = f"{options.dataset}: objectives, changes relative to the first one"
    report({"results": results}, [table(title, head, rows)], as_json=options.json)


if __name__ == "__main__":
    main()
