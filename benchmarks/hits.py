"""Online hits with the way back, replanning to an unchanged goal, and refining until a deadline.

* Hits: completion of the task and planning, one puck at a time and 1,024 together. One planner takes the rates of the
  network, the other one computes them by time parametrization.
* Hits and the way back to the start, one puck at a time, for a grid of 81 pucks: planning time of both, motion times.
* Replanning to an unchanged goal: durations of the network's plans and of ``replan``, over the remaining time.
* Refining until a deadline: valid plans, motion times and CPU times.

The clock is CPU time, also for deadlines, so that other processes have little influence. Times are medians with one
BLAS thread; the cases of hits are measured in turn.

    python benchmarks/hits.py
"""

import argparse
import time
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
from common import arguments, median, progress, report, table, verdict

from cnpgen.addons.online.hit_tasks import hit_tasks, load_completion
from cnpgen.addons.online.plan_hits import CONTACT_DISTANCE_M, plan_hits
from cnpgen.machine.threads import one_thread
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refine_engine import refine_serially
from cnpgen.refine.refine_plans import refine_plans

NAME, TIME_PARAMETRIZED = "airhockey-replan", "airhockey-online"
BATCH = 1024
TARGET = np.array([2.49, 0.0])  # m, target of the pucks
TARGETS_MS = {
    (1, "completed"): 0.3,
    (1, "planned"): 0.3,
    (1, "both"): 0.6,
    (BATCH, "both"): 0.04,
}
SPEED_SHARES = (
    0.98,
    0.9,
)  # of the maximum hitting speed: the way back must stay within the velocity limits
REPLAN_TIMES = (0.1, 0.3, 0.5, 0.7, 0.9, 0.95)  # fractions of the motion time
DEADLINES = (None, 10e-3, 20e-3, 40e-3, 60e-3, 80e-3)  # s


def hits(planner: Planner, repeat: int) -> dict[str, Any]:
    """Measure the CPU time per hit [ms], of the completion, of the planning, and of both."""
    first = planner.plan_batch(draw_boundary_problems(NAME, BATCH, seed=5).boundary)
    states, random = first.states_at(0.4 * first.duration), np.random.default_rng(0)
    pucks = np.stack(
        [random.uniform(0.8, 1.2, BATCH), random.uniform(-0.3, 0.3, BATCH)], axis=1
    )
    completion, results = load_completion(planner.model, None), {}
    for size in (1, BATCH):
        times: dict[str, list[float]] = {"completed": [], "planned": [], "both": []}
        for index in range(repeat if size == 1 else max(repeat // 20, 3)):
            row = slice(index % BATCH, index % BATCH + 1) if size == 1 else slice(None)
            state, puck = (states[0][row], states[1][row], states[2][row]), pucks[row]
            planned = plan_hits(planner, state, puck, TARGET)
            if not len(planned.plans):
                continue
            clock = [time.process_time()]
            with one_thread():
                hit_tasks(
                    completion,
                    state,
                    puck,
                    TARGET,
                    contact_distance=CONTACT_DISTANCE_M,
                    share=1.0,
                )
            clock.append(time.process_time())
            planner.plan_batch(planned.plans.boundary)
            clock.append(time.process_time())
            plan_hits(planner, state, puck, TARGET)
            clock.append(time.process_time())
            for part, seconds in zip(times, np.diff(clock).tolist(), strict=True):
                times[part].append(seconds)
        for part, durations in times.items():
            results[f"{size} {part}"] = 1e3 * median(durations) / size
    planned = plan_hits(planner, states, pucks, TARGET)
    results |= {
        "planned": len(planned.plans) / BATCH,
        "valid": float(evaluate_plans(planned.plans).valid.mean()),
    }
    return results


def hits_and_ways_back(planner: Planner, speed_share: float) -> dict[str, Any]:
    """Plan hits of a grid of pucks from rest and the ways back, one by one; both are judged."""
    home, still = planner.robot.home, np.zeros(planner.robot.n)
    grid = [(x, y) for x in np.linspace(0.8, 1.2, 9) for y in np.linspace(-0.4, 0.4, 9)]
    plan = partial(
        plan_hits,
        planner,
        (home, still, still),
        target=TARGET,
        speed_share=speed_share,
        home=home,
    )
    plan(grid[0])
    found: dict[str, list[float]] = {
        "planning ms": [],
        "hit s": [],
        "both s": [],
        "speed m/s": [],
        "valid": [],
    }
    for puck in grid:
        start = time.process_time()
        planned = plan(puck)
        milliseconds = 1e3 * (time.process_time() - start)
        if not len(planned.plans):
            continue
        parts = planned.sequences.parts
        values = (
            milliseconds,
            float(parts[0].duration[0]),
            float(planned.sequences.duration[0]),
            float(parts[0].columns["hit_speed"][0]),
            float(all(evaluate_plans(part).valid.all() for part in parts)),
        )
        for name, value in zip(found, values, strict=True):
            found[name].append(value)
    return {
        "speed share": speed_share,
        "pucks": len(grid),
        "answers": len(found["valid"]),
        **found,
    }


def same_goal(planner: Planner, plans: Plans, source: str) -> list[dict[str, Any]]:
    """Replan to the same goal after fractions of the motion time."""
    records, goal = [], plans.boundary
    for part in REPLAN_TIMES:
        time = part * plans.duration
        new = planner.replan(plans, time, goal_q=goal.goal_q, goal_dq=goal.goal_dq)
        network = planner.plan_batch(new.boundary)
        remaining = plans.duration - time
        records.append(
            {
                "of": source,
                "at": part,
                "network, median": median((network.duration / remaining).tolist()),
                "network, valid": float(evaluate_plans(network).valid.mean()),
                "largest": float((new.duration / remaining).max()),
                "valid": float(evaluate_plans(new).valid.mean()),
                "points": new.path_control_points.shape[1],
            }
        )
    return records


def deadlines(plans: Plans) -> list[dict[str, Any]]:
    """Refine plans one by one until deadlines in CPU time."""
    records, input_valid = [], evaluate_plans(plans).valid
    cost = [
        refined.cost for refined in refine_serially(plans, RefineOptions(deadline=1e-9))
    ]  # of the input
    with patch("time.perf_counter", time.thread_time):
        for deadline in DEADLINES:
            options, times, results = RefineOptions(deadline=deadline), [], []
            for plan in plans:
                start = time.thread_time()
                results += refine_serially(plan, options)
                times.append(1e3 * (time.thread_time() - start))
            valid = np.array([refined.valid for refined in results])
            ratio = np.array([refined.cost for refined in results]) / cost
            records.append(
                {
                    "deadline ms": None if deadline is None else 1e3 * deadline,
                    "ms": [
                        float(value) for value in np.percentile(times, [50, 95, 100])
                    ],
                    "input valid": float(input_valid.mean()),
                    "valid": float(valid.mean()),
                    "worse": int((input_valid & ~valid).sum()),
                    "objective / input": median(ratio[valid].tolist()),
                }
            )
    return records


def rows_of(name: str, results: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the rows of the table of hits."""
    rows: list[tuple[str, ...]] = []
    for size in (1, BATCH):
        for part in ("completed", "planned", "both"):
            value = results[f"{size} {part}"]
            ratio = f"{value / results[f'{size} planned']:.2f}"
            target = verdict(value, TARGETS_MS.get((size, part)), at_most=True)
            rows.append((name, str(size), part, f"{value:.4f}", ratio, *target))
    return rows


def quartiles(values: list[float]) -> str:
    """Return the median and, in parentheses, the first and the third quartile."""
    first, half, third = np.percentile(values, [25, 50, 75])
    return f"{half:.2f} ({first:.2f} to {third:.2f})"


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--repeat", type=int, default=300)
    parser.add_argument(
        "--plans", type=int, default=100, help="plans that are replanned and refined"
    )


def main() -> None:
    chosen = arguments(__doc__, options)
    hit_results = {}
    for name in (NAME, TIME_PARAMETRIZED):
        progress(f"hits: {name}")
        hit_results[name] = hits(Planner(name), chosen.repeat)
    planner = Planner(NAME)
    progress("replanning to the same goal")
    plans = planner.plan_batch(
        draw_boundary_problems(NAME, chosen.plans, seed=6).boundary
    )
    valid_plans = plans[evaluate_plans(plans).valid]
    same_goal_records = same_goal(planner, valid_plans, "network") + same_goal(
        planner, refine_plans(valid_plans).plans, "refined"
    )
    progress("hits and ways back")
    ways_back = [
        hits_and_ways_back(Planner(TIME_PARAMETRIZED), share) for share in SPEED_SHARES
    ]
    progress("refining until deadlines")
    deadline_records = deadlines(plans)
    head = ("planner", "batch", "part", "ms", "of planning", "target", "")
    tables = [
        table(
            "CPU time per hit [ms]",
            head,
            [row for item in hit_results.items() for row in rows_of(*item)],
            left=3,
        ),
        *(
            f"{name}: {results['planned']:.1%} of the hits are planned; {results['valid']:.1%} of their plans are valid"
            for name, results in hit_results.items()
        ),
        table(
            f"hits and ways back, one puck at a time, {TIME_PARAMETRIZED}: median, and from first to third quartile",
            (
                "speed share",
                "answers",
                "planning, ms",
                "hit, s",
                "both, s",
                "hit speed, m/s",
                "valid",
            ),
            [
                (
                    f"{record['speed share']:g}",
                    f"{record['answers']} of {record['pucks']}",
                    *(
                        quartiles(record[name])
                        for name in ("planning ms", "hit s", "both s", "speed m/s")
                    ),
                    f"{np.mean(record['valid']):.1%}",
                )
                for record in ways_back
            ],
        ),
        table(
            "replanning to the same goal, motion time over the remaining time",
            (
                "plans",
                "at",
                "network, median",
                "valid",
                "replan, maximum",
                "valid",
                "path points",
            ),
            [
                (
                    record["of"],
                    f"{record['at']:g} T",
                    f"{record['network, median']:.2f}",
                    f"{record['network, valid']:.1%}",
                    f"{record['largest']:.6f}",
                    f"{record['valid']:.1%}",
                    str(record["points"]),
                )
                for record in same_goal_records
            ],
            left=2,
        ),
        table(
            "refining until a deadline",
            (
                "deadline",
                "ms, median",
                "95 %",
                "maximum",
                "input valid",
                "valid",
                "worse",
                "objective / input",
            ),
            [
                (
                    "none"
                    if record["deadline ms"] is None
                    else f"{record['deadline ms']:g} ms",
                    *(f"{value:.1f}" for value in record["ms"]),
                    f"{record['input valid']:.1%}",
                    f"{record['valid']:.1%}",
                    str(record["worse"]),
                    f"{record['objective / input']:.4f}",
                )
                for record in deadline_records
            ],
        ),
    ]
    report(
        {
            "hits": hit_results,
            "ways back": ways_back,
            "same goal": same_goal_records,
            "deadlines": deadline_records,
        },
        tables,
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
