"""Faults in large numbers: ``python -m tests.faults --inputs 100000 --seed 1``; the exit code is 1 if any is found."""

import argparse
import sys

from tests.faults.fuzz import fuzz
from tests.faults.subjects import SUBJECTS


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--inputs", metavar="N", type=int, default=0, help="changed files to read")
    parser.add_argument("--seed", metavar="S", type=int, default=0, help="seed of everything")
    parser.add_argument("--first", metavar="I", type=int, default=0, help="number of the first input")
    parser.add_argument("--kind", choices=tuple(SUBJECTS), action="append", help="only files of this kind")
    arguments = parser.parse_args()
    outcome = fuzz(
        arguments.inputs,
        seed=arguments.seed,
        first=arguments.first,
        kinds=tuple(arguments.kind or SUBJECTS),
        progress=lambda done: print(f"{done:,} inputs", flush=True) if done % 1000 == 0 else None,
    )
    for kind in SUBJECTS:
        print(f"{kind:<10} {outcome.read[kind]:>8,} read {outcome.refused[kind]:>8,} refused")
    print(f"{len(outcome.findings)} findings", *outcome.findings, sep="\n")
    return 1 if outcome.findings else 0


if __name__ == "__main__":
    sys.exit(main())
