"""Sampled trajectories.

With --problem, FILE may also hold sampled trajectories: CSV, JSON, YAML, NPZ, HDF5 or
Parquet, messages of ROS and MoveIt, or a folder of such files ('cnpgen docs
trajectories'). Each trajectory is invalid, a valid motion through it exists, it is
valid for all curves, or it is undecided. The exit code is then 0 if a valid motion
exists for all, or they are valid for all curves, otherwise 1; 2 for damaged files and
files of other kinds.
"""

import argparse
import sys
from typing import TYPE_CHECKING

from cnpgen.addons.trajectories.trajectory_options import (
    add_trajectory_options,
    listing_text,
    load_file,
    problem_of,
    refuse_trajectory_options,
    summary_text,
    write_json,
)
from cnpgen.cli import values
from cnpgen.cli.evaluate_command import refuse_without_effect
from cnpgen.cli.parser import Options, refuse
from cnpgen.cli.terminal import Meter
from cnpgen.documents import Names
from cnpgen.errors import UsageError, counted

if TYPE_CHECKING:
    from cnpgen.addons.trajectories.evaluate_trajectories import TrajectoryEvaluation
    from cnpgen.addons.trajectories.load_trajectories import LoadedTrajectories


def add_options(options: Options) -> None:
    """Add the options that only sampled trajectories have."""
    add_trajectory_options(options)
    option = options.add_argument
    text = "judge a controller's curve; default: the motion that the samples resolve ('cnpgen docs trajectories')"
    option("--interpolation", choices=("hold", "linear", "cubic", "quintic"), help=text)
    text = "judge every curve through the samples whose jerks are at most J [rad/s^3]: one number, or one per joint"
    option("--max-jerk", metavar="J,...", type=values.amounts, help=text)
    text = "largest error of the samples in SI units: one number, or of q, dq and ddq (default: their rounding)"
    option("--noise", metavar="E,...", type=values.errors, help=text)
    text = "largest error of the times, such as 2ms; default: their rounding"
    option("--time-jitter", metavar="T", type=values.seconds, help=text)
    text = "judge the positions alone"
    option("--ignore-velocities", action="store_true", default=None, help=text)


def accepts(arguments: argparse.Namespace) -> bool:
    """Return whether the file holds sampled trajectories.

    Refuse their options for other files.
    """
    from cnpgen.addons.trajectories.trajectory_tables import holds_trajectories

    if holds_trajectories(arguments.file):
        return True
    refuse_trajectory_options(
        arguments,
        arguments.file,
        "interpolation",
        "max_jerk",
        "noise",
        "time_jitter",
        "ignore_velocities",
    )
    return False


def run(arguments: argparse.Namespace) -> int:
    """Judge sampled trajectories."""
    if arguments.tracking_error is not None:
        raise UsageError(
            "--tracking-error is for plans: --noise gives the error of sampled trajectories"
        )
    refuse_without_effect(arguments)
    if arguments.ignore_velocities:
        refuse(arguments, ["velocities"], "{} has no effect with --ignore-velocities")
    problem = problem_of(arguments)
    loaded = load_file(arguments, problem)
    count = len(loaded.trajectories)
    if arguments.plan is not None and arguments.plan >= count:
        raise UsageError(
            f"{arguments.file} has no trajectory {arguments.plan}: {counted(count, 'trajectory')}, numbered from 0"
        )
    found = _judged(arguments, loaded)
    if arguments.json:
        write_json(arguments.file, loaded, found)
    else:
        print(summary_text(arguments.file, found))
        if arguments.list:
            print(f"\n{listing_text(found, loaded.labels)}")
    if arguments.plot:
        _draw_trajectory(found, arguments.plot, arguments.plan, loaded.labels)
    return 0 if found.valid.all() else 1


def _judged(
    arguments: argparse.Namespace, loaded: "LoadedTrajectories"
) -> "TrajectoryEvaluation":
    """Judge the trajectories of a file, and show the progress."""
    from cnpgen.addons.trajectories.evaluate_trajectories import evaluate_trajectories

    quiet = arguments.quiet or not sys.stderr.isatty()
    with Meter(quiet=quiet, noun="trajectory") as meter:
        meter.begin(f"judging {arguments.file}", len(loaded.trajectories))
        return evaluate_trajectories(
            loaded.problem,
            loaded.trajectories,
            interpolation=arguments.interpolation,
            noise=arguments.noise,
            time_jitter=arguments.time_jitter,
            ignore_velocities=bool(arguments.ignore_velocities),
            max_jerk=arguments.max_jerk,
            step=arguments.step,
            workers=arguments.workers or 1,
            progress=meter,
        )


def _draw_trajectory(
    found: "TrajectoryEvaluation",
    picture: str,
    index: int | None,
    labels: Names,
) -> None:
    """Draw a trajectory, by default the first that is not valid, and mark its violations."""
    from cnpgen.addons.trajectories.trajectory_plot import plot_trajectory
    from cnpgen.addons.trajectories.trajectory_verdict import Decision
    from cnpgen.plans import open_problem

    first = next(
        (at for at, verdict in enumerate(found.verdicts) if not verdict.valid), 0
    )
    chosen = first if index is None else index
    trajectory = found.trajectories[chosen]
    verdict = found.verdicts[chosen]
    margins = [
        entry.margin
        for entry in verdict.conditions.values()
        if entry.is_measured and entry.decision == Decision.INVALID
    ]
    problem, robot = open_problem(found.problem)
    title = f"{problem.name}, {labels[chosen]}: {trajectory.duration:.3f} s\n{verdict}"
    plot_trajectory(problem, robot, trajectory, picture, title=title, margins=margins)
    print(f"drawn: trajectory {chosen} in {picture}", file=sys.stderr)
