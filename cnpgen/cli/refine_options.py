"""What ``refine`` and ``solve`` have in common: options, progress, what they print."""

import argparse
import json
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cnpgen.cli import values
from cnpgen.cli.parser import Options, Parser, add_engine, add_json
from cnpgen.cli.progress import Meter
from cnpgen.errors import counted

if TYPE_CHECKING:
    from collections.abc import Callable

    from cnpgen.machine.times import Times
    from cnpgen.plans import Plans
    from cnpgen.refine.plans import Refinement

REFINING = ("objective", "weight", "max_iterations", "tolerance", "deadline")  # what add_refining adds
WORKERS = "processes; default one per available core, or one for up to 60 plans"
LISTED = 10  # plans without success that are listed

TEXT = """\
Every plan is handled for itself: --workers and the order of the plans change nothing but the time. Pinocchio and Coal
decide what is valid, as in 'cnpgen evaluate'. What is finished is written to OUT.part at once, by several workers in
fours: after Ctrl-C, kill -9 or a full disk the same command goes on. An existing OUT is replaced only with --force,
and only if it is a file of plans. The exit code is 0 if every plan is valid, and 1 if any is not; the file is written
in either case.
docs/refiner.md has the formulation.
"""


def add_options(parser: Parser) -> None:
    """Add the options of both commands."""
    add_refining(parser)
    parser.add_argument("--workers", metavar="W", type=values.positive, help=WORKERS)
    add_engine(parser)
    parser.add_argument(
        "--force", action="store_true", help="replace OUT, and throw away what another run has left in OUT.part"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress and no summary")
    add_json(parser)


def add_refining(parser: Options) -> None:
    """Add the options that say how plans are refined: ``REFINING``."""
    option = parser.add_argument
    option(
        "--objective",
        choices=("time", "effort", "jerk"),
        default="time",
        help="what is minimised: time and what the problem file adds to it (default), or effort or jerk beside time",
    )
    option("--weight", metavar="X", type=float, help="of what is beside the time; default the problem's, 1 for others")
    option("--max-iterations", metavar="I", type=values.natural, help="steps of the first pass (default: 40)")
    option(
        "--tolerance",
        metavar="X",
        type=float,
        help="relative change of the objective below which it has settled (default: 1e-3; from nothing a tenth of it,"
        " among obstacles a twentieth)",
    )
    option(
        "--deadline",
        metavar="S",
        type=values.seconds,
        help="how long each plan may take, 10ms for example: the best valid one until then, never worse than the given",
    )
    option("--explain", action="store_true", help="say of every plan that is not valid what is proven of its problem")


def refine_and_save(
    arguments: argparse.Namespace,
    plans: "Plans",
    out: Path,
    *,
    title: str,
    make: "Callable[..., Refinement] | None" = None,
) -> int:
    """Refine plans, save them, say what came of them; return the exit code.

    Args:
        arguments: What ``add_options`` added.
        plans: The plans.
        out: Where they go.
        title: What is going on.
        make: ``refine_plans`` by default, or ``solve_plans``.
    """
    from cnpgen.plans import save_plans
    from cnpgen.refine.options import RefineOptions
    from cnpgen.refine.plans import refine_plans

    given = {name: getattr(arguments, name) for name in REFINING}
    options = RefineOptions(**{name: value for name, value in given.items() if value is not None})
    check_place(out, force=arguments.force)
    journal = out.with_name(out.name + ".part")
    meter = Meter(quiet=arguments.quiet, noun="plan")
    finished = [0, 0]

    def progress(plans: int, valid: int) -> None:
        finished[0], finished[1] = finished[0] + plans, finished[1] + valid
        meter(plans)
        meter.note(f"{finished[1] / finished[0]:.1%} valid")

    try:
        found = (make or refine_plans)(
            plans,
            options=options,
            workers=arguments.workers,
            engine=arguments.engine,
            address=arguments.address,
            journal=journal,
            discard=arguments.force,
            begin=lambda total, there: meter.begin(title, total, there),
            progress=progress,
        )
        facts = found.summary()
        if arguments.explain:
            _explain(facts, found, meter)
    except KeyboardInterrupt as interruption:
        kept = f"{journal} keeps what is finished, run the same command again to go on"
        raise type(interruption)(kept) from interruption
    finally:
        meter.close()
    save_plans(out, found.plans)
    journal.unlink(missing_ok=True)
    _tell(arguments, facts, out, found.times)
    return 0 if found.valid.all() else 1


def check_place(out: Path, *, force: bool) -> None:
    """Refuse before any work what would fail, or destroy something, after it."""
    from cnpgen.errors import UsageError
    from cnpgen.plans.save import check_replaceable

    if out.is_dir() or not out.parent.is_dir():
        raise UsageError(f"{out} must be a file in a folder that exists")
    if out.exists() and not force:
        raise UsageError(f"{out} exists: --force replaces it, -o names another file")
    check_replaceable(out)


def _tell(arguments: argparse.Namespace, facts: dict[str, Any], out: Path, times: "Times") -> None:
    if not arguments.quiet:
        lines = _summary(facts, times, listed=facts["plans"] if arguments.explain else LISTED)
        print("\n".join(lines), file=sys.stderr)
    print(json.dumps({"file": str(out), **facts}, indent=2) if arguments.json else out)


def _explain(facts: dict[str, Any], found: "Refinement", meter: Meter) -> None:
    """Add to the facts about plans that are not valid what is proven about their problems."""
    from cnpgen.refine.proof.proof import explain_plans

    if facts["not_valid"]:
        meter.begin("explaining", len(facts["not_valid"]))
    for failure in facts["not_valid"]:
        (finding,) = explain_plans(found.plans, [failure["plan"]]).values()
        failure |= {"finding": str(finding.kind), "explanation": finding.text}
        meter(1)


def _summary(facts: dict[str, Any], times: "Times", *, listed: int) -> list[str]:
    """Say in a few lines what came of the plans."""
    from cnpgen.refine.plans import outcome_text

    mean = facts["mean_duration_s"]
    lines = [
        f"{facts['valid']:,} of {counted(facts['plans'], 'plan')} valid in {times}"
        + ("" if mean is None else f"; mean motion time {mean:.4f} s")
    ]
    lines += [f"  {count:,} {outcome_text(name)}" for name, count in facts["outcomes"].items()]
    for failure in facts["not_valid"][:listed]:
        lines += textwrap.wrap(_failure_text(failure), 110, subsequent_indent="  ")
    if len(facts["not_valid"]) > listed:
        lines.append(f"... and {len(facts['not_valid']) - listed} more: 'cnpgen evaluate' lists them with --list")
    return lines


def _failure_text(failure: dict[str, Any]) -> str:
    """Say of one plan why it is not valid, and of its problem what is proven, if that was asked for."""
    why = f"{failure['finding']}: {failure['explanation']}" if "finding" in failure else failure["outcome"]
    return f"plan {failure['plan']} (sample {failure['sample_id']}): {failure['reason']}; {why}"
