"""Fault injection: ``python -m tests.faults --kills 200 --inputs 100000 --calls 20000``.

The exit code is 1 if there are findings.
"""

import argparse
import sys

from tests.faults.call_fuzz import fuzz_calls
from tests.faults.fuzz import fuzz
from tests.faults.kills import kill
from tests.faults.subjects import SUBJECTS


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
    runs = {inputs: arguments.inputs, kills: arguments.kills, calls: arguments.calls}
    return max((run(arguments) for run, count in runs.items() if count), default=0)


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


def _report(findings: list[str]) -> int:
    print(f"{len(findings)} findings", *findings, sep="\n")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
