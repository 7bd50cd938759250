"""Every dataset with a planner: rows per second, solved plans, plans of the planner, and refined plans.

Problems are new, from a seed that was not used for training. The clock is the process's CPU time with one BLAS
thread; times of plans include the verdict. "T / refined" is the ratio of the mean motion times before and after
refining. airhockey-replan also replans valid plans after fractions of their motion time T, to the same goal and to that
of another problem. "T / remaining" is the ratio of the mean motion time of the new plans and of the remaining
trajectories.

    python benchmarks/planners.py
    python benchmarks/planners.py --full      # numbers of problems of the targets
    python benchmarks/planners.py --models panda-cup ur5-wipe --curves 0
"""

import argparse
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from common import (
    arguments,
    installed_recipes,
    median,
    progress,
    report,
    table,
    verdict,
)
from generator import measure_rates, prepare
from refiner_problems import PUCKS, make_each

from cnpgen.machine.threads import one_thread
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model_file import shipped_models
from cnpgen.planner.planner import Planner
from cnpgen.plans import Plans
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.refine.options import DEFAULT_OPTIONS
from cnpgen.refine.refine_plans import refine_plans

PLANNED, REFINED = 1000, {"airhockey-hit": 1000, "airhockey-replan": 1000}
SOLVED, REFINED_OF_OTHERS = (
    200,
    300,
)  # solved plans; refined plans of the other planners
BLOCKS, REPETITIONS = {"compiled": 4}, 3  # blocks of rows per repetition
GRID_PLANNER = "airhockey-hit"
SMALL = {"planned": 500, "refined": 40, "solved": 40}
REPLANNER, SWITCH_TIMES = (
    "airhockey-replan",
    (0.0, 0.1, 0.2, 0.4, 0.6, 0.8),
)  # fractions of T
ITERATIONS, LIMITED = (
    (1, 2, 3, 4, 6, 10),
    100,
)  # limits of the refiner's iterations; plans


@dataclass(frozen=True)
class Target:
    """Target of a figure.

    Attributes:
        value: The bound.
        at_most: Whether it is an upper bound.
    """

    value: float
    at_most: bool = False


ARM = {
    "rows/s/core": Target(20_000), "strict": Target(0.9), "refined valid": Target(0.995),
    "solved valid": Target(0.99), "solved, median ms": Target(150, at_most=True),
}  # fmt: skip
TARGETS = {
    "panda-cup": ARM,
    "ur5-wipe": ARM,
    "airhockey-hit": {
        "solved valid": Target(0.995),
        "strict": Target(0.95), "loose": Target(0.999), "z error [mm s]": Target(0.2, at_most=True),
        "T / refined": Target(1.02, at_most=True), "refined valid": Target(0.995),
        "refine, median ms": Target(10, at_most=True), "grid, refined valid of 81": Target(81),
    },
    "airhockey-replan": {
        "rows/s/core": Target(120_000), "solved valid": Target(0.995),
        "strict": Target(0.85), "loose": Target(0.97), "refined valid": Target(0.995),
        "refine, median ms": Target(12, at_most=True),
    },
    "heavy-object": {
        "rows/s/core": Target(45_000), "solved valid": Target(0.97),
        "strict": Target(0.95), "loose": Target(0.985), "vertical error [rad s]": Target(0.012, at_most=True),
        "T / refined": Target(1.04, at_most=True), "refined valid": Target(0.98),
        "refine, median ms": Target(45, at_most=True),
    },
}  # fmt: skip


def judge(plans: Plans) -> dict[str, float]:
    """Return verdicts and metrics of plans of the network."""
    summary = evaluate_plans(plans).summary()
    metrics = summary["metrics_of_all"]
    keys = {
        "z error [mm s]": "z_error_mm_s",
        "vertical error [rad s]": "vertical_error_rad_s",
    }
    figures = {"strict": summary["valid_ratio"], "loose": summary["paper_valid_ratio"]}
    figures["motion time [s]"] = metrics["duration_s"]["mean"]
    return figures | {
        name: metrics[key]["mean"] for name, key in keys.items() if key in metrics
    }


def draw_rate(name: str) -> float:
    """Measure the accepted rows per second of CPU time."""
    case = prepare(name, "compiled")
    measure_rates([case], REPETITIONS, BLOCKS)
    return case.rate


def solve(problems: Plans) -> dict[str, float]:
    """Solve problems one by one without initial guess."""
    with one_thread():
        solved = make_each(problems, DEFAULT_OPTIONS)
    return {
        "solved valid": float(np.mean([plan.valid for plan in solved])),
        "solved, median ms": median(plan.ms for plan in solved),
        "solved, mean ms": float(np.mean([plan.ms for plan in solved])),
    }


def refine(plans: Plans) -> dict[str, float]:
    """Refine plans one by one; compare motion times of valid results."""
    with one_thread():
        refined = make_each(plans, DEFAULT_OPTIONS)
    valid = np.array([plan.valid for plan in refined])
    after, ms = (
        np.array([plan.duration for plan in refined]),
        [plan.ms for plan in refined],
    )
    return {
        "T / refined": float(plans.duration[valid].mean() / after[valid].mean()),
        "refined valid": float(valid.mean()),
        "refine, median ms": median(ms),
        "refine, mean ms": float(np.mean(ms)),
        "refine, p95 ms": float(np.quantile(ms, 0.95)),
        "of it verdicts, median ms": median(plan.verdict_ms for plan in refined),
    }


def measure_grid(name: str) -> dict[str, float]:
    """Measure the hits of 81 pucks on a grid from rest."""
    progress(f"{name}: 81 pucks on a grid")
    plans = Planner(name).plan_batch(
        draw_boundary_problems("airhockey-pucks", PUCKS).boundary
    )
    refined = make_each(plans, DEFAULT_OPTIONS)
    strict = int(evaluate_plans(plans).valid.sum())
    return {
        "grid, strict of 81": strict,
        "grid, refined valid of 81": sum(plan.valid for plan in refined),
    }


def replan(name: str, seed: int, planned: int, refined: int) -> list[dict[str, Any]]:
    """Replan from states of valid plans by the network, to the same goal and to another one."""
    planner = Planner(name)
    plans = planner.plan_batch(
        draw_boundary_problems(name, planned, seed=seed).boundary
    )
    plans, records = plans[evaluate_plans(plans).valid], []
    other = np.roll(np.arange(len(plans)), 1)
    for goal, ends in (("same", plans.boundary), ("another", plans.boundary[other])):
        for fraction in SWITCH_TIMES:
            progress(
                f"{name}: {len(plans)} plans replanned at {fraction:g} T to {goal} goal"
            )
            q, dq, ddq = plans.states_at(fraction * plans.duration)
            new = planner.plan(
                q, ends.goal_q, start_dq=dq, start_ddq=ddq, goal_dq=ends.goal_dq
            )
            facts = {
                "goal": goal,
                "at": fraction,
                "plans": len(new),
                "valid": float(evaluate_plans(new).valid.mean()),
            }
            facts["refined valid"] = float(refine_plans(new[:refined]).valid.mean())
            facts["T / remaining"] = float(
                new.duration.mean() / ((1 - fraction) * plans.duration.mean())
            )
            records.append(facts)
    return records


def curve(name: str, seed: int, count: int) -> dict[int, float]:
    """Refine with few iterations; return the mean ratios of motion times to the default, of valid pairs."""
    plans = Planner(name).plan_batch(
        draw_boundary_problems(name, count, seed=seed).boundary
    )
    ratios = {}
    with one_thread():
        full = make_each(plans, DEFAULT_OPTIONS)
        for steps in ITERATIONS:
            progress(f"{name}: {count} plans, at most {steps} iterations")
            limited = make_each(plans, replace(DEFAULT_OPTIONS, max_iterations=steps))
            both = [
                (a.duration, b.duration)
                for a, b in zip(limited, full, strict=True)
                if a.valid and b.valid
            ]
            few_iterations, default = np.array(both).T
            ratios[steps] = float(np.mean(few_iterations / default))
    return ratios


def replan_table(records: list[dict[str, Any]]) -> str:
    """Format the results of ``replan``."""
    rows = [
        (record["goal"], f"{record['at']:g} T", f"{record['valid']:.1%}", f"{record['refined valid']:.1%}",
         f"{record['T / remaining']:.2f}" if record["goal"] == "same" else "")
        for record in records
    ]  # fmt: skip
    head = ("goal", "at", "valid", "refined valid", "T / remaining")
    return table(
        f"replanned from states of {records[0]['plans']} valid plans",
        head,
        rows,
        left=2,
    )


def measure(name: str, seed: int, sizes: dict[str, int]) -> dict[str, float]:
    planned, refined, solved = (sizes[key] for key in ("planned", "refined", "solved"))
    progress(f"{name}: {planned} plans, {refined} of them refined, {solved} solved")
    planner, problems = (
        Planner(name),
        draw_boundary_problems(name, max(sizes.values()), seed=seed),
    )
    planner.plan_batch(problems.boundary[:10])  # warm-up
    start = time.process_time()
    plans = planner.plan_batch(problems.boundary)
    planning = {
        "plan, ms per plan of a batch": 1e3 * (time.process_time() - start) / len(plans)
    }
    rate = {"rows/s/core": draw_rate(name)}
    return (
        rate
        | planning
        | judge(plans[:planned])
        | refine(plans[:refined])
        | solve(problems[:solved])
    )


def rows_of(name: str, figures: dict[str, float]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for figure, value in figures.items():
        target = TARGETS.get(name, {}).get(figure)
        cells = verdict(
            value,
            target.value if target else None,
            at_most=bool(target and target.at_most),
        )
        ratio = f"{value / target.value:.3f}" if target else ""
        rows.append((name, figure, f"{value:,.4g}", *cells, ratio))
    return rows


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--models",
        nargs="+",
        help="by default all shipped models whose robots are installed",
    )
    parser.add_argument(
        "--full", action="store_true", help="the numbers of plans of the targets"
    )
    parser.add_argument(
        "--curves",
        type=int,
        help="plans refined with few iterations; 0 omits replanning, too",
    )
    parser.add_argument(
        "--seed", type=int, default=987_654_321, help="seed of the problems"
    )


def main() -> None:
    chosen = arguments(__doc__, options)
    figures: dict[str, Any] = {}
    models = chosen.models or installed_recipes(shipped_models())
    limited = (
        (LIMITED if chosen.full else SMALL["refined"])
        if chosen.curves is None
        else chosen.curves
    )
    for name in models:
        full = {
            "planned": PLANNED,
            "refined": REFINED.get(name, REFINED_OF_OTHERS),
            "solved": SOLVED,
        }
        figures[name] = measure(name, chosen.seed, full if chosen.full else SMALL)
        figures[name] |= measure_grid(name) if name == GRID_PLANNER else {}
    rows = [row for name, values in figures.items() for row in rows_of(name, values)]
    head = ("planner", "figure", "value", "target", "", "ratio")
    tables = [table("datasets and their planners, new problems", head, rows, left=2)]
    curves = {name: curve(name, chosen.seed, limited) for name in models if limited}
    lines = [
        (name, *(f"{value:.4f}" for value in values.values()))
        for name, values in curves.items()
    ]
    steps = [f"{step} iteration{'s' if step > 1 else ''}" for step in ITERATIONS]
    if curves:
        tables.append(
            table(
                "motion time after few iterations over that of the default",
                ("planner", *steps),
                lines,
            )
        )
    replanned = []
    if REPLANNER in models and limited:
        replanned = replan(REPLANNER, chosen.seed, SMALL["planned"], SMALL["refined"])
        tables.append(replan_table(replanned))
    report(
        {"planners": figures, "curves": curves, "replanned": replanned},
        tables,
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
