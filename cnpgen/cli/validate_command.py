"""Verify a dataset.

The command always checks that every file exists and matches its sha256, the
specification and the manifest. --deep checks every sample: constraints, positions, hits
and their maximum speeds, torque ratios, clearances, ranges, statistics, counts and
duplicates; of "attempts" only the sum per shard. It judges the plans of a certified
dataset as 'cnpgen evaluate' does. --regenerate makes blocks of 4096 samples again from
the seed and checks everything else: the attempts of each sample, columns of plug-ins,
and which candidates were accepted. With the same backend, kind of machine and versions
every bit is equal; elsewhere samples must agree to 1e-9.

Findings are printed on stdout, one per line, as FILE: PROBLEM, followed by a summary of
the checks; --quiet prints the findings only. A line that begins with "note:" is no
finding. Exit codes: 0 no findings, 1 findings, 2 a wrong argument, 3 this machine
cannot check it: --regenerate of a compiled dataset needs LLVM, and --deep and
--regenerate need the plug-ins of the dataset.
"""

import argparse
from pathlib import Path

from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import ENGINE, Parser, add_engine, add_json, options_of, refuse
from cnpgen.cli.terminal import Meter
from cnpgen.errors import DatasetError


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option(
        "folder", metavar="DIR", type=recipe_names.dataset, help="folder of a dataset"
    )
    option(
        "--deep",
        action="store_true",
        help="check every row, its constraints with Pinocchio and Coal",
    )
    option(
        "--regenerate",
        metavar="K",
        type=values.natural,
        default=0,
        help="make K random blocks again from the seed and compare them",
    )
    add_engine(parser, "processes for --deep; default one per available core")
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from cnpgen.store.files.documents import plain, render
    from cnpgen.validate.validate_dataset import validate_dataset

    if not arguments.deep:
        refuse(arguments, ENGINE, "{} needs --deep")
    options = options_of(arguments, "deep", "regenerate", *ENGINE)
    with Meter(quiet=arguments.quiet) as meter:
        # Only --deep reads samples, which the bar counts.
        if rows := _rows(arguments.folder) if arguments.deep else 0:
            meter.begin(f"validating {arguments.folder}", rows)
            options["progress"] = meter
        report = validate_dataset(arguments.folder, **options)
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


def _rows(folder: Path) -> int:
    """Return the number of samples to check.

    0 if the specification is damaged, which validation reports.
    """
    from cnpgen.store.dataset_spec import load_dataset_spec, shards
    from cnpgen.store.shard_record import is_committed

    try:
        spec = load_dataset_spec(folder)
    except DatasetError:
        return 0
    return sum(task.rows for task in shards(spec) if is_committed(folder, spec, task))
