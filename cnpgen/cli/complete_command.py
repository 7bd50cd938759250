"""Compute boundary problems for tasks in the workspace.

The stages of the pipeline compute everything that the tasks do not give:
'goal_xyz.x,goal_xyz.y,hit_angle' is enough to hit a puck. Columns have the names of
dataset fields, with components after a dot, in SI units. The start is given by joints
(start_q.*, start_dq.*, start_ddq.*) or by position (start_xyz.*); the default is the
problem's base at rest. The speed of a hit is the maximum unless hit_speed [m/s] or
hit_speed_share is given. 'cnpgen docs tasks' has examples. Tasks of a robot's problem,
such as panda, are goal poses: goal_xyz.*, goal_wxyz.*, with goal_xyz_tolerance.* and
goal_rotation_tolerance.* along and about the axes of the pose. 'cnpgen solve' plans the
best motion to any goal state. The boundary problems are written to OUT, which is
printed on stdout; 'cnpgen solve', 'refine' and 'plan' read it. Its sample_id is the
index of the task. Tasks without an answer are left out, with the reason on stderr. The
exit code is 1 if no task has an answer.
"""

import argparse
import json
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names
from cnpgen.cli.parser import EXTRAPOLATE, Parser, add_json
from cnpgen.errors import counted, listed

if TYPE_CHECKING:
    from cnpgen.make.complete import Completed

MAX_LISTED_TASKS = 10  # tasks without an answer that are listed by number


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option(
        "pipeline",
        metavar="NAME|FILE",
        type=recipe_names.tasks_of,
        help="a pipeline, dataset or problem by name, or a recipe file",
    )
    option(
        "tasks",
        metavar="TASKS",
        type=recipe_names.present,
        help="a table of tasks: CSV, or HDF5",
    )
    option(
        "-o",
        "--out",
        metavar="OUT",
        type=Path,
        required=True,
        help="file of boundary problems to write, .h5",
    )
    option("--force", action="store_true", help="replace OUT")
    option("--extrapolate", action="store_true", help=EXTRAPOLATE)
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from cnpgen.cli.refine_command import check_free
    from cnpgen.make.complete import complete
    from cnpgen.plans import save_plans

    check_free(arguments.out, force=arguments.force)
    found = complete(
        arguments.pipeline, arguments.tasks, extrapolate=arguments.extrapolate
    )
    # No file is written without any answer, and the exit code is 1.
    if len(found.plans):
        save_plans(arguments.out, found.plans)
    if not arguments.quiet:
        print("\n".join(_summary(found)), file=sys.stderr)
    if arguments.json:
        rejected = [
            {"task": task, "reason": reason}
            for task, reason in enumerate(found.reasons)
            if reason
        ]
        facts = {
            "file": str(arguments.out) if len(found.plans) else None,
            "tasks": len(found.reasons),
        }
        print(
            json.dumps(
                {**facts, "completed": len(found), "without_answer": rejected}, indent=2
            )
        )
    elif len(found.plans):
        print(arguments.out)
    return 0 if len(found.plans) else 1


def _summary(found: "Completed") -> list[str]:
    """Summarize how many tasks have an answer, and the reasons of the others."""
    lines = [f"{len(found):,} of {counted(len(found.reasons), 'task')} completed"]
    for reason, count in found.rejections.items():
        indices = [task for task, why in enumerate(found.reasons) if why == reason]
        named = f"task{'s' * (count > 1)} {listed(indices, MAX_LISTED_TASKS)}"
        lines += textwrap.wrap(
            f"  {count:,} {reason}: {named}", 110, subsequent_indent="    "
        )
    return lines
