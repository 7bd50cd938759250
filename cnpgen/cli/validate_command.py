"""``cnpgen validate``: prove that a dataset is what it says it is."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import values
from cnpgen.cli.parser import Commands, Parser, add_command, add_engine, add_json
from cnpgen.cli.progress import Meter

if TYPE_CHECKING:
    from cnpgen.validate.dataset import ValidationReport

_TEXT = """\
Always checked: that every file is there, whole (sha256) and what plan.json and the manifest say. --deep reads every
row: constraints, positions, hits and their highest speeds, torque ratios, clearances, stored ranges, statistics,
counts, and rows that stand there twice; of "attempts" only the sum per shard. Every row's attempts, the columns of
plug-ins, and which draws became rows are for --regenerate to prove. It draws and solves blocks of 4096 rows again from
the seed: with the backend, the kind of machine and the versions that made the dataset every bit is the same; elsewhere
rows that agree to rounding (1e-9) are no finding.

On stdout are the findings, one per line, as FILE: PROBLEM, and what was checked; with --quiet the findings only. A line
that begins with "note:" is worth knowing and no finding. Of a certified dataset --deep judges the plans, too, as
'cnpgen evaluate' does. Exit codes: 0 nothing was found, 1 there are findings, 2 a wrong argument, 3 this machine cannot
check it: --regenerate of what compiled kernels have made needs a C compiler, and what plug-ins are part of needs them
for --deep and --regenerate; without these options nothing but the files is needed.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "validate", run, title="prove that a dataset is what it says it is", text=_TEXT)
    option = parser.add_argument
    option("folder", metavar="DIR", type=Path, help="folder of a dataset")
    option("--deep", action="store_true", help="check every row, its constraints with Pinocchio and Coal")
    option(
        "--regenerate",
        metavar="K",
        type=values.natural,
        default=0,
        help="make K random blocks, or all if there are fewer, again from the seed and compare them",
    )
    option("--workers", metavar="W", type=values.positive, help="processes for --deep; default one per available core")
    add_engine(parser)
    option("--quiet", action="store_true", help="no progress and no summary: nothing at all if nothing is wrong")
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from cnpgen.store.files.documents import plain, render

    report = _validate(arguments)
    if arguments.json:
        print(render(plain(report.to_dict())))
    else:
        for finding in report.findings:
            if not (finding.note and arguments.quiet):
                note = "note: " if finding.note else ""
                print(f"{note}{finding.file}: {' '.join(finding.problem.split())}")
        if not arguments.quiet:
            print(report.summary())
    return 0 if report.ok else 1


def _validate(arguments: argparse.Namespace) -> "ValidationReport":
    from cnpgen.validate.dataset import validate_dataset

    names = ("deep", "regenerate", "workers", "engine", "address")
    options = {name: getattr(arguments, name) for name in names}
    rows = _rows(arguments.folder) if arguments.deep else 0
    if not rows:
        return validate_dataset(arguments.folder, **options)
    meter = Meter(quiet=arguments.quiet)
    meter.begin(f"validating {arguments.folder}", rows)
    try:
        return validate_dataset(arguments.folder, **options, progress=meter)
    finally:
        meter.close()


def _rows(folder: Path) -> int:
    """Return how many rows there are to compute again; 0 if plan.json cannot say, which validation will report."""
    from cnpgen.errors import DatasetError
    from cnpgen.store.blueprint import load_blueprint, shards
    from cnpgen.store.record import is_committed

    try:
        blueprint = load_blueprint(folder)
    except DatasetError:
        return 0
    return sum(task.rows for task in shards(blueprint) if is_committed(folder, blueprint, task))
