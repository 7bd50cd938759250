"""Every dataset with a planner: rows per second, plans from nothing, from the planner alone, and from it and refined.

Problems are fresh, from a seed that nothing was trained on. The clock is the process's CPU time, one BLAS thread; a
plan's share of the verdict is in its time. "T / refined" is the mean motion time before over that after refining.
The replanner is also asked for new plans on the way: from valid plans, after parts of their time T, to the goal that
they have and to that of another problem; "T / left" is the mean time of the new plans over what was left of the old.

    python benchmarks/planners.py
    python benchmarks/planners.py --full      # as many problems as the targets are about
    python benchmarks/planners.py --models panda-cup ur5-wipe --curves 0
"""

import argparse
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from common import arguments, at_hand, median, progress, report, table, verdict
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
SOLVED, OTHERS = 200, 300  # plans from nothing; refined ones of the other planners
BLOCKS, REPEATED = {"compiled": 4}, 3  # of rows, each time; times
GRID = "airhockey-hit"
SHORT = {"planned": 500, "refined": 40, "solved": 40}
REPLANNER, WHEN = "airhockey-replan", (0.0, 0.1, 0.2, 0.4, 0.6, 0.8)  # parts of T
STEPS, CURVED = (1, 2, 3, 4, 6, 10), 100  # steps of the refiner's first pass; plans


@dataclass(frozen=True)
class Target:
    """Goal of a figure.

    Attributes:
        value: The bound.
        at_most: Whether it is an upper one.
    """

    value: float
    at_most: bool = False


ARM = {
    "rows/s/core": Target(20_000), "strict": Target(0.9), "refined valid": Target(0.995),
    "from nothing valid": Target(0.99), "from nothing, median ms": Target(150, at_most=True),
}  # fmt: skip
TARGETS = {
    "panda-cup": ARM,
    "ur5-wipe": ARM,
    "airhockey-hit": {
        "from nothing valid": Target(0.995),
        "strict": Target(0.95), "loose": Target(0.999), "z error [mm s]": Target(0.2, at_most=True),
        "T / refined": Target(1.02, at_most=True), "refined valid": Target(0.995),
        "refine, median ms": Target(10, at_most=True), "grid, refined valid of 81": Target(81),
    },
    "airhockey-replan": {
        "rows/s/core": Target(120_000), "from nothing valid": Target(0.995),
        "strict": Target(0.85), "loose": Target(0.97), "refined valid": Target(0.995),
        "refine, median ms": Target(12, at_most=True),
    },
    "heavy-object": {
        "rows/s/core": Target(45_000), "from nothing valid": Target(0.97),
        "strict": Target(0.95), "loose": Target(0.985), "vertical error [rad s]": Target(0.012, at_most=True),
        "T / refined": Target(1.04, at_most=True), "refined valid": Target(0.98),
        "refine, median ms": Target(45, at_most=True),
    },
}  # fmt: skip


def judge(plans: Plans) -> dict[str, float]:
    """Say what plans are worth as the network gave them."""
    summary = evaluate_plans(plans).summary()
    metrics = summary["metrics_of_all"]
    named = {"z error [mm s]": "z_error_mm_s", "vertical error [rad s]": "vertical_error_rad_s"}
    found = {"strict": summary["valid_ratio"], "loose": summary["paper_valid_ratio"]}
    found["motion time [s]"] = metrics["duration_s"]["mean"]
    return found | {name: metrics[key]["mean"] for name, key in named.items() if key in metrics}


def draw_rate(name: str) -> float:
    """Accepted rows per second of CPU time."""
    case = prepare(name, "compiled")
    measure_rates([case], REPEATED, BLOCKS)
    return case.rate


def solve(problems: Plans) -> dict[str, float]:
    """Make plans from nothing one by one."""
    with one_thread():
        made = make_each(problems, DEFAULT_OPTIONS)
    return {
        "from nothing valid": float(np.mean([each.valid for each in made])),
        "from nothing, median ms": median(each.ms for each in made),
        "from nothing, mean ms": float(np.mean([each.ms for each in made])),
    }


def refine(plans: Plans) -> dict[str, float]:
    """Refine plans one by one; compare times where the result is valid."""
    with one_thread():
        made = make_each(plans, DEFAULT_OPTIONS)
    good = np.array([each.valid for each in made])
    after, ms = np.array([each.duration for each in made]), [each.ms for each in made]
    return {
        "T / refined": float(plans.duration[good].mean() / after[good].mean()),
        "refined valid": float(good.mean()),
        "refine, median ms": median(ms),
        "refine, mean ms": float(np.mean(ms)),
        "refine, p95 ms": float(np.quantile(ms, 0.95)),
        "of it verdicts, median ms": median(each.verdict_ms for each in made),
    }


def measure_grid(name: str) -> dict[str, float]:
    """The 81 pucks on a grid, hit from rest."""
    progress(f"{name}: 81 pucks on a grid")
    plans = Planner(name).plan_batch(draw_boundary_problems("airhockey-pucks", PUCKS).boundary)
    made = make_each(plans, DEFAULT_OPTIONS)
    strict = int(evaluate_plans(plans).valid.sum())
    return {"grid, strict of 81": strict, "grid, refined valid of 81": sum(each.valid for each in made)}


def replan(name: str, seed: int, planned: int, refined: int) -> list[dict[str, Any]]:
    """Plan anew from points on valid plans, to the same goal and to another one, by the network alone."""
    planner = Planner(name)
    plans = planner.plan_batch(draw_boundary_problems(name, planned, seed=seed).boundary)
    plans, found = plans[evaluate_plans(plans).valid], []
    others = np.roll(np.arange(len(plans)), 1)
    for goal, ends in (("same", plans.boundary), ("another", plans.boundary[others])):
        for when in WHEN:
            progress(f"{name}: {len(plans)} plans replanned at {when:g} T to {goal} goal")
            q, dq, ddq = plans.states_at(when * plans.duration)
            new = planner.plan(q, ends.goal_q, start_dq=dq, start_ddq=ddq, goal_dq=ends.goal_dq)
            facts = {"goal": goal, "at": when, "plans": len(new), "valid": float(evaluate_plans(new).valid.mean())}
            facts["refined valid"] = float(refine_plans(new[:refined]).valid.mean())
            facts["T / left"] = float(new.duration.mean() / ((1 - when) * plans.duration.mean()))
            found.append(facts)
    return found


def curve(name: str, seed: int, count: int) -> dict[int, float]:
    """Refine with few steps: mean motion time over that with as many as it takes, where both are valid."""
    plans = Planner(name).plan_batch(draw_boundary_problems(name, count, seed=seed).boundary)
    found = {}
    with one_thread():
        full = make_each(plans, DEFAULT_OPTIONS)
        for steps in STEPS:
            progress(f"{name}: {count} plans, at most {steps} steps")
            made = make_each(plans, replace(DEFAULT_OPTIONS, max_iterations=steps))
            both = [(a.duration, b.duration) for a, b in zip(made, full, strict=True) if a.valid and b.valid]
            few, all_ = np.array(both).T
            found[steps] = float(np.mean(few / all_))
    return found


def replan_table(found: list[dict[str, Any]]) -> str:
    """Lay out what ``replan`` found."""
    rows = [
        (each["goal"], f"{each['at']:g} T", f"{each['valid']:.1%}", f"{each['refined valid']:.1%}",
         f"{each['T / left']:.2f}" if each["goal"] == "same" else "")
        for each in found
    ]  # fmt: skip
    head = ("goal", "at", "valid", "refined valid", "T / left")
    return table(f"new plans from points on {found[0]['plans']} valid ones", head, rows, left=2)


def measure(name: str, seed: int, sizes: dict[str, int]) -> dict[str, float]:
    planned, refined, solved = (sizes[key] for key in ("planned", "refined", "solved"))
    progress(f"{name}: {planned} plans, {refined} of them refined, {solved} from nothing")
    planner, given = Planner(name), draw_boundary_problems(name, max(sizes.values()), seed=seed)
    planner.plan_batch(given.boundary[:10])  # warms up
    begun = time.process_time()
    plans = planner.plan_batch(given.boundary)
    each = {"plan, ms each of many": 1e3 * (time.process_time() - begun) / len(plans)}
    rate = {"rows/s/core": draw_rate(name)}
    return rate | each | judge(plans[:planned]) | refine(plans[:refined]) | solve(given[:solved])


def rows_of(name: str, found: dict[str, float]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for what, value in found.items():
        target = TARGETS.get(name, {}).get(what)
        cells = verdict(value, target.value if target else None, at_most=bool(target and target.at_most))
        ratio = f"{value / target.value:.3f}" if target else ""
        rows.append((name, what, f"{value:,.4g}", *cells, ratio))
    return rows


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--models", nargs="+", help="by default all that are shipped and whose robots are there")
    parser.add_argument("--full", action="store_true", help="1,000 plans of each, and as many refined as targets say")
    parser.add_argument("--curves", type=int, help="plans that are refined with few steps; none: no new plans, either")
    parser.add_argument("--seed", type=int, default=987_654_321, help="of the problems")


def main() -> None:
    chosen = arguments(__doc__, options)
    found: dict[str, Any] = {}
    models = chosen.models or at_hand(shipped_models())
    curved = (CURVED if chosen.full else SHORT["refined"]) if chosen.curves is None else chosen.curves
    for name in models:
        full = {"planned": PLANNED, "refined": REFINED.get(name, OTHERS), "solved": SOLVED}
        found[name] = measure(name, chosen.seed, full if chosen.full else SHORT)
        found[name] |= measure_grid(name) if name == GRID else {}
    rows = [row for name, values in found.items() for row in rows_of(name, values)]
    head = ("planner", "figure", "value", "target", "", "of target")
    tables = [table("datasets and their planners, fresh problems", head, rows, left=2)]
    curves = {name: curve(name, chosen.seed, curved) for name in models if curved}
    lines = [(name, *(f"{value:.4f}" for value in values.values())) for name, values in curves.items()]
    steps = [f"{step} step{'s' if step > 1 else ''}" for step in STEPS]
    if curves:
        tables.append(table("motion time over that after as many steps as it takes", ("planner", *steps), lines))
    again = []
    if REPLANNER in models and curved:
        again = replan(REPLANNER, chosen.seed, SHORT["planned"], SHORT["refined"])
        tables.append(replan_table(again))
    report({"planners": found, "curves": curves, "replanned": again}, tables, as_json=chosen.json)


if __name__ == "__main__":
    main()
