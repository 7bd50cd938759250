"""``cnpgen evaluate``: judge plans or sampled trajectories of a file with Pinocchio and Coal."""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import Commands, Parser, add_command, add_json
from cnpgen.cli.plan_files import read_plans
from cnpgen.cli.progress import Meter
from cnpgen.cli.trajectory_options import (
    add_trajectory_options,
    listing_text,
    load_file,
    problem_of,
    refuse_trajectory_options,
    summary_text,
    write_json,
)
from cnpgen.errors import DatasetError, UsageError

if TYPE_CHECKING:
    from cnpgen.plans.evaluate import Evaluation
    from cnpgen.plans.evaluate_trajectories import TrajectoryEvaluation

_TEXT = """\
Every plan is checked on a fine time grid and between its samples ('cnpgen docs verdict'). The exit code is 0 if every
plan is valid, and 1 if a plan is invalid, if the file holds no plans, or if it is damaged. It is 2 for files of
another kind. --workers changes only the time.

With --problem, FILE may also hold sampled trajectories: CSV, JSON, YAML, NPZ, HDF5 or Parquet, messages of ROS and
MoveIt, or a folder of such files ('cnpgen docs trajectories'). Each trajectory and condition is valid, invalid or
undecided. The exit code is then 0 if all are valid, otherwise 1; 2 for damaged files and files of other kinds.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "evaluate", run, title="judge plans or sampled trajectories", text=_TEXT)
    option = parser.add_argument
    option("file", metavar="FILE", type=Path, help="plan file, .h5, or sampled trajectories")
    text = "the problem of the plans; its tolerances are used"
    option("--problem", metavar="NAME|FILE", type=recipe_names.problem, help=text)
    text = "time between two samples (default: 1ms, at most 10ms)"
    option("--step", metavar="S", type=values.seconds, default=1e-3, help=text)
    text = "largest tracking error of the joints, such as 2deg: position limits, clearances and the manifold hold"
    text += " within it; one number, or one per joint (default: exact tracking)"
    option("--tracking-error", metavar="E,...", type=values.tracking_errors, help=text)
    option("--workers", metavar="W", type=values.positive, help="processes; default one per available core")
    option("--list", action="store_true", help="also list the plans, one per line, invalid ones first")
    option("--plot", metavar="PICTURE", type=values.plot_file, help="draw one plan or trajectory: .png, .pdf or .svg")
    text = "plan or trajectory to draw; default the first that is not valid, or 0"
    option("--plan", metavar="I", type=values.natural, help=text)
    add_json(parser)
    sampled = parser.add_argument_group("sampled trajectories")
    add_trajectory_options(sampled)
    option = sampled.add_argument
    text = "judge a controller's curve; default: the motion that the samples resolve ('cnpgen docs trajectories')"
    option("--interpolation", choices=("hold", "linear", "cubic", "quintic"), help=text)
    text = "judge every curve through the samples whose jerks are at most J [rad/s^3]: one number, or one per joint"
    option("--max-jerk", metavar="J,...", type=values.amounts, help=text)
    text = "largest error of the samples in SI units: one number, or of positions, velocities and accelerations"
    option("--noise", metavar="E,...", type=values.errors, help=text)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from cnpgen.plans.trajectory_tables import holds_trajectories

    if arguments.plan is not None and not arguments.plot:
        raise UsageError("--plan needs --plot")
    if holds_trajectories(arguments.file):
        return _run_trajectories(arguments)
    refuse_trajectory_options(arguments, arguments.file, "interpolation", "max_jerk", "noise")
    found = _evaluate(arguments)
    if arguments.json:
        _write_json(arguments.file, found)
    else:
        from cnpgen.cli.verdict_text import listing_text, summary_text

        print(summary_text(arguments.file, found))
        if arguments.list:
            print(f"\n{listing_text(found)}")
    if arguments.plot:
        _draw(found, arguments.plot, arguments.plan)
    return 0 if found.valid.all() else 1


def _run_trajectories(arguments: argparse.Namespace) -> int:
    """Judge sampled trajectories."""
    from cnpgen.plans.evaluate_trajectories import evaluate_trajectories

    if arguments.tracking_error is not None:
        raise UsageError("--tracking-error is for plans: --noise gives the error of sampled trajectories")
    problem = problem_of(arguments)
    loaded = load_file(arguments, problem)
    count = len(loaded.trajectories)
    if arguments.plan is not None and arguments.plan >= count:
        raise UsageError(f"{arguments.file} has no trajectory {arguments.plan}: {count} are numbered from 0")
    with Meter(quiet=not sys.stderr.isatty(), noun="trajectory") as meter:
        meter.begin(f"judging {arguments.file}", count)
        found = evaluate_trajectories(
            problem,
            loaded.trajectories,
            interpolation=arguments.interpolation,
            noise=arguments.noise or 0.0,
            max_jerk=arguments.max_jerk,
            step=arguments.step,
            workers=arguments.workers or 1,
            progress=meter,
        )
    if arguments.json:
        write_json(arguments.file, found, loaded.labels)
    else:
        print(summary_text(arguments.file, found))
        if arguments.list:
            print(f"\n{listing_text(found, loaded.labels)}")
    if arguments.plot:
        _draw_trajectory(found, arguments.plot, arguments.plan, loaded.labels)
    return 0 if found.valid.all() else 1


def _evaluate(arguments: argparse.Namespace) -> "Evaluation":
    from cnpgen.plans.evaluate import evaluate_plans

    plans = read_plans(arguments.file, problem=arguments.problem)
    if arguments.plan is not None and arguments.plan >= len(plans):
        raise UsageError(f"{arguments.file} has no plan {arguments.plan}: {len(plans)} plans are numbered from 0")
    with Meter(quiet=not sys.stderr.isatty(), noun="plan") as meter:
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
    print(head.removesuffix("\n}") + ',\n  "verdicts": [', end="")
    for index, row in enumerate(found.rows()):
        print(f"{',' if index else ''}\n    {json.dumps(row, ensure_ascii=False, allow_nan=False)}", end="")
    print("\n  ]\n}")


def _draw(found: "Evaluation", picture: str, index: int | None) -> None:
    from cnpgen.judges.plans.plan_plot import plot_plan
    from cnpgen.plans import open_problem

    plans, chosen = found.plans, _chosen(found) if index is None else index
    problem, robot = open_problem(plans.problem)
    verdict = found.verdicts[chosen]
    note = f"sample {plans.sample_id[chosen]}: {verdict}"
    plot_plan(problem, robot, plans.motion, chosen, picture, scene=plans.scene[chosen], note=note, verdict=verdict)
    print(f"drawn: plan {chosen} in {picture}", file=sys.stderr)


def _draw_trajectory(found: "TrajectoryEvaluation", picture: str, index: int | None, labels: tuple[str, ...]) -> None:
    """Draw a trajectory, by default the first that is not valid, and mark what is not valid."""
    from cnpgen.judges.trajectories.trajectory_plot import plot_trajectory
    from cnpgen.plans import open_problem

    first = next((at for at, verdict in enumerate(found.verdicts) if not verdict.valid), 0)
    chosen = first if index is None else index
    trajectory, verdict = found.trajectories[chosen], found.verdicts[chosen]
    margins = [entry.margin for entry in verdict.conditions.values() if not entry.margin.ok]
    problem, robot = open_problem(found.problem)
    title = f"{problem.name}, {labels[chosen]}: {trajectory.duration:.3f} s\n{verdict}"
    plot_trajectory(problem, robot, trajectory, picture, title=title, margins=margins)
    print(f"drawn: trajectory {chosen} in {picture}", file=sys.stderr)


def _chosen(found: "Evaluation") -> int:
    """Choose the plan to draw: the first invalid one that can be drawn, else the first that can be drawn."""
    able = [index for index, verdict in enumerate(found.verdicts) if verdict.margins]
    if not able:
        raise DatasetError("none of the plans can be drawn: none can be evaluated")
    return next((index for index in able if not found.verdicts[index].valid), able[0])
