"""Planners for many tables, limits and loads against planners that were trained for a single value.

New problems of ``airhockey-tables`` and ``heavy-object-loads`` are planned by the shipped planner and by the network of
a planner for one value (``airhockey-hit``, ``heavy-object``). The latter does not read the parameters, but projection
and time scaling use those of each sample. Some plans of the shipped planner are refined; durations are compared with
the refined ones. Nothing was selected with this seed.

With ``--start MODEL``, the network for a single value is written as a model to start training from.

    python benchmarks/parameters.py
    python benchmarks/parameters.py --problems 300 --refined 60 --sets heavy-object-loads
    python benchmarks/parameters.py --sets airhockey-tables --start tables-from.h5
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, progress, report, table

import cnpgen
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import load_model, save_model
from cnpgen.problems.problem_record import as_record
from cnpgen.refine.refine_plans import refine_plans

SINGLE = {"airhockey-tables": "airhockey-hit", "heavy-object-loads": "heavy-object"}
UNIFORM_DEVIATIONS = 12**0.5  # width of a uniform distribution, in standard deviations


def single_value_model(name: str) -> Model:
    """Return the network for a single value as a model of a problem with parameters, whose weights are zero."""
    model, record = load_model(SINGLE[name]), as_record(name)
    low, high = np.array([(span.low, span.high) for span in record.parameters.ranges]).T
    weight = model.architecture.all_layers[0].weight(model.parameters)
    first = np.vstack([weight, np.zeros((len(low), weight.shape[1]), np.float32)])
    features = replace(
        model.features,
        blocks=(*model.features.blocks, "parameters"),
        mean=np.concatenate([model.features.mean, (low + high) / 2]),
        scale=np.concatenate([model.features.scale, UNIFORM_DEVIATIONS / (high - low)]),
    )
    return replace(
        model,
        problem=record,
        features=features,
        architecture=replace(model.architecture, inputs=len(first)),
        parameters=np.concatenate([first.ravel(), model.parameters[weight.size :]]),
        training={},
        log="",
    )


def measure(
    name: str, model: Model, options: argparse.Namespace, *, refined: int
) -> dict[str, Any]:
    """Plan new problems; refine some of the plans."""
    problems = draw_boundary_problems(name, options.problems, seed=options.seed)
    planner = cnpgen.Planner(model, scale_time=not options.no_time_scaling)
    plans = planner.plan_batch(problems.boundary, columns=problems.columns)
    progress(f"{name}: {len(plans)} plans")
    verdicts = cnpgen.evaluate_plans(plans, workers=1).verdicts
    figures = {
        "strict": np.mean([verdict.valid for verdict in verdicts]),
        "paper": np.mean(
            [verdict.paper.valid for verdict in verdicts if verdict.paper]
        ),
        "duration": plans.duration.mean(),
    }
    if refined:
        result = refine_plans(plans[:refined], workers=1).plans
        valid = np.array(
            [
                verdict.valid
                for verdict in cnpgen.evaluate_plans(result, workers=1).verdicts
            ]
        )
        ratio = plans.duration[:refined] / result.duration
        figures |= {"refined": valid.mean(), "over refined": ratio[valid].mean()}
    return {key: float(value) for key, value in figures.items()}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        "--problems", type=int, default=1000, help="new problems of each set"
    )
    parser.add_argument(
        "--refined", type=int, default=200, help="plans that are refined"
    )
    parser.add_argument(
        "--seed", type=int, default=480_213, help="seed of the problems"
    )
    parser.add_argument(
        "--sets",
        nargs="+",
        choices=SINGLE,
        default=list(SINGLE),
        help="sets of problems",
    )
    parser.add_argument(
        "--no-time-scaling",
        action="store_true",
        help="do not scale motions from rest to rest in time",
    )
    parser.add_argument(
        "--models",
        nargs="+",
        type=Path,
        help="model files in place of the shipped ones",
    )
    parser.add_argument(
        "--start",
        type=Path,
        help="file for the network of the first set to start training from",
    )


def main() -> None:
    """Print the table."""
    options = arguments(__doc__, add_options)
    if options.start is not None:
        save_model(options.start, single_value_model(options.sets[0]))
        return
    rows, models = [], options.models or options.sets
    for name, file in zip(options.sets, models, strict=True):
        for label, model in (
            ("all values", load_model(str(file))),
            ("one value", single_value_model(name)),
        ):
            figures = measure(name, model, options, refined=options.refined)
            rows.append({"set": name, "trained for": label, **figures})
    heads = {key: None for row in rows for key in row}
    cells = [
        [value if isinstance(value, str) else f"{value:.4g}" for value in row.values()]
        for row in rows
    ]
    report(
        {"parameters": rows},
        [table("planners for many values and for one", [*heads], cells, left=2)],
        as_json=options.json,
    )


if __name__ == "__main__":
    main()
