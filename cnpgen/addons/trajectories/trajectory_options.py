"""Options of commands that read sampled trajectories, and the output of their verdicts."""

import argparse
import json
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import Options, options_of
from cnpgen.cli.terminal import table
from cnpgen.cli.verdict_text import margin_cells, margin_head
from cnpgen.documents import Names, TextRows
from cnpgen.errors import UsageError, counted, listed

if TYPE_CHECKING:
    from cnpgen.addons.trajectories.evaluate_trajectories import TrajectoryEvaluation
    from cnpgen.addons.trajectories.load_trajectories import LoadedTrajectories
    from cnpgen.problems.problem import Problem

# Of load_trajectories.
TRAJECTORY_OPTIONS = (
    "joints",
    "velocities",
    "time",
    "unit",
    "rate",
    "separator",
    "separate_by",
    "unwrap",
    "drop_repeats",
    "parameters",
    "scenes",
    "topic",
    "allow_unused",
)
MAX_IGNORED = 8  # unused columns that are listed
MAX_NOTES = 5  # that are printed


def add_trajectory_options(option: Options) -> None:
    """Add the options that determine how a file is read."""
    add = option.add_argument
    add(
        "--joints",
        metavar="A,B,...",
        type=values.names,
        help="names of the problem's joints in the file, in order",
    )
    add(
        "--velocities",
        metavar="A,B,...",
        type=values.names,
        help="columns with the velocities of these joints, if they have other names",
    )
    text = "column of the times, with its unit if it has another than s: 'stamp [ms]'"
    add("--time", metavar="COLUMN", help=text)
    add(
        "--unit",
        choices=("rad", "deg"),
        help="unit of columns without a unit in their name (default: rad)",
    )
    add(
        "--rate",
        metavar="HZ",
        type=values.hertz,
        help="samples per second of a file without times",
    )
    text = "separator of columns in text files (default: the comma, semicolon, tab or spaces of the first line)"
    add("--separator", metavar="TEXT", help=text)
    text = "column whose value differs from trajectory to trajectory"
    add("--separate-by", metavar="COLUMN", help=text)
    _add_repairs(option)
    _add_context_options(option)


def _add_repairs(option: Options) -> None:
    """Add the options that change samples."""
    add = option.add_argument
    add(
        "--unwrap",
        action="store_true",
        default=None,
        help="continue angles that jump by more than half a turn",
    )
    add(
        "--drop-repeats",
        action="store_true",
        default=None,
        help="drop rows that repeat the time and the positions of the row before",
    )


def _add_context_options(option: Options) -> None:
    """Add the options that state what the file does not have, or has too much."""
    add = option.add_argument
    text = "values of the problem's parameters that the file does not have, such as payload_mass=6kg"
    add("--parameters", metavar="NAME=V,...", type=values.parameters, help=text)
    text = "obstacles around the trajectories: a file of scenes or of plans; one for each trajectory, or one for all"
    add("--scenes", metavar="FILE", type=recipe_names.present, help=text)
    text = "topic of a bag of ROS, if several have trajectories"
    add("--topic", metavar="NAME", help=text)
    text = "element of a message or scene that may be left unused; may be repeated"
    add("--allow-unused", metavar="KEY", action="append", help=text)
    text = "body at the tip, in place of the problem's: mass [kg], or mass and centre of mass in the tip frame [m]"
    add("--payload", metavar="M[,X,Y,Z]", type=values.payload, help=text)


def refuse_trajectory_options(
    arguments: argparse.Namespace, file: Path, *others: str
) -> None:
    """Refuse options of sampled trajectories for a plan file or a dataset."""
    for name, value in options_of(
        arguments, *TRAJECTORY_OPTIONS, "payload", *others
    ).items():
        if value is not None:
            raise UsageError(
                f"--{name.replace('_', '-')} is for sampled trajectories, {file} holds plans"
            )


def problem_of(arguments: argparse.Namespace) -> "str | Problem":
    """Return the problem of a command, with the payload of its options."""
    from cnpgen.addons.trajectories.trajectory_scenes import problem_of_samples
    from cnpgen.problems.problem_record import as_problem
    from cnpgen.robots.robot_spec import Payload

    name: str | None = arguments.problem
    if name is None:
        raise UsageError(
            "sampled trajectories need {problem}", remedies={"problem": None}
        )
    if arguments.payload is None:
        return name
    mass, *centre = arguments.payload
    body = (
        Payload(mass=mass)
        if not centre
        else Payload(mass=mass, centre=(centre[0], centre[1], centre[2]))
    )
    return replace(as_problem(problem_of_samples(name)), payload=body)


def load_file(
    arguments: argparse.Namespace, problem: "str | Problem"
) -> "LoadedTrajectories":
    """Load the trajectories of a command, and list the columns that are not used on stderr."""
    from cnpgen.addons.trajectories.load_options import LoadOptions
    from cnpgen.addons.trajectories.load_trajectories import load_trajectories

    given = options_of(arguments, *TRAJECTORY_OPTIONS)
    given = {name: value for name, value in given.items() if value is not None}
    if getattr(arguments, "extrapolate", False):
        given["extrapolate"] = True
    names = given.keys() & {entry.name for entry in fields(LoadOptions)}
    reading = LoadOptions(**{name: given.pop(name) for name in names})
    loaded = load_trajectories(arguments.file, problem, options=reading, **given)
    if loaded.ignored:
        print(
            f"not used: {listed(loaded.ignored, MAX_IGNORED)}",
            file=sys.stderr,
        )
    for note in loaded.notes[:MAX_NOTES]:
        print(f"note: {note}", file=sys.stderr)
    if (more := len(loaded.notes) - MAX_NOTES) > 0:
        print(f"note: {counted(more, 'further note')}", file=sys.stderr)
    return loaded


def write_json(
    file: Path, loaded: "LoadedTrajectories", found: "TrajectoryEvaluation"
) -> None:
    """Write all verdicts, what was not used of the file, and the notes of its reading, as JSON."""
    rows = [
        {"trajectory": index, "place": label, **verdict.to_dict()}
        for index, (label, verdict) in enumerate(
            zip(loaded.labels, found.verdicts, strict=True)
        )
    ]
    document = {
        "file": str(file),
        "unused": list(loaded.ignored),
        "notes": list(loaded.notes),
        **found.summary(),
        "verdicts": rows,
    }
    print(json.dumps(document, indent=2, ensure_ascii=False))


def summary_text(file: Path, found: "TrajectoryEvaluation") -> str:
    """Return the counts, and for every condition the decisions with the worst margin."""
    from cnpgen.addons.trajectories.contradicting_columns import CONTRADICTION

    counts = ", ".join(
        f"{count:,} {statement}" for statement, count in found.statements.items()
    )
    lines = [f"{file}: trajectories of {found.problem.name}: {counts}"]
    lines += found.judged_limits.lines
    for source, count in found.assumed_errors.items():
        lines.append(f"assumed for {count:,}, at least that of the numbers: {source}")
    if found.assumed_errors:
        lines.append("  a sensor has more: --noise and --time-jitter state it")
    lines.append("")
    summary = found.summary()
    if summary["conditions"]:
        lines += _condition_tables(found, summary["conditions"])
    # Of each reason, the first proof is printed.
    proofs = {v.reason: f": {v.detail}" for v in reversed(found.verdicts) if v.detail}
    lines.append("")
    for reason, count in summary["reasons"].items():
        lines.append(f"  {count:,} because of: {reason}{proofs.get(reason, '')}")
    if CONTRADICTION in summary["reasons"]:
        lines.append("  --ignore-velocities judges the positions alone")
    return "\n".join(lines).rstrip()


def _condition_tables(
    found: "TrajectoryEvaluation", conditions: dict[str, dict[str, int]]
) -> list[str]:
    """Return the table of decisions about conditions, and that of their worst margins."""
    decided: TextRows = [
        (
            "condition",
            "valid",
            "invalid",
            "undecided",
            "time violated",
            "time undecided",
            "",
        )
    ]
    margins = [margin_head("condition", item="trajectory")]
    for name, decisions in conditions.items():
        entries = [
            (index, v.conditions[name])
            for index, v in enumerate(found.verdicts)
            if name in v.conditions
        ]
        worst, entry = max(
            entries, key=lambda item: (item[1].is_measured, item[1].margin.severity)
        )
        shares = [
            _largest([getattr(e, share) for _, e in entries])
            for share in ("violated_share", "undecided_share")
        ]
        counted = [
            f"{decisions[decision]:,}" for decision in ("valid", "invalid", "undecided")
        ]
        decided.append((name, *counted, *shares, ""))
        margins.append((name, *margin_cells(entry.to_dict()["margin"], worst)))
    return [
        *table(decided, indent="  ", right=(1, 2, 3, 4, 5)),
        "",
        *table(margins, indent="  ", right=(1, 2, 3, 5, 6)),
    ]


def _largest(shares: list[float | None]) -> str:
    """Format the largest share of time that was measured."""
    known = [share for share in shares if share is not None]
    return f"{max(known):.1%}" if known else "-"


def listing_text(found: "TrajectoryEvaluation", labels: Names) -> str:
    """Return one line for each trajectory, with those that are not valid first."""
    order = sorted(range(len(labels)), key=lambda index: found.verdicts[index].valid)
    return "\n".join(
        f"{index}  {labels[index]}  {found.verdicts[index]}" for index in order
    )
