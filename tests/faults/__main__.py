"""Fault injection: ``python -m tests.faults --kills 200 --inputs 100000 --calls 20000``.

``--goal`` runs all kinds of faults in their full numbers. Seeds are drawn when a run
begins. With ``--progress FILE``, an interrupted run continues, and a change of the
package begins a new one. The exit code is 1 if there are findings.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.faults.call_fuzz import fuzz_calls
from tests.faults.chunk_orders import run_chunk_orders
from tests.faults.flips import flip_bits
from tests.faults.fuzz import fuzz
from tests.faults.kills import MAX_FINDINGS, kill
from tests.faults.progress import Part, Progress, load_progress, save_progress
from tests.faults.stop_orders import StopOutcome, run_orders, stop_at_hard_moments
from tests.faults.subjects import SUBJECTS


def inputs(count: int, seed: int, first: int, kinds: tuple[str, ...]) -> Part:
    """Read changed files."""
    outcome = fuzz(count, seed=seed, first=first, kinds=kinds)
    counts = Counter({f"{kind}, read": n for kind, n in outcome.read.items()})
    counts.update({f"{kind}, refused": n for kind, n in outcome.refused.items()})
    return Part(count, first + count, counts, outcome.findings)


def kills(count: int, seed: int, first: int, _kinds: tuple[str, ...]) -> Part:
    """Kill processes and resume their runs."""
    killed = kill(count, seed=seed, first=first)
    following = first + killed.n_runs
    return Part(killed.n_signals, following, killed.runs, killed.findings)


def calls(count: int, seed: int, first: int, _kinds: tuple[str, ...]) -> Part:
    """Call public functions with wrong arguments."""
    outcome = fuzz_calls(count, seed=seed, first=first)
    counts = Counter(returned=outcome.returned, refused=outcome.refused)
    return Part(count, first + count, counts, outcome.findings)


def flips(count: int, seed: int, first: int, _kinds: tuple[str, ...]) -> Part:
    """Flip bits of files with checksums."""
    flipped = flip_bits(count, seed=seed, first=first)
    return Part(count, first + count, Counter(flipped.refused), flipped.findings)


def stops(count: int, seed: int, first: int, _kinds: tuple[str, ...]) -> Part:
    """Run random orders of requests to a runtime, and as many to an executor of chunks."""
    plans = count - count // 2
    outcome = run_orders(plans, seed=seed, first=first)
    chunks = run_chunk_orders(count // 2, seed=seed, first=first)
    outcome.requests.update(chunks.requests)
    outcome.findings += chunks.findings
    return _of_stops(outcome, count, first)


def moments(count: int, seed: int, first: int, _kinds: tuple[str, ...]) -> Part:
    """Stop at hard moments."""
    return _of_stops(stop_at_hard_moments(count, seed=seed + first), count, first)


def _of_stops(outcome: StopOutcome, count: int, first: int) -> Part:
    return Part(count, first + count, outcome.requests, outcome.findings)


@dataclass(frozen=True)
class Fault:
    """A kind of faults.

    Attributes:
        text: Description of one fault.
        goal: Number of faults without a finding that is the goal.
        block: Number of faults between two notes of the progress.
        run: Runs faults: a number, the seed, the index of the first one, and kinds of
            files.
    """

    text: str
    goal: int
    block: int
    run: Callable[[int, int, int, tuple[str, ...]], Part]


FAULTS = {
    "inputs": Fault("changed files to read", 100_000, 2_000, inputs),
    "kills": Fault("processes to kill; their runs are resumed", 500, 100, kills),
    "calls": Fault("calls of public functions, wrong arguments", 5_000, 1_000, calls),
    "flips": Fault("flipped bits of files with checksums", 2_000, 500, flips),
    "stops": Fault("random orders of requests to a runtime", 100_000, 1_000, stops),
    "moments": Fault("stops at times at which they are hard", 180, 60, moments),
}


def main() -> int:
    """Run the requested faults."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    option = parser.add_argument
    for name, fault in FAULTS.items():
        option(f"--{name}", metavar="N", type=int, default=0, help=fault.text)
    goal = {name: fault.goal for name, fault in FAULTS.items()}
    option("--goal", action="store_true", help=f"all of them: {goal}; takes hours")
    option("--seed", metavar="S", type=int, help="seed of all faults; drawn by default")
    option("--first", metavar="I", type=int, default=0, help="first input or run")
    option("--progress", metavar="FILE", type=Path, help="file to continue a run")
    option("--kind", choices=tuple(SUBJECTS), action="append", help="kind of files")
    arguments = parser.parse_args()
    if arguments.goal:
        vars(arguments).update(goal)
    progress = load_progress(arguments.progress, arguments.seed)
    print(f"seed {progress.seed}", flush=True)
    kinds = tuple(arguments.kind or SUBJECTS)
    for name in FAULTS:
        if count := getattr(arguments, name):
            part = progress.parts.setdefault(name, Part(next=arguments.first))
            _run(name, count, progress, kinds, arguments.progress)
            _report(name, part)
    return int(any(part.findings for part in progress.parts.values()))


def _run(
    name: str,
    count: int,
    progress: Progress,
    kinds: tuple[str, ...],
    path: Path | None,
) -> None:
    """Run faults of one kind in blocks until there are as many as requested."""
    fault, part = FAULTS[name], progress.parts[name]
    while part.done < count and len(part.findings) < MAX_FINDINGS:
        block = min(fault.block, count - part.done)
        part.add(fault.run(block, progress.seed, part.next, kinds))
        save_progress(progress, path)
        print(f"{name}: {part.done:,}, {len(part.findings)} findings", flush=True)


def _report(name: str, part: Part) -> None:
    for kind, count in sorted(part.counts.items()):
        print(f"{count:>9,} {kind}")
    print(
        f"{name}: {part.done:,}, {len(part.findings)} findings",
        *part.findings,
        sep="\n",
    )


if __name__ == "__main__":
    sys.exit(main())
