"""Make plans of sampled trajectories.

The plans are initial guesses: 'cnpgen refine' optimizes them and keeps their ends, and
'cnpgen evaluate' judges them. Formats and columns are those of 'cnpgen evaluate'
('cnpgen docs trajectories'). The ends are moved onto the constraints by a change of
positions of at most three times the noise, or 1 mrad. The plan file is printed on
stdout. The exit code is 1 if a plan is farther from its samples than 2 mrad plus the
noise; these plans are listed with their distance.
"""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.addons.trajectories.trajectory_options import (
    add_trajectory_options,
    load_file,
    problem_of,
)
from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import Parser
from cnpgen.errors import UsageError, counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cnpgen.addons.trajectories.import_trajectories import ImportedTrajectories
    from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
    from cnpgen.plans import Plans


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option(
        "file",
        metavar="FILE",
        type=recipe_names.present,
        help="file of trajectories, or a folder of them",
    )
    text = "the problem of the trajectories"
    option(
        "--problem",
        metavar="NAME|FILE",
        type=recipe_names.problem,
        required=True,
        help=text,
    )
    option(
        "-o",
        "--out",
        metavar="PLANS",
        type=Path,
        required=True,
        help="plan file to write, .h5",
    )
    option("--force", action="store_true", help="replace PLANS")
    add_trajectory_options(parser)
    text = "largest error of the samples in SI units: one number, or of positions, velocities and accelerations"
    option("--noise", metavar="E,...", type=values.errors, help=text)
    text = "all motions are at rest at this end; without a value, at both"
    option(
        "--at-rest",
        metavar="END",
        choices=("start", "goal"),
        nargs="?",
        const=True,
        default=False,
        help=text,
    )
    text = "also refine the plans, with at most this difference of every joint from the samples of the file, such as 2deg"
    option("--stay-within", metavar="E", type=values.angle, help=text)


def run(arguments: argparse.Namespace) -> int:
    from cnpgen.addons.trajectories.import_trajectories import import_trajectories
    from cnpgen.cli.refine_command import check_free
    from cnpgen.plans.plan_file import save_plans
    from cnpgen.store.files.kind import PLANS
    from cnpgen.store.paths import file_kind

    if file_kind(arguments.file) == PLANS:
        raise UsageError(
            f"{arguments.file} is {PLANS} already: 'cnpgen refine' optimizes them"
        )
    check_free(arguments.out, force=arguments.force)
    problem = problem_of(arguments)
    loaded = load_file(arguments, problem)
    imported = import_trajectories(
        loaded.problem,
        loaded.trajectories,
        noise=arguments.noise or 0.0,
        at_rest=arguments.at_rest,
        source=f"imported from {arguments.file.name}",
    )
    _report(imported)
    plans = imported.plans
    if arguments.stay_within is not None and imported.meets_samples.all():
        plans = _refined(imported, loaded.trajectories, arguments.stay_within)
    save_plans(arguments.out, plans)
    print(arguments.out)
    return 0 if imported.meets_samples.all() else 1


def _report(imported: "ImportedTrajectories") -> None:
    """Print the distances of plans from their samples, and the changes of their ends, on stderr."""
    import numpy as np

    plans = imported.plans
    deviation = imported.deviation
    points = plans.path_control_points.shape[1]
    lines = [
        f"imported {counted(len(plans), 'plan')} with {points} control points of the path;"
        f" largest distance from the samples {deviation.max():.2g} rad"
    ]
    lines += [
        f"plan {index}: {deviation[index]:.2g} rad from its samples, more than {imported.max_deviation:.2g} rad:"
        f" {points} control points are too few, separate the motion into several"
        for index in np.flatnonzero(~imported.meets_samples).tolist()
    ]
    failed = np.flatnonzero(np.isnan(imported.snapped)).tolist()
    lines += [
        f"plan {index}: the ends cannot be moved onto the constraints by a small change"
        for index in failed
    ]
    moved = np.nanmax(imported.snapped) if len(failed) < len(plans) else 0.0
    lines.append(f"ends moved by at most {moved:.2g} rad to meet the constraints")
    print("\n".join(lines), file=sys.stderr)


def _refined(
    imported: "ImportedTrajectories",
    trajectories: "Sequence[Trajectory]",
    distance: float,
) -> "Plans":
    """Refine plans within a distance of the samples of their file [rad].

    The distance of the fit is part of it. Report the number of valid plans and the
    largest distance on stderr.
    """
    from cnpgen.addons.trajectories.import_trajectories import distance_from_samples
    from cnpgen.refine.options import RefineOptions
    from cnpgen.refine.refine_plans import refine_plans

    plans = imported.plans
    fit = float(imported.deviation.max())
    if fit >= distance:
        raise UsageError(
            f"--stay-within must be above the distance of the plans from their samples, {fit:.2g} rad,"
            f" got {distance:.2g} rad"
        )
    options = RefineOptions(stay_within=distance - fit)
    refinement = refine_plans(plans, options=options)
    valid = int(refinement.valid.sum())
    largest = distance_from_samples(refinement.plans, plans, trajectories).max()
    print(
        f"refined: {valid} of {len(plans)} valid, at most {largest:.2g} rad from the imported samples",
        file=sys.stderr,
    )
    return refinement.plans
