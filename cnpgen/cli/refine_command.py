"""Optimize the plans of a file.

The plans may come from any planner; 'cnpgen docs plan-format' shows how to write a plan
file, and how trajectories that are sampled in time become plans. The result is never
worse than the input: violations count first, then the objective. Plans with NaN control
points, or that take longer than a minute, are solved without an initial guess.
"""

import argparse
import json
import sys
import textwrap
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names, values
from cnpgen.cli.interruption import resumable
from cnpgen.cli.parser import (
    ENGINE,
    EXTRAPOLATE,
    Options,
    Parser,
    add_engine,
    add_json,
    options_of,
)
from cnpgen.cli.terminal import Meter
from cnpgen.cli.verdict_text import checksum_text
from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError, counted

if TYPE_CHECKING:
    from collections.abc import Callable

    from cnpgen.machine.times import Times
    from cnpgen.make.solve_scenes import SolvedScenes
    from cnpgen.plans import Plans
    from cnpgen.refine.options import RefineOptions
    from cnpgen.refine.refinement import Refinement

# What add_refining adds.
REFINING = (
    "objective",
    "weight",
    "max_iterations",
    "tolerance",
    "deadline",
    "stay_within",
)
LARGE_ANGLES = (
    "accept boundary conditions in a file that are probably in degrees or millimetres"
)
ALLOW_UNUSED = (
    "accept an element of scenes that is refused or unknown, such as is_diff,"
    " without effect; may be repeated"
)
WORKERS = "processes; default one per available core, or one for up to 60 plans"
LISTED = 10  # plans without success that are listed

TEXT = """\
Each plan is processed independently: --workers and the order of the plans change nothing but the time. Pinocchio and
Coal decide what is valid, as in 'cnpgen evaluate'. Workers append finished plans to OUT.part, four at a time: after
Ctrl-C, kill -9 or a full disk the same command goes on. An existing OUT is replaced only with --force,
and only if it is a file of plans. The exit code is 0 if every plan is valid, and 1 if any is not; the file is written
in either case. If OUT is there already as the result of the same request, the command says so and ends with 0.
'cnpgen docs refiner' has the formulation.
"""


def add_options(parser: Parser) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="plan file, .h5")
    parser.add_argument(
        "-o",
        "--out",
        metavar="OUT",
        type=Path,
        help="output file (default: FILE-refined.h5 beside it)",
    )
    parser.add_argument(
        "--problem",
        metavar="NAME|FILE",
        type=recipe_names.problem,
        help="the problem of the plans; its tolerances are used",
    )
    parser.add_argument("--extrapolate", action="store_true", help=EXTRAPOLATE)
    add_refine_options(parser)


def run(arguments: argparse.Namespace) -> int:
    plans = recipe_names.read_plans(
        arguments.file, problem=arguments.problem, extrapolate=arguments.extrapolate
    )
    out = arguments.out or arguments.file.with_name(f"{arguments.file.stem}-refined.h5")
    if not arguments.quiet:
        print(f"{arguments.file}: {checksum_text(plans)}", file=sys.stderr)
    return refine_and_save(arguments, plans, out, title=f"refining {arguments.file}")


def add_refine_options(parser: Parser) -> None:
    """Add the options of both commands, and complete the help."""
    parser.epilog = f"{parser.epilog or ''}{TEXT}"
    add_refining(parser)
    add_engine(parser, WORKERS)
    parser.add_argument(
        "--force",
        action="store_true",
        help="replace OUT, and discard another run's OUT.part",
    )
    add_json(parser)


def add_refining(parser: Options) -> None:
    """Add the options that say how plans are refined: ``REFINING``."""
    option = parser.add_argument
    text = "objective: that of the problem file (time, default), or the duration with terms such as effort=0.5 or"
    text += " effort=1,jerk=0.1 ('cnpgen list objectives')"
    option("--objective", metavar="TERMS", default="time", help=text)
    option(
        "--weight",
        metavar="X",
        type=float,
        help="weight of these terms (default: as in the problem or 1)",
    )
    option(
        "--max-iterations",
        metavar="I",
        type=values.natural,
        help="steps of the coarse level (default: 40)",
    )
    text = "relative change of the objective at which the iteration converges (default: 1e-3; without an initial"
    text += " guess a tenth of it, among obstacles a twentieth)"
    option("--tolerance", metavar="X", type=float, help=text)
    option(
        "--deadline",
        metavar="S",
        type=values.seconds_with_unit,
        help="time per plan, such as 10ms: returns the best plan until then, never worse than the input",
    )
    option(
        "--stay-within",
        metavar="E",
        type=values.angle,
        help="largest difference of every joint from the input path, such as 2deg (default: only the ends "
        "are kept)",
    )
    option(
        "--explain",
        action="store_true",
        help="report for every invalid plan whether its problem is proven infeasible",
    )


def refine_and_save(
    arguments: argparse.Namespace,
    plans: "Plans | None",
    out: Path,
    *,
    title: str,
    make: "Callable[..., Refinement | SolvedScenes] | None" = None,
    request: object = None,
) -> int:
    """Refine plans, save them, print a summary; return the exit code.

    ``make`` is ``refine_plans`` by default, ``solve_plans``, or a function that solves
    scenes and has no plans; then ``request`` is all that these depend on.
    """
    from cnpgen.cli.finished import is_finished, record_request
    from cnpgen.plans import save_plans
    from cnpgen.refine.refine_plans import refine_plans

    options = _refine_options(arguments)
    if plans is not None:
        request = _identity(plans, options)
    name = make.__name__ if make is not None and plans is not None else ""
    request = [request, name, options.document()]
    if is_finished(out, request, force=arguments.force):
        return report_finished(arguments, out)
    check_place(out)
    # The journal keeps finished plans until the output is complete.
    journal = out.with_name(out.name + ".part")
    # ``discard`` applies to the journal of another request.
    settings = {"options": options, **options_of(arguments, *ENGINE)}
    chosen: Callable[..., Refinement | SolvedScenes] = make or refine_plans
    run = partial(chosen, plans, journal=journal, discard=arguments.force, **settings)
    with resumable(journal), Meter(quiet=arguments.quiet, noun="plan") as meter:
        found = _run_with_meter(run, meter, title)
        facts = found.summary()
        if arguments.explain:
            _explain(facts, found, meter)
    save_plans(out, found.plans)
    record_request(out, request)
    # The journal is removed last: until then the same command can resume from it.
    journal.unlink(missing_ok=True)
    _print_result(arguments, out, facts, found.times)
    return 0 if found.valid.all() else 1


def _identity(plans: "Plans", options: "RefineOptions") -> list[object]:
    """Return what identifies a run and the columns of its result."""
    import joblib

    from cnpgen.refine.refine_plans import identity_of_run

    # Columns without effect on the refined motions are kept in the result.
    kept = joblib.hash([plans.columns, plans.sample_id])
    return [identity_of_run(plans, options), kept]


def _print_result(
    arguments: argparse.Namespace, out: Path, facts: JsonObject, times: "Times"
) -> None:
    """Print a summary on stderr, and the file or JSON on stdout."""
    if not arguments.quiet:
        listed = facts["plans"] if arguments.explain else LISTED
        print("\n".join(_summary(facts, times, listed=listed)), file=sys.stderr)
    print(json.dumps({"file": str(out), **facts}, indent=2) if arguments.json else out)


def _run_with_meter(
    run: "Callable[..., Refinement | SolvedScenes]", meter: Meter, title: str
) -> "Refinement | SolvedScenes":
    """Run with progress on a meter; return the result."""
    finished = [0, 0]

    def progress(plans: int, valid: int) -> None:
        finished[0] += plans
        finished[1] += valid
        meter(plans)
        meter.note(f"{finished[1] / finished[0]:.1%} valid")

    return run(
        begin=lambda total, there: meter.begin(title, total, there), progress=progress
    )


def _refine_options(arguments: argparse.Namespace) -> "RefineOptions":
    from cnpgen.refine.options import RefineOptions

    given = options_of(arguments, *REFINING)
    # Of ``solve`` only.
    given["time_limit"] = getattr(arguments, "time_limit", None)
    return RefineOptions(
        **{name: value for name, value in given.items() if value is not None}
    )


def report_finished(arguments: argparse.Namespace, out: Path) -> int:
    """Report that the result of the same request is there; return the exit code."""
    print(f"{out} is there already, of the same request", file=sys.stderr)
    facts = {"file": str(out), "already_there": True}
    print(json.dumps(facts, indent=2) if arguments.json else out)
    return 0


def check_free(out: Path, *, force: bool, unless_finished: bool = False) -> None:
    """Refuse an output path before any work if it exists or cannot be written.

    ``unless_finished`` accepts an existing one whose request is known and may be the
    same; ``is_finished`` decides later.
    """
    from cnpgen.cli.finished import request_file

    # A result of an earlier request is compared later, when this request is known.
    is_result = unless_finished and out.suffix == ".h5" and request_file(out).exists()
    if out.is_file() and not force and not is_result:
        raise UsageError(f"{out} exists: --force replaces it, -o names another file")
    check_place(out)


def check_place(out: Path) -> None:
    """Refuse an output path before any work if it cannot be written or has another file."""
    from cnpgen.plans.plan_file import check_replaceable
    from cnpgen.store.files.atomic import check_writable

    if out.suffix != ".h5" or out.is_dir() or not out.parent.is_dir():
        raise UsageError(
            f"{out} must be a file that ends in .h5, in a folder that exists"
        )
    check_replaceable(out)
    check_writable(out)


def _explain(
    facts: JsonObject, found: "Refinement | SolvedScenes", meter: Meter
) -> None:
    """Add proofs of infeasibility to the results of invalid plans, unless all have one."""
    from cnpgen.refine.proof.explain import explain_plans

    if all("finding" in failure for failure in facts["not_valid"]):
        return
    meter.begin("explaining", len(facts["not_valid"]))
    for failure in facts["not_valid"]:
        (finding,) = explain_plans(found.plans, [failure["plan"]]).values()
        failure |= {"finding": str(finding.kind), "explanation": finding.text}
        meter(1)


def _summary(facts: JsonObject, times: "Times", *, listed: int) -> list[str]:
    """Summarize the refined plans."""
    from cnpgen.refine.task import Outcome

    mean = facts["mean_duration_s"]
    mean_text = "" if mean is None else f"; mean motion time {mean:.4f} s"
    lines = [
        f"{facts['valid']:,} of {counted(facts['plans'], 'plan')} valid in {times}{mean_text}"
    ]
    lines += [
        f"  {count:,} {Outcome[name.upper()].text}"
        for name, count in facts["outcomes"].items()
    ]
    for failure in facts["not_valid"][:listed]:
        lines += textwrap.wrap(_failure_text(failure), 110, subsequent_indent="  ")
    if len(facts["not_valid"]) > listed:
        lines.append(
            f"... and {len(facts['not_valid']) - listed} more: 'cnpgen evaluate' lists them with --list"
        )
    if any("finding" not in failure for failure in facts["not_valid"]):
        lines.append(
            "--explain checks whether a problem is infeasible; 'cnpgen docs troubleshooting' lists causes"
        )
    return lines


def _failure_text(failure: JsonObject) -> str:
    """Describe why one plan is invalid, with the proof of its problem if requested."""
    why = (
        f"{failure['finding']}: {failure['explanation']}"
        if "finding" in failure
        else failure["outcome"]
    )
    if failure.get("finding") == "gave up":
        why = f"{why}; {failure['outcome']}"
    name = (
        f"scene {failure['scene']!r}"
        if "scene" in failure
        else f"sample {failure['sample_id']}"
    )
    return f"plan {failure['plan']} ({name}): {failure['reason']}; {why}"
