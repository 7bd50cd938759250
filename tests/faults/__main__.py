"""Faults in large numbers: ``python -m tests.faults --kills 200 --seed 1``; the exit code is 1 if any is found."""

import argparse
import sys

from tests.faults.kills import kill


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument(
        "--kills", metavar="N", type=int, default=0, help="processes to kill; what they did is started again"
    )
    parser.add_argument("--seed", metavar="S", type=int, default=0, help="seed of everything")
    parser.add_argument("--first", metavar="I", type=int, default=0, help="number of the first one")
    arguments = parser.parse_args()
    killed = kill(arguments.kills, seed=arguments.seed, first=arguments.first)
    for what, count in sorted(killed.runs.items()):
        print(f"{count:>6,} {what}")
    print(f"{killed.struck:>6,} processes struck")
    print(f"{len(killed.findings)} findings", *killed.findings, sep="\n")
    return 1 if killed.findings else 0


if __name__ == "__main__":
    sys.exit(main())
