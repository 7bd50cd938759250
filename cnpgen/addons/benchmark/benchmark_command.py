"""Compare planners on the problems of a suite.

Each planner solves one problem after the other, in its own process and on one thread.
Pinocchio and Coal judge the answers, and with --simulate MuJoCo executes them. Every
finished problem is written to DIR at once, one file per planner. After an interruption
the same command resumes; more --planners or --plant extend the results. If a planner
crashes, times out or returns an invalid result, only that problem is marked as failed.
With --engine several workers plan at once, so compare CPU times only. 'cnpgen docs
benchmark' describes suites and planners. The exit code is 0 if the benchmark is
complete, also if planners failed.
"""

import argparse
import json
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cnpgen.cli import recipe_names, values
from cnpgen.cli.interruption import resumable
from cnpgen.cli.parser import (
    ENGINE,
    Parser,
    add_engine,
    add_json,
    options_of,
    refuse,
    refuse_others,
)
from cnpgen.cli.terminal import Meter, table
from cnpgen.documents import JsonObject
from cnpgen.errors import CnpgenError, UsageError, counted

if TYPE_CHECKING:
    from cnpgen.addons.benchmark.run_suite import Benchmark

REPORT = "report.html"


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option(
        "suite",
        metavar="SUITE",
        nargs="?",
        type=recipe_names.suite,
        help="a suite (see --list), or a dataset for random problems",
    )
    option(
        "--list",
        action="store_true",
        help="list suites, planners with their fields, and plants",
    )
    option(
        "-o",
        "--out",
        metavar="DIR",
        type=Path,
        help="folder of the results (default: SUITE-results)",
    )
    option(
        "--planners",
        metavar="NAME",
        nargs="+",
        help="planners to compare (default: cnpgen cnpgen+refine solve)",
    )
    option(
        "--n",
        metavar="N",
        type=values.positive,
        help="number of problems; a random suite has any number",
    )
    _add_execution(parser)
    _add_planning(parser)
    _add_comparison(parser)
    add_json(parser)


def _add_execution(parser: Parser) -> None:
    """Add the options of the simulated execution."""
    option = parser.add_argument
    option("--simulate", action="store_true", help="also execute the plans")
    option(
        "--plant",
        metavar="NAME",
        nargs="+",
        help="simulated robots that execute them (default: nominal)",
    )
    option(
        "--environment",
        metavar="PATH",
        type=Path,
        help="also execute them in this clone of the Air Hockey Challenge",
    )
    option(
        "--video",
        action="store_true",
        help="film the first plan of every planner for the report",
    )


def _add_planning(parser: Parser) -> None:
    """Add the options of the runs of planners."""
    option = parser.add_argument
    option(
        "--time-limit",
        metavar="S",
        type=values.seconds,
        default=60.0,
        help="time limit per problem (default: 60s)",
    )
    add_engine(
        parser,
        "processes for execution, and with --engine for planning; default one per available core",
    )
    option(
        "--seed",
        metavar="SEED",
        type=values.seed,
        default=0,
        help="seed of random planners (default: 0)",
    )
    option(
        "--repeat",
        metavar="K",
        type=values.positive,
        default=1,
        help="repetitions of every problem (default: 1)",
    )


def _add_comparison(parser: Parser) -> None:
    """Add the options of the comparison, of the planners' fields and of earlier results."""
    option = parser.add_argument
    option(
        "--plane-tolerance",
        metavar="M",
        type=values.meters,
        default=0.02,
        help="largest distance of the mallet of a successful hit from the table plane (default: 20mm)",
    )
    option(
        "--reference",
        metavar="NAME",
        help="planner that p-values compare with (default: cnpgen+refine)",
    )
    option(
        "--set",
        metavar="NAME.KEY=VALUE",
        nargs="+",
        default=[],
        type=parameter,
        help="field of a planner, such as trajopt.iterations=50 or rrtconnect.simplify_time=0.5s",
    )
    option(
        "--replan",
        action="store_true",
        help="discard earlier answers of these planners in DIR",
    )
    option(
        "--force",
        action="store_true",
        help="delete results of another suite, version, time limit, seed or planner parameters"
        " in DIR, and replace files that are no results",
    )


def parameter(text: str) -> tuple[str, str, Any]:
    """Read a field of a planner: its name, the key and the value, as in a recipe or as plain text."""
    left, equals, value = text.partition("=")
    name, dot, key = left.rpartition(".")
    if not (equals and dot and name and key):
        raise argparse.ArgumentTypeError(
            f"expected NAME.KEY=VALUE, such as trajopt.iterations=50, got {text!r}"
        )
    return name, key, values.toml_value(value)


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.addons.benchmark.benchmark_report import (
        save_benchmark_figures,
        save_benchmark_report,
    )
    from cnpgen.addons.benchmark.result_tables import save_benchmark_tables

    if arguments.list:
        refuse_others(arguments, "list")
        print(_listing(as_json=arguments.json))
        return
    if arguments.suite is None:
        raise UsageError(
            "the argument SUITE is missing; 'cnpgen benchmark --list' lists suites"
        )
    if not arguments.simulate:
        names = ("plant", "environment", "video")
        refuse(arguments, names, "{} needs --simulate")
    folder = arguments.out or Path(f"{Path(arguments.suite).stem}-results")
    if not arguments.force:
        _refuse_others(folder)
    found = _run(arguments, folder)
    save_benchmark_tables(found, folder)
    save_benchmark_figures(found, folder)
    report = save_benchmark_report(found, folder / REPORT, video=arguments.video)
    print(
        json.dumps(_facts(found, folder), indent=2) if arguments.json else _text(found)
    )
    print(f"report: {report}", file=sys.stderr)


def _refuse_others(folder: Path) -> None:
    """Raise UsageError if the reports would replace files in a folder without results."""
    from cnpgen.addons.benchmark.result_tables import TABLE_FILES
    from cnpgen.addons.benchmark.run_record import RUNS_FILE

    if (folder / RUNS_FILE).exists():
        return
    patterns = *TABLE_FILES, REPORT, "success-*.pdf", "distributions-*.pdf"
    others = [path.name for pattern in patterns for path in folder.glob(pattern)]
    if others:
        raise UsageError(
            f"{folder} has no results of a benchmark, but {', '.join(others)}, which"
            " would be replaced: choose another folder, or pass {force}",
            remedies={"force": True},
        )


def _run(arguments: argparse.Namespace, folder: Path) -> "Benchmark":
    from cnpgen.addons.benchmark.benchmark_options import BenchmarkOptions
    from cnpgen.addons.benchmark.run_suite import FASTEST, run_benchmark

    meter = Meter(noun="problem")
    doing = [""]
    planners = {name for name, _, _ in arguments.set}
    parameters = {
        each: {key: value for name, key, value in arguments.set if name == each}
        for each in planners
    }

    def progress(what: str, total: int, done: int) -> None:
        if what != doing[0]:
            doing[0] = what
            meter.begin(what, total, done - 1)
        meter(1)

    plants = (arguments.plant or ("nominal",)) if arguments.simulate else ()
    others = {entry.name for entry in fields(BenchmarkOptions)}
    given = options_of(arguments, *others.union(ENGINE, ("n", "force")))
    options = {name: given.pop(name) for name in others & given.keys()}
    with meter, resumable(folder):
        return run_benchmark(
            arguments.suite,
            folder,
            planners=arguments.planners or FASTEST,
            plants=plants,
            parameters=parameters,
            progress=progress,
            options=BenchmarkOptions(**options),
            **given,
        )


def _facts(found: "Benchmark", folder: Path) -> JsonObject:
    """Return the results of all planners for JSON."""
    from cnpgen.addons.benchmark.hypothesis_tests import reference_planner
    from cnpgen.addons.benchmark.results_file import RESULTS

    return {
        "format": RESULTS.kind,
        "format_version": RESULTS.version,
        "suite": found.suite.name,
        "suite_version": found.suite.version,
        "problems": len(found.problems),
        "folder": str(folder),
        "runs": [asdict(run) for run in found.runs],
        "reference": reference_planner(found.results, found.reference),
        "plane_tolerance_m": found.plane_tolerance,
        "planners": {
            plant or "planned": found.summary(plant) for plant in found.executions
        },
    }


def _text(found: "Benchmark") -> str:
    """Format one table per plant with a column per planner."""
    from cnpgen.addons.benchmark.result_tables import (
        failure_summaries,
        notes,
        table_rows,
    )

    head = f"{found.suite.name} {found.suite.version}: {counted(len(found.problems), 'problem')}"
    tables = [
        table([(*row, "") for row in table_rows(found, plant)], indent="  ")
        for plant in found.executions
    ]
    sections = [[head], *tables, [*failure_summaries(found), *notes(found)]]
    return "\n\n".join("\n".join(lines) for lines in sections)


def _listing(*, as_json: bool) -> str:
    """List suites, planners with their fields, and plants."""
    from cnpgen.addons.benchmark.simulator.plant import PLANTS
    from cnpgen.addons.benchmark.suite import load_suite
    from cnpgen.schema.catalogue import list_recipes

    planners, fields = _planners()
    found = {
        "suites": {name: load_suite(name).title for name in list_recipes("suite")},
        "planners": planners,
        "fields": fields,
        "plants": {plant.name: plant.title for plant in PLANTS.values()},
    }
    if as_json:
        return json.dumps(found, indent=2)
    return "\n\n".join(
        "\n".join([what, *table(list(names.items()), indent="  ")])
        for what, names in found.items()
    )


def _planners() -> tuple[dict[str, str], dict[str, str]]:
    """Describe the planners, or why they cannot be used, and their fields by the names for ``--set``."""
    from cnpgen.addons.benchmark.benchmark_planner import PLANNERS, load_kind
    from cnpgen.addons.manual.describe_keys import kind_summary
    from cnpgen.schema import registry
    from cnpgen.schema.keys import keys

    planners = dict[str, str]()
    fields = dict[str, str]()
    for name in registry.names(PLANNERS):
        try:
            kind = load_kind(name)
        except CnpgenError as error:
            planners[name] = f"cannot be used: {error}"
            continue
        planners[name] = kind_summary(kind)
        for key in keys(kind):
            unit = "" if key.unit == "1" else f" {key.unit}"
            fields[f"{name}.{key.name}"] = f"{key.doc} (default {key.default!r}{unit})"
    return planners, fields
