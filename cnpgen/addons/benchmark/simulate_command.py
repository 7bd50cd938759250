"""Execute the plans of a file in MuJoCo.

Every plan is executed separately by computed torque at 1 kHz on a robot with friction;
its controller knows that of [drive] only. On a table, a plan that ends with a velocity
is a hit: the puck lies 7 cm ahead of its end. 'cnpgen docs benchmark' describes the
simulation and its results. The exit code is 0 if every plan succeeds (it scores without
touching the puck early, or reaches its goal without collision), and 1 otherwise.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import Parser, add_json, refuse
from cnpgen.cli.terminal import Meter, table
from cnpgen.errors import UsageError, counted

if TYPE_CHECKING:
    from cnpgen.addons.benchmark.simulator.plant import Plant
    from cnpgen.addons.benchmark.simulator.simulate import Simulation
    from cnpgen.plans import Plans

PLANTS = ("nominal", "heavier", "delayed")

_NAMES = {
    "success": "success",
    "finished": "at the goal at the end of the plan",
    "hit": "hit the puck",
    "scored": "scored",
    "touched_early": "touched the puck early",
    "collided": "collided",
}
_FIGURES = {
    "hit_time_s": ("time to hit [s]", "{:.3f}"),
    "puck_speed_m_s": ("puck speed [m/s]", "{:.2f}"),
    "z_error_mm_s": ("z error, executed [mm s]", "{:.3f}"),
    "vertical_error_rad_s": ("vertical error, executed [rad s]", "{:.4f}"),
    "tracking_error_rad_s": ("tracking error [rad s]", "{:.4f}"),
    "torque_use": ("largest torque / rated", "{:.2f}"),
}


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option("file", metavar="FILE", type=Path, help="plan file, .h5")
    option(
        "--problem",
        metavar="NAME|FILE",
        type=recipe_names.problem,
        help="the problem of the plans",
    )
    where = parser.add_mutually_exclusive_group().add_argument
    where(
        "--plant",
        choices=PLANTS,
        default="nominal",
        help=f"the robot: {', '.join(PLANTS)} (default: nominal)",
    )
    where(
        "--environment",
        metavar="PATH",
        type=Path,
        help="clone of the Air Hockey Challenge that executes them",
    )
    option(
        "--workers",
        metavar="W",
        type=values.positive,
        help="processes; default one per available core",
    )
    _add_outputs(parser)


def _add_outputs(parser: Parser) -> None:
    """Add the options of what is printed and drawn."""
    option = parser.add_argument
    option("--list", action="store_true", help="also list the plans, one per line")
    option(
        "--plan",
        metavar="I",
        type=values.natural,
        default=0,
        help="plan to draw (default: 0)",
    )
    option(
        "--image",
        metavar="PICTURE",
        type=values.file_in(".png"),
        help="draw the world at the end of one plan: .png",
    )
    option(
        "--video",
        metavar="FILM",
        type=values.file_in(".mp4", ".gif"),
        help="film one plan: .mp4 or .gif",
    )
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from cnpgen.addons.benchmark.simulator.simulate import simulate_plans

    if not (arguments.image or arguments.video):
        refuse(arguments, ["plan"], "{} needs --image or --video")
    plans = recipe_names.read_plans(arguments.file, problem=arguments.problem)
    if arguments.plan >= len(plans):
        raise UsageError(
            f"{arguments.file} has no plan {arguments.plan}: {counted(len(plans), 'plan')}, numbered from 0"
        )
    with Meter(quiet=arguments.quiet or not sys.stderr.isatty(), noun="plan") as meter:
        meter.begin(f"executing {arguments.file}", len(plans))
        found = simulate_plans(
            plans,
            plant=arguments.plant,
            environment=arguments.environment,
            workers=arguments.workers,
            progress=meter,
        )
    if arguments.json:
        rows = [
            {"plan": index, **each.to_dict()}
            for index, each in enumerate(found.executed)
        ]
        print(
            json.dumps(
                {"file": str(arguments.file), **found.summary(), "executed": rows},
                indent=2,
            )
        )
    else:
        print(_text(arguments.file, found))
        if arguments.list:
            print("\n" + "\n".join(_lines(found)))
    _draw(arguments, plans[arguments.plan], found.plant)
    return 0 if all(each.success for each in found.executed) else 1


def _text(file: Path, found: "Simulation") -> str:
    """Lay out what came of all plans together."""
    summary = found.summary()
    count = len(found.executed)
    head = f"{file}: {counted(count, 'plan')} of {found.plans.problem.name}, executed by the {found.plant.name} plant"
    counts = {text: summary[name] for name, text in _NAMES.items() if name in summary}
    tallies = [
        (text, f"{number:,} of {count:,}", f"{number / count:.2%}")
        for text, number in counts.items()
    ]
    shown = {
        name: figure
        for name, figure in _figures(found).items()
        if name in summary["medians"]
    }
    figures = [
        (text, form.format(summary["medians"][name]))
        for name, (text, form) in shown.items()
    ]
    lines = [
        head,
        "",
        *table(tallies, indent="  ", right=(1, 2)),
        "",
        "  medians",
        *table(figures, indent="    "),
    ]
    refused = [
        (index, each.failure)
        for index, each in enumerate(found.executed)
        if each.failure
    ]
    return "\n".join(
        lines + [f"  plan {index} was not executed: {why}" for index, why in refused]
    )


def _figures(found: "Simulation") -> dict[str, tuple[str, str]]:
    """Return the figures that are shown, with text and format.

    That of the tilt only if a constraint limits it.
    """
    uses = {
        constraint.get("use")
        for constraint in found.plans.problem.content.get("constraint", [])
    }
    hidden = set() if uses & {"vertical", "axis", "pose"} else {"vertical_error_rad_s"}
    return {name: figure for name, figure in _FIGURES.items() if name not in hidden}


def _lines(found: "Simulation") -> list[str]:
    """List the plans."""
    lines = []
    for index, each in enumerate(found.executed):
        row = each.to_dict()
        flags = [text for name, text in _NAMES.items() if row.get(name) is True]
        figures = [
            f"{text} {form.format(row[name])}"
            for name, (text, form) in _figures(found).items()
            if name in row
        ]
        lines.append(f"plan {index}: {'; '.join([*flags, *figures]) or each.failure}")
    return lines


def _draw(arguments: argparse.Namespace, plan: "Plans", plant: "Plant") -> None:
    from cnpgen.addons.benchmark.simulator.rendering import save_film, save_picture
    from cnpgen.addons.benchmark.simulator.simulate import execute_plan

    if not (arguments.image or arguments.video):
        return
    execution = execute_plan(plan, plant)
    if arguments.image:
        save_picture(Path(arguments.image), execution)
        print(f"drawn: plan {arguments.plan} in {arguments.image}", file=sys.stderr)
    if arguments.video:
        save_film(Path(arguments.video), execution)
        print(f"filmed: plan {arguments.plan} in {arguments.video}", file=sys.stderr)
