"""Judge plans or sampled trajectories.

Every plan is checked on a fine time grid and between its samples ('cnpgen docs
verdict'). The exit code is 0 if every plan is valid, and 1 if a plan is invalid, if the
file holds no plans, or if it is damaged. It is 2 for files of another kind. --workers
changes only the time.

"""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names, values, verdict_text
from cnpgen.cli.parser import EXTRAPOLATE, Parser, add_json, refuse
from cnpgen.cli.terminal import Meter
from cnpgen.errors import DatasetError, UsageError, counted
from cnpgen.schema import addons
from cnpgen.schema.registry import COMMANDS

if TYPE_CHECKING:
    from cnpgen.plans.evaluate import Evaluation

_PLAN_SUFFIXES = {"", ".h5", ".hdf5"}  # other files hold sampled trajectories


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option(
        "file",
        metavar="FILE",
        type=Path,
        help="plan file, .h5, or sampled trajectories",
    )
    text = "the problem of the plans; its tolerances are used"
    option("--problem", metavar="NAME|FILE", type=recipe_names.problem, help=text)
    option("--extrapolate", action="store_true", help=EXTRAPOLATE)
    text = "time between two samples (default: 1ms, at most 10ms)"
    option("--step", metavar="S", type=values.seconds, default=1e-3, help=text)
    text = "largest tracking error of the joints, such as 2deg: position limits, clearances and the manifold hold"
    text += " within it; one number, or one per joint (default: exact tracking)"
    option("--tracking-error", metavar="E,...", type=values.tracking_errors, help=text)
    option(
        "--workers",
        metavar="W",
        type=values.positive,
        help="processes; default one per available core",
    )
    option(
        "--list",
        action="store_true",
        help="also list the plans, one per line, invalid ones first",
    )
    option(
        "--plot",
        metavar="PICTURE",
        type=values.plot_file,
        help="draw one plan or trajectory: .png, .pdf or .svg",
    )
    text = "plan or trajectory to draw; default the first that is not valid, or 0"
    option("--plan", metavar="I", type=values.natural, help=text)
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    refuse_without_effect(arguments)
    found = _evaluate(arguments)
    if arguments.json:
        _write_json(arguments.file, found)
    else:
        print(verdict_text.summary_text(arguments.file, found))
        if arguments.list:
            print(f"\n{verdict_text.listing_text(found)}")
    if arguments.plot:
        _draw(found, arguments.plot, arguments.plan)
    return 0 if found.valid.all() else 1


def refuse_without_effect(arguments: argparse.Namespace) -> None:
    """Refuse options that have no effect on the output."""
    if not arguments.plot:
        refuse(arguments, ["plan"], "{} needs --plot")
    if arguments.json:
        refuse(arguments, ["list"], "{} has no effect with --json, which has all")


def _evaluate(arguments: argparse.Namespace) -> "Evaluation":
    from cnpgen.plans.evaluate import evaluate_plans

    trajectories = addons.find(COMMANDS, "evaluate.trajectories")
    if trajectories and arguments.file.suffix.lower() not in _PLAN_SUFFIXES:
        addons.load_entry(trajectories, f"'cnpgen evaluate {arguments.file}'")
    plans = recipe_names.read_plans(
        arguments.file, problem=arguments.problem, extrapolate=arguments.extrapolate
    )
    if arguments.plan is not None and arguments.plan >= len(plans):
        raise UsageError(
            f"{arguments.file} has no plan {arguments.plan}: {counted(len(plans), 'plan')}, numbered from 0"
        )
    # Without a terminal the summary alone is printed.
    with Meter(quiet=arguments.quiet or not sys.stderr.isatty(), noun="plan") as meter:
        meter.begin(f"judging {arguments.file}", len(plans))
        return evaluate_plans(
            plans,
            step=arguments.step,
            tracking_error=arguments.tracking_error,
            workers=arguments.workers,
            progress=meter,
        )


def _write_json(file: Path, found: "Evaluation") -> None:
    """Write one document, plan by plan, to limit memory."""
    from cnpgen.store.files.documents import render

    head = render({"file": str(file), **found.summary()})
    # The document stays open for the verdicts, which follow one by one.
    print(head.removesuffix("\n}") + ',\n  "verdicts": [', end="")
    for index, row in enumerate(found.rows()):
        print(
            f"{',' if index else ''}\n    {json.dumps(row, ensure_ascii=False, allow_nan=False)}",
            end="",
        )
    print("\n  ]\n}")


def _draw(found: "Evaluation", picture: str, index: int | None) -> None:
    from cnpgen.judges.plans.plan_plot import plot_plan
    from cnpgen.plans import open_problem

    plans = found.plans
    chosen = _chosen(found) if index is None else index
    problem, robot = open_problem(plans.problem)
    verdict = found.verdicts[chosen]
    note = f"sample {plans.sample_id[chosen]}: {verdict}"
    plot_plan(
        problem,
        robot,
        plans.motion,
        chosen,
        picture,
        scene=plans.scene[chosen],
        note=note,
        verdict=verdict,
    )
    print(f"drawn: plan {chosen} in {picture}", file=sys.stderr)


def _chosen(found: "Evaluation") -> int:
    """Choose the plan to draw: the first invalid one that can be drawn, else the first that can be drawn."""
    # A verdict without margins belongs to a plan that could not be evaluated.
    able = [index for index, verdict in enumerate(found.verdicts) if verdict.margins]
    if not able:
        raise DatasetError("none of the plans can be drawn: none can be evaluated")
    return next((index for index in able if not found.verdicts[index].valid), able[0])
