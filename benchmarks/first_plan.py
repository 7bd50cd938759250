"""First valid plans: share found, CPU time and duration of ``solve --time-limit 0`` against ``solve``, in one run.

    python benchmarks/first_plan.py
    python benchmarks/first_plan.py --robots panda ur5 --count 60

The problems are those of benchmarks/scenes.py: every one has its own scene, and its set-up is part of the CPU time.
Both ways solve each problem in turn, in one process and thread, so that the load of the machine affects both.
"""

import argparse
from itertools import product

import numpy as np
from common import arguments, progress, report, table
from scenes import FAMILIES, ROBOTS, EndSampler, Solved, generate, loaded, solve_scene

from cnpgen.refine.options import DEFAULT_OPTIONS, RefineOptions

WAYS = {"solve": DEFAULT_OPTIONS, "first plan": RefineOptions(time_limit=0)}


def solve_both(name: str, family: str, count: int, seed: int) -> dict[str, list[Solved]]:  # fmt: skip
    """Solve problems of a family both ways; the first one, which may compile kernels, is not counted."""
    problem, robot, checker = loaded(name)
    sampler = EndSampler(problem, robot, checker)
    solved: dict[str, list[Solved]] = {way: [] for way in WAYS}
    for number, scene in enumerate(generate(problem, sampler, family, count, seed)):
        for way, refine_options in WAYS.items():
            result = solve_scene(*scene, refine_options)
            if number:
                solved[way].append(result)
    return solved


def figures(solved: dict[str, list[Solved]]) -> dict[str, float]:
    """Compare both ways; ratios are those of single problems."""
    usual, first = ([each.attempt for each in solved[way]] for way in WAYS)
    found = [(a, b) for a, b in zip(usual, first, strict=True) if a.valid and b.valid]
    cpu = {way: np.array([each.cpu for each in results]) for way, results in solved.items()}  # fmt: skip
    duration = {
        "solve": np.array([a.cost for a, _ in found]),
        "first plan": np.array([b.cost for _, b in found]),
    }
    return {
        "problems": len(usual),
        "solved": sum(attempt.valid for attempt in usual),
        "share found of these": len(found) / max(sum(a.valid for a in usual), 1),
        **{
            f"{quantile} {name} of {way}": float(np.percentile(values[way], level))
            for name, values in (("CPU time [s]", cpu), ("duration [s]", duration))
            for way in WAYS
            for quantile, level in (("median", 50), ("p95", 95))
        },
        "median ratio of CPU times": float(np.median(cpu["first plan"] / cpu["solve"])),
        "median ratio of durations": float(
            np.median(duration["first plan"] / duration["solve"])
        ),
    }


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option = parser.add_argument
    option("--robots", nargs="*", default=["panda", "ur5"], choices=list(ROBOTS))
    option("--families", nargs="*", default=list(FAMILIES), choices=list(FAMILIES))
    option("--count", type=int, default=21, help="problems of every family; the first is not counted")  # fmt: skip
    option("--seed", type=int, default=29_112_901, help="seed of the scenes")


def main() -> None:
    """Run the benchmark."""
    chosen = arguments(__doc__, options)
    results: dict[str, dict[str, list[Solved]]] = {}
    with np.errstate(all="ignore"):
        for name, family in product(chosen.robots, chosen.families):
            progress(f"{name}: {family}")
            both = solve_both(name, family, chosen.count, chosen.seed)
            results.setdefault(name, {way: [] for way in WAYS})
            for way, solved in both.items():
                results[name][way] += solved
    compared = {name: figures(solved) for name, solved in results.items()}
    rows = [
        (name, figure, f"{value:,.4g}")
        for name, values in compared.items()
        for figure, value in values.items()
    ]
    head = "robot", "figure", "value"
    report({"first plan": compared}, [table("first plans", head, rows, left=2)], as_json=chosen.json)  # fmt: skip


if __name__ == "__main__":
    main()
