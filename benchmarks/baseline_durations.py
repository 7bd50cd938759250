"""Durations of ``solve`` and of RRT-Connect with TOPP-RA in the suite clutter, also once both meet the same limits.

A trajectory of TOPP-RA stands for the cubics through its samples, which exceed limits of acceleration where
accelerations jump. Scaled in time by the least factor, they meet the limits of velocity, acceleration and torque
between the samples, too. Their jumps at both ends are not counted.

    python benchmarks/baseline_durations.py --problems 0 200
"""

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from common import arguments, progress, report, table

from cnpgen.addons.benchmark.answers import judge_answer
from cnpgen.addons.benchmark.benchmark_planner import Setting
from cnpgen.addons.benchmark.planners.rrtconnect import RRTConnect
from cnpgen.addons.benchmark.suite import load_suite
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import as_problem, record_problem
from cnpgen.refine.refine_plans import solve_plans
from cnpgen.store.scene_table import OBSTACLE_POSES

MAX_FACTOR, FACTOR_STEPS = 2.0, 12  # of time; bisections
TIME_LIMIT_S = 600.0


def scaled_in_time(trajectory: Trajectory, factor: float) -> Trajectory:
    assert trajectory.dq is not None
    return Trajectory(trajectory.t * factor, trajectory.q, trajectory.dq / factor)


def with_limits_only(problems: Plans) -> Plans:
    """Return boundary problems without obstacles and without constraints other than limits of the joints."""
    problem = as_problem(problems.problem)
    limits = tuple(
        constraint
        for constraint in problem.constraint
        if constraint.reason.startswith("joint")
    )
    record = record_problem(replace(problem, constraint=limits, obstacle=()))
    columns = {
        name: values
        for name, values in problems.columns.items()
        if name != OBSTACLE_POSES
    }
    return replace(problems, problem=record, columns=columns)


def meets_limits(problem: Plans, trajectory: Trajectory) -> bool:
    """Return whether a trajectory meets the limits of the joints."""
    margins = judge_answer(problem, trajectory).margins.values()
    return all(
        margin.violation <= margin.tolerance
        for margin in margins
        if margin.name.startswith("joint")
    )


def least_factor(problem: Plans, trajectory: Trajectory) -> float:
    """Return the least factor of time at which a trajectory meets the limits; nan above ``MAX_FACTOR``."""
    low, high = 1.0, MAX_FACTOR
    if meets_limits(problem, trajectory):
        return low
    if not meets_limits(problem, scaled_in_time(trajectory, high)):
        return float("nan")
    for _ in range(FACTOR_STEPS):
        factor = (low + high) / 2
        low, high = (
            (low, factor)
            if meets_limits(problem, scaled_in_time(trajectory, factor))
            else (factor, high)
        )
    return high


def measure(
    numbers: tuple[int, int], seed: int, simplify_time: float
) -> list[dict[str, Any]]:
    """Return the durations of both planners in some problems [s]."""
    suite, (first, last) = load_suite("clutter"), numbers
    problems, _ = suite.problems(last)
    setting, limits = (
        Setting(problems.problem, suite.model, TIME_LIMIT_S, seed),
        with_limits_only(problems),
    )
    plan, rows = RRTConnect(simplify_time=simplify_time).prepare(setting), []
    for index in range(first, last):
        problem = problems[index : index + 1]
        baseline, own = plan(problem), solve_plans(problem, workers=1)
        if isinstance(baseline, Trajectory) and own.valid[0]:
            factor = least_factor(limits[index : index + 1], baseline)
            rows.append(
                {
                    "problem": index,
                    "solve": own.plans.duration[0],
                    "baseline": baseline.duration,
                    "k": factor,
                }
            )
            progress(
                f"problem {index}: {rows[-1]['solve'] / baseline.duration:.4f}, scaled by {factor:.4f}"
            )
    return rows


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--problems",
        type=int,
        nargs=2,
        default=(0, 200),
        help="first one and the one after the last",
    )
    parser.add_argument("--seed", type=int, default=3, help="seed of the baseline")
    parser.add_argument(
        "--simplify",
        type=float,
        default=8.0,
        help="largest time of its simplification [s]",
    )


def main() -> None:
    options = arguments(__doc__, add_options)
    rows = measure(options.problems, options.seed, options.simplify)
    planned = np.array([row["solve"] / row["baseline"] for row in rows])
    factors = np.array([row["k"] for row in rows])
    lines = [
        (
            name,
            f"{len(ratios)}",
            f"{np.median(ratios):.3f}",
            f"{(ratios < 1).sum()}",
            f"{ratios.max():.4f}",
        )
        for name, ratios in (
            ("as planned", planned),
            ("scaled to the limits", planned / factors),
        )
    ]
    head = ("baseline", "problems", "median ratio", "solve is shorter", "largest ratio")
    title = f"Duration of solve relative to the baseline, scaled by {np.median(factors):.3f} in the median"
    report({"problems": rows}, [table(title, head, lines)], as_json=options.json)


if __name__ == "__main__":
    main()
