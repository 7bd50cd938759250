"""The cost in time of motions that end without acceleration: the same problems with free and with zero goal accelerations.

python benchmarks/goal_acceleration.py
python benchmarks/goal_acceleration.py --datasets panda-scenes --n 200
"""

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from common import arguments, progress, report, table

from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.refine_plans import solve_plans

DATASETS = ("airhockey-hit", "heavy-object", "panda-cup")
SEED = 27_182  # used nowhere else


def with_goal_acceleration(problems: Plans, values: np.ndarray | None) -> Plans:
    """Return problems with other goal accelerations; None leaves them free."""
    return replace(problems, boundary=replace(problems.boundary, goal_ddq=values))


def measured(dataset: str, count: int) -> dict[str, Any]:
    """Solve problems of a dataset with free and with zero goal accelerations, and compare durations."""
    problems = draw_boundary_problems(dataset, count, seed=SEED)
    still = np.zeros_like(problems.boundary.goal_q)
    solved = {}
    for name, values in (("free", None), ("zero", still)):
        progress(f"{dataset}, {name} goal accelerations")
        solved[name] = solve_plans(with_goal_acceleration(problems, values), workers=1)
    free, zero = solved["free"], solved["zero"]
    both = free.valid & zero.valid
    added = zero.plans.duration[both] - free.plans.duration[both]
    limit = open_problem(problems.problem)[1].acceleration_limit
    ends = free.plans[both].motion.at(np.ones((int(both.sum()), 1))).ddq[:, 0]
    return {
        "problems": count,
        "valid, free": int(free.valid.sum()),
        "valid, zero": int(zero.valid.sum()),
        "mean duration, free [s]": float(free.plans.duration[both].mean()),
        "mean added time [s]": float(added.mean()),
        "mean added time [%]": float(100 * (added / free.plans.duration[both]).mean()),
        "median end, free [share of the limit]": float(
            np.median(np.abs(ends / limit).max(axis=1))
        ),
    }


def main() -> None:
    """Measure all datasets."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--datasets", nargs="+", default=DATASETS)
        parser.add_argument("--n", type=int, default=200, help="problems of each")

    options = arguments(__doc__, add)
    results = {name: measured(name, options.n) for name in options.datasets}
    head = [*next(iter(results.values()))]
    rows = [
        (name, *(f"{value:.3g}" for value in result.values()))
        for name, result in results.items()
    ]
    tables = [table("Zero goal accelerations", ["dataset", *head], rows)]
    report({"goal_acceleration": results}, tables, as_json=options.json)


if __name__ == "__main__":
    main()
