"""Write plans as sampled trajectories.

npz, parquet and mpd (B-splines of the paths) are one file. csv, joint-trajectory (a
message of ROS 2, as JSON) and ros2-control (the goal of a trajectory controller, as
YAML) are a folder with one file per plan. lerobot is a dataset in a folder
(LeRobotDataset v3), with --rate frames per second. 'cnpgen list exporters' shows all
formats, including those of installed packages. 'cnpgen docs plan-format' shows how to
read them. The path of the output is printed on stdout. Plans that cannot be sampled are
left out and listed on stderr; the exit code is then 1. With --join, positions,
velocities and accelerations must be continuous from plan to plan (1e-9 in SI);
otherwise nothing is written.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import Parser, refuse
from cnpgen.errors import UsageError, counted, listed

if TYPE_CHECKING:
    from cnpgen.plans import Plans
    from cnpgen.plans.export import Exported
    from cnpgen.plans.exporter import Exporter
    from cnpgen.plans.join import JoinedPlans

DEFAULT_RATE_HZ = 1000.0
MAX_LISTED_PLANS = 10  # invalid plans that are listed by number
NO_OBSTACLES = "the output lacks the obstacles of the plans: 'cnpgen evaluate OUT --problem P --scenes FILE' takes them"


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option(
        "file",
        metavar="FILE",
        type=recipe_names.present_or_model,
        help="plan file, .h5",
    )
    text = "format: npz, csv, parquet, lerobot, mpd, ... ('cnpgen list exporters')"
    option("--to", metavar="FORMAT", required=True, help=text)
    option(
        "--rate",
        metavar="HZ",
        type=values.hertz,
        help=f"samples per second (default: {DEFAULT_RATE_HZ:g})",
    )
    text = "file (npz) or folder to write; default: in the current folder, named after FILE and FORMAT"
    option("-o", "--out", metavar="PATH", type=Path, help=text)
    option(
        "--plan",
        metavar="I",
        type=values.numbers,
        help="these plans only, by index: 0,3,10-12",
    )
    option(
        "--sample",
        metavar="I",
        type=values.numbers,
        help="these samples' plans only, by sample_id; adds to --plan",
    )
    text = "cut every plan of FILE and continue with the plan of the same number of this file; may be repeated"
    option("--join", metavar="NEXT", type=Path, action="append", help=text)
    text = "time at which NEXT takes over: 330ms; once per --join (default: at the end)"
    option("--at", metavar="S", type=values.seconds, action="append", help=text)
    option("--force", action="store_true", help="replace existing files")


def run(arguments: argparse.Namespace) -> int:
    return export(arguments, _plans(arguments))


def export(
    arguments: argparse.Namespace,
    plans: "Plans | JoinedPlans",
    sources: Sequence[Path] = (),
) -> int:
    """Export plans, which also depend on files beside those that the options name."""
    from cnpgen.cli.finished import content_sha256, is_finished, record_request
    from cnpgen.plans.export import export_plans, load_exporter
    from cnpgen.problems.problem_record import open_problem

    exporter = load_exporter(arguments.to)
    if not exporter.samples:
        refuse(arguments, ["rate"], f"{{}} has no effect with --to {arguments.to}")
    rate = DEFAULT_RATE_HZ if arguments.rate is None else arguments.rate
    chosen = _chosen(plans, arguments)
    out = _place(arguments, exporter)
    target = _target(out, exporter)
    to = arguments.to
    force = arguments.force
    # The result depends on the contents of all files that are read, not on their names.
    files = Path(arguments.file), *(arguments.join or ()), *sources
    request = [to, rate, chosen, arguments.at, [content_sha256(file) for file in files]]
    if is_finished(target, request, force=force):
        print(f"{target} is there already, of the same request", file=sys.stderr)
        print(target)
        return 0
    exported = export_plans(plans, out, to=to, rate=rate, only=chosen, force=force)
    lacks_scene = not exporter.uses_environment
    if lacks_scene and open_problem(plans.problem)[0].has_sample_obstacles:
        print(f"cnpgen: note: {NO_OBSTACLES}", file=sys.stderr)
    # A result with plans left out ends with 1 again, so it is no finished one.
    refused = len(exported.refused)
    if not refused:
        record_request(target, request)
    _report(exported, f" at {rate:g} Hz" if exporter.samples else "")
    print(exported.files[0] if exporter.single_file else out)
    return 1 if refused else 0


def _report(exported: "Exported", at_rate: str) -> None:
    """Report plans that were left out, exported ones that are not valid, and the number of all."""
    for why in exported.refused.values():
        print(f"cnpgen: left out: {why}", file=sys.stderr)
    if exported.invalid:
        which = f"plan{'s' * (len(exported.invalid) > 1)} {listed(exported.invalid, MAX_LISTED_PLANS)}"
        text = f"not valid by their status ('cnpgen evaluate' reports why): {which}"
        print(f"cnpgen: warning: {text}", file=sys.stderr)
    refused = len(exported.refused)
    of_all = f" of {exported.count + refused:,}" if refused else ""
    count = counted(exported.count, "plan")
    print(f"exported {count}{of_all}{at_rate}", file=sys.stderr)


def _plans(arguments: argparse.Namespace) -> "Plans | JoinedPlans":
    """Read the plans, and join them with the following ones."""
    from cnpgen.plans.join import join_plans

    plans: Plans | JoinedPlans = recipe_names.read_plans(arguments.file)
    following = arguments.join or []
    times = arguments.at or []
    if times and len(times) != len(following):
        given = f"--at is given {counted(len(times), 'time')}, --join {counted(len(following), 'time')}"
        raise UsageError(f"{given}: expected one for each")
    # Without times each plan takes over at the end of the one before.
    for file, time in zip(following, times or [None] * len(following), strict=True):
        plans = join_plans(plans, recipe_names.read_plans(file), at=time)
    return plans


def _place(arguments: argparse.Namespace, exporter: "Exporter") -> Path:
    """Return the output path, which must be writable."""
    from cnpgen.store.files.atomic import check_writable

    file: Path = arguments.file
    name = (
        f"{file.stem}{exporter.suffix}"
        if exporter.single_file
        else f"{file.stem}-{arguments.to}"
    )
    out: Path = arguments.out or Path(name)
    if not out.parent.is_dir():
        raise UsageError(f"{out} must be in a folder that exists")
    is_file = exporter.single_file and not exporter.is_folder and not out.is_dir()
    if is_file and not out.name.endswith(exporter.suffix):
        raise UsageError(
            f"-o {out}: {arguments.to} writes a file whose name ends with {exporter.suffix}, expected {out}{exporter.suffix}"
        )
    check_writable(out)
    return out


def _target(out: Path, exporter: "Exporter") -> Path:
    """Return the file or folder that an exporter writes."""
    # A folder given for a single file gets it with a name of its own.
    inside = exporter.single_file and out.is_dir() and not exporter.is_folder
    return out / f"plans{exporter.suffix}" if inside else out


def _chosen(
    plans: "Plans | JoinedPlans", arguments: argparse.Namespace
) -> list[int] | None:
    """Return the indices of the selected plans, or None for all of them."""
    import numpy as np

    if arguments.plan is None and arguments.sample is None:
        return None
    chosen = set(arguments.plan or ())
    if chosen and max(chosen) >= len(plans):
        raise UsageError(
            f"there is no plan {max(chosen)}: {counted(len(plans), 'plan')}, numbered from 0"
        )
    if arguments.sample is not None:
        missing = np.setdiff1d(arguments.sample, plans.sample_id)
        if missing.size:
            raise UsageError(f"{arguments.file} has no plan of sample {missing[0]}")
        chosen |= set(
            np.flatnonzero(np.isin(plans.sample_id, arguments.sample)).tolist()
        )
    return sorted(chosen)
