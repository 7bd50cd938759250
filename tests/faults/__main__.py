"""Fault injection: ``python -m tests.faults --kills 200 --inputs 100000 --calls 20000``.

``--goal`` runs all kinds of faults in their full numbers. The exit code is 1 if there
are findings.
"""

import argparse
import sys

from tests.faults.call_fuzz import fuzz_calls
from tests.faults.flips import flip_bits
from tests.faults.fuzz import fuzz
from tests.faults.kills import kill
from tests.faults.stop_orders import StopOutcome, run_orders, stop_at_hard_moments
from tests.faults.subjects import SUBJECTS

GOAL = {
    "inputs": 100_000,
    "kills": 500,
    "calls": 5_000,
    "flips": 2_000,
    "stops": 100_000,
    "moments": 180,
}


def main() -> int:
    """Run the requested faults."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument(
        "--inputs", metavar="N", type=int, default=0, help="changed files to read"
    )
    parser.add_argument(
        "--kills",
        metavar="N",
        type=int,
        default=0,
        help="processes to kill; their runs are resumed",
    )
    parser.add_argument(
        "--calls",
        metavar="N",
        type=int,
        default=0,
        help="calls of public functions, wrong arguments",
    )
    parser.add_argument(
        "--flips",
        metavar="N",
        type=int,
        default=0,
        help="flipped bits of files with checksums",
    )
    parser.add_argument(
        "--stops",
        metavar="N",
        type=int,
        default=0,
        help="random orders of stop, replan, switch, resume and close",
    )
    parser.add_argument(
        "--moments",
        metavar="N",
        type=int,
        default=0,
        help="stops at times at which they are hard",
    )
    parser.add_argument(
        "--goal", action="store_true", help=f"all of them: {GOAL}; takes hours"
    )
    parser.add_argument(
        "--seed", metavar="S", type=int, default=0, help="seed of all faults"
    )
    parser.add_argument(
        "--first",
        metavar="I",
        type=int,
        default=0,
        help="number of the first input or run",
    )
    parser.add_argument(
        "--kind",
        choices=tuple(SUBJECTS),
        action="append",
        help="only files of this kind",
    )
    arguments = parser.parse_args()
    if arguments.goal:
        vars(arguments).update(GOAL)
    runs = {name: run for name, run in RUNS.items() if vars(arguments)[name]}
    codes = {name: run(arguments) for name, run in runs.items()}
    return max(codes.values(), default=0)


def inputs(arguments: argparse.Namespace) -> int:
    """Read changed files; return the exit code."""
    outcome = fuzz(
        arguments.inputs,
        seed=arguments.seed,
        first=arguments.first,
        kinds=tuple(arguments.kind or SUBJECTS),
        progress=lambda done: (
            print(f"{done:,} inputs", flush=True) if done % 1000 == 0 else None
        ),
    )
    for kind in SUBJECTS:
        print(
            f"{kind:<10} {outcome.read[kind]:>8,} read {outcome.refused[kind]:>8,} refused"
        )
    return _report(outcome.findings)


def kills(arguments: argparse.Namespace) -> int:
    """Kill processes; return the exit code."""
    killed = kill(arguments.kills, seed=arguments.seed, first=arguments.first)
    for kind, count in sorted(killed.runs.items()):
        print(f"{count:>6,} {kind}")
    print(f"{killed.n_signals:>6,} signals sent")
    return _report(killed.findings)


def calls(arguments: argparse.Namespace) -> int:
    """Call public functions with wrong arguments; return the exit code."""
    outcome = fuzz_calls(
        arguments.calls,
        seed=arguments.seed,
        first=arguments.first,
        progress=lambda done: (
            print(f"{done:,} calls", flush=True) if done % 1000 == 0 else None
        ),
    )
    print(
        f"{len(outcome.functions)} functions: {outcome.returned:,} returned, {outcome.refused:,} refused"
    )
    return _report(outcome.findings)


def flips(arguments: argparse.Namespace) -> int:
    """Flip bits of files with checksums; return the exit code."""
    flipped = flip_bits(arguments.flips, seed=arguments.seed, first=arguments.first)
    for name, count in flipped.refused.items():
        print(f"{count:>6,} flips of {name} refused")
    return _report(flipped.findings)


def stops(arguments: argparse.Namespace) -> int:
    """Run random orders of requests; return the exit code."""
    outcome = run_orders(
        arguments.stops,
        seed=arguments.seed,
        first=arguments.first,
        progress=lambda done: (
            print(f"{done:,} orders", flush=True) if done % 100 == 0 else None
        ),
    )
    return _report_stops(outcome)


def moments(arguments: argparse.Namespace) -> int:
    """Stop at hard moments; return the exit code."""
    return _report_stops(stop_at_hard_moments(arguments.moments, seed=arguments.seed))


def _report_stops(outcome: StopOutcome) -> int:
    for kind, count in sorted(outcome.requests.items()):
        print(f"{count:>8,} {kind}")
    return _report(outcome.findings)


RUNS = {
    "inputs": inputs,
    "kills": kills,
    "calls": calls,
    "flips": flips,
    "stops": stops,
    "moments": moments,
}


def _report(findings: list[str]) -> int:
    print(f"{len(findings)} findings", *findings, sep="\n")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
