"""Make plans of sampled trajectories.

The plans are initial guesses: 'cnpgen refine' optimizes them and keeps their ends, and
'cnpgen evaluate' judges them. Formats and columns are those of 'cnpgen evaluate'
('cnpgen docs trajectories'). The ends are moved onto the constraints by a change of
positions of at most three times the noise, or 1 mrad. The plan file is printed on
stdout.
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
    text = "also refine the plans, with at most this difference of every joint from the imported path, such as 2deg"
    option("--stay-within", metavar="E", type=values.angle, help=text)


def run(arguments: argparse.Namespace) -> None:
    import numpy as np

    from cnpgen.addons.trajectories.import_trajectories import import_trajectories
    from cnpgen.cli.refine_command import check_place
    from cnpgen.plans.plan_file import save_plans
    from cnpgen.store.files.kind import PLANS
    from cnpgen.store.paths import file_kind

    if file_kind(arguments.file) == PLANS:
        raise UsageError(
            f"{arguments.file} is {PLANS} already: 'cnpgen refine' optimizes them"
        )
    check_place(arguments.out, force=arguments.force)
    problem = problem_of(arguments)
    loaded = load_file(arguments, problem)
    imported = import_trajectories(
        loaded.problem,
        loaded.trajectories,
        noise=arguments.noise or 0.0,
        at_rest=arguments.at_rest,
        source=f"imported from {arguments.file.name}",
    )
    plans = (
        imported.plans
        if arguments.stay_within is None
        else _refined(imported.plans, arguments.stay_within)
    )
    save_plans(arguments.out, plans)
    points = imported.plans.path_control_points.shape[1]
    print(
        f"imported {counted(len(imported.plans), 'plan')} with {points} control points of the path;"
        f" largest distance from the samples {imported.deviation.max():.2g} rad",
        file=sys.stderr,
    )
    failed = np.flatnonzero(np.isnan(imported.snapped)).tolist()
    for index in failed:
        print(
            f"plan {index}: the ends cannot be moved onto the constraints by a small change",
            file=sys.stderr,
        )
    largest = (
        float(np.nanmax(imported.snapped)) if len(failed) < len(imported.plans) else 0.0
    )
    print(
        f"ends moved by at most {largest:.2g} rad to meet the constraints",
        file=sys.stderr,
    )
    print(arguments.out)


def _refined(plans: "Plans", distance: float) -> "Plans":
    """Refine plans near their paths.

    Report the number of valid plans and the largest distance on stderr.
    """
    from cnpgen.refine.options import RefineOptions
    from cnpgen.refine.refine_plans import refine_plans

    refinement = refine_plans(plans, options=RefineOptions(stay_within=distance))
    valid, largest = int(refinement.valid.sum()), float(refinement.deviation.max())
    print(
        f"refined: {valid} of {len(plans)} valid, at most {largest:.2g} rad from the imported path",
        file=sys.stderr,
    )
    return refinement.plans
