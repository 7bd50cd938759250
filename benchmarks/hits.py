"""PlannedHits online, replanning to the same goal, and refining until a deadline.

* A hit, from a puck to a plan: completing the task and planning, one at a time and 1,024 together; by a planner
  whose rates are the network's, and by one that paces them.
* Replanning to a goal that has not moved: what the network alone takes over what was left, and what is kept.
* Refining until a deadline: valid plans and motion time, and how long it took.

The clock is CPU time, that of deadlines too, so that other jobs on the machine count little; one BLAS thread; medians,
and the cases of hits measured in turn.

    python benchmarks/hits.py
"""

import argparse
import time
from typing import Any
from unittest.mock import patch

import numpy as np
from common import arguments, median, progress, report, table, verdict

from cnpgen.machine.threads import one_thread
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.plan_hits import CONTACT_DISTANCE_M, hit_tasks, load_completion, plan_hits
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refine_engine import refine_serially
from cnpgen.refine.refine_plans import refine_plans

NAME, TIME_PARAMETRIZED = "airhockey-replan", "airhockey-online"
BATCH = 1024
TARGET = np.array([2.49, 0.0])  # m, where pucks are sent
GOALS = {(1, "completed"): 0.3, (1, "planned"): 0.3, (1, "both"): 0.6, (BATCH, "both"): 0.04}  # ms
PARTS = (0.1, 0.3, 0.5, 0.7, 0.9, 0.95)  # of a plan's time
DEADLINES = (None, 10e-3, 20e-3, 40e-3, 60e-3, 80e-3)  # s


def hits(planner: Planner, repeat: int) -> dict[str, Any]:
    """Milliseconds per hit, and of its halves."""
    old = planner.plan_batch(draw_boundary_problems(NAME, BATCH, seed=5).boundary)
    states, random = old.states_at(0.4 * old.duration), np.random.default_rng(0)
    pucks = np.stack([random.uniform(0.8, 1.2, BATCH), random.uniform(-0.3, 0.3, BATCH)], axis=1)
    completion, found = load_completion(planner.model, None), {}
    for size in (1, BATCH):
        times: dict[str, list[float]] = {"completed": [], "planned": [], "both": []}
        for index in range(repeat if size == 1 else max(repeat // 20, 3)):
            row = slice(index % BATCH, index % BATCH + 1) if size == 1 else slice(None)
            state, puck = (states[0][row], states[1][row], states[2][row]), pucks[row]
            struck = plan_hits(planner, state, puck, TARGET)
            if not len(struck.plans):
                continue
            clock = [time.process_time()]
            with one_thread():
                hit_tasks(completion, state, puck, TARGET, contact_distance=CONTACT_DISTANCE_M, share=1.0)
            clock.append(time.process_time())
            planner.plan_batch(struck.plans.boundary)
            clock.append(time.process_time())
            plan_hits(planner, state, puck, TARGET)
            clock.append(time.process_time())
            for what, seconds in zip(times, np.diff(clock).tolist(), strict=True):
                times[what].append(seconds)
        for what, each in times.items():
            found[f"{size} {what}"] = 1e3 * median(each) / size
    struck = plan_hits(planner, states, pucks, TARGET)
    found |= {"answered": len(struck.plans) / BATCH, "valid": float(evaluate_plans(struck.plans).valid.mean())}
    return found


def same_goal(planner: Planner, plans: Plans, what: str) -> list[dict[str, Any]]:
    """Replan to the same goal after parts of the time."""
    found, goal = [], plans.boundary
    for part in PARTS:
        when = part * plans.duration
        new = planner.replan(plans, when, goal_q=goal.goal_q, goal_dq=goal.goal_dq)
        alone = planner.plan_batch(new.boundary)
        left = plans.duration - when
        found.append(
            {
                "of": what,
                "at": part,
                "network, median": median((alone.duration / left).tolist()),
                "network, valid": float(evaluate_plans(alone).valid.mean()),
                "largest": float((new.duration / left).max()),
                "valid": float(evaluate_plans(new).valid.mean()),
                "points": new.path_control_points.shape[1],
            }
        )
    return found


def deadlines(given: Plans) -> list[dict[str, Any]]:
    """Refine plans one by one until deadlines, which count CPU time here."""
    found, before = [], evaluate_plans(given).valid
    cost = [each.cost for each in refine_serially(given, RefineOptions(deadline=1e-9))]  # as they are given
    with patch("time.perf_counter", time.thread_time):
        for deadline in DEADLINES:
            options, times, made = RefineOptions(deadline=deadline), [], []
            for plan in given:
                begun = time.thread_time()
                made += refine_serially(plan, options)
                times.append(1e3 * (time.thread_time() - begun))
            valid = np.array([each.valid for each in made])
            ratio = np.array([each.cost for each in made]) / cost
            found.append(
                {
                    "deadline ms": None if deadline is None else 1e3 * deadline,
                    "ms": [float(value) for value in np.percentile(times, [50, 95, 100])],
                    "given valid": float(before.mean()),
                    "valid": float(valid.mean()),
                    "worse": int((before & ~valid).sum()),
                    "objective over given": median(ratio[valid].tolist()),
                }
            )
    return found


def rows_of(name: str, found: dict[str, Any]) -> list[tuple[str, ...]]:
    """Lay out what hits of a planner take."""
    rows: list[tuple[str, ...]] = []
    for size in (1, BATCH):
        for what in ("completed", "planned", "both"):
            value = found[f"{size} {what}"]
            ratio = f"{value / found[f'{size} planned']:.2f}"
            aim = verdict(value, GOALS.get((size, what)), at_most=True)
            rows.append((name, str(size), what, f"{value:.4f}", ratio, *aim))
    return rows


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--repeat", type=int, default=300)
    parser.add_argument("--plans", type=int, default=100, help="of replanning and refining")


def main() -> None:
    chosen = arguments(__doc__, options)
    struck = {}
    for name in (NAME, TIME_PARAMETRIZED):
        progress(f"striking: {name}")
        struck[name] = hits(Planner(name), chosen.repeat)
    planner = Planner(NAME)
    progress("replanning to the same goal")
    plans = planner.plan_batch(draw_boundary_problems(NAME, chosen.plans, seed=6).boundary)
    kept = plans[evaluate_plans(plans).valid]
    same = same_goal(planner, kept, "network") + same_goal(planner, refine_plans(kept).plans, "refined")
    progress("refining until deadlines")
    cut = deadlines(plans)
    head = ("planner", "batch", "what", "ms", "of planning", "target", "")
    tables = [
        table("hits, ms each", head, [row for item in struck.items() for row in rows_of(*item)], left=3),
        *(
            f"{name}: {found['answered']:.1%} have an answer; {found['valid']:.1%} of their plans are valid"
            for name, found in struck.items()
        ),
        table(
            "to the same goal, over what was left",
            ("plans", "at", "network, median", "valid", "replan, largest", "valid", "path points"),
            [
                (
                    each["of"],
                    f"{each['at']:g} T",
                    f"{each['network, median']:.2f}",
                    f"{each['network, valid']:.1%}",
                    f"{each['largest']:.6f}",
                    f"{each['valid']:.1%}",
                    str(each["points"]),
                )
                for each in same
            ],
            left=2,
        ),
        table(
            "refining until a deadline",
            ("deadline", "ms, median", "95 %", "largest", "given valid", "valid", "worse", "objective over given"),
            [
                (
                    "none" if each["deadline ms"] is None else f"{each['deadline ms']:g} ms",
                    *(f"{value:.1f}" for value in each["ms"]),
                    f"{each['given valid']:.1%}",
                    f"{each['valid']:.1%}",
                    str(each["worse"]),
                    f"{each['objective over given']:.4f}",
                )
                for each in cut
            ],
        ),
    ]
    report({"hits": struck, "same goal": same, "deadlines": cut}, tables, as_json=chosen.json)


if __name__ == "__main__":
    main()
