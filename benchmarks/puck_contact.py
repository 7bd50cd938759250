"""Hits of random pucks from random moving states: validity, early contact and execution.

Plans of both planners are refined. Early contacts are counted by SciPy and Pinocchio along the mallet's path,
independent of the verdict: any contact with more than 10 mm of path left. With ``--simulate N``, N refined hits of each
planner are executed in MuJoCo on the nominal and on the heavier plant. The seed was not used for training or tuning.

The last table has ratios with and without the constraint, in one run: refining the 81-puck grid from rest, and planning
one hit from a moving state.

With ``--reference``, hits of the first planner that are not valid after refining are refined again through via points:
50 configurations on the table, for at most 60 s each. The target is 97 % of all hits that either method solves.

    python benchmarks/puck_contact.py
    python benchmarks/puck_contact.py --hits 300 --seed 27112811 --reference --simulate 300
"""

import argparse
import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
from common import arguments, cpu_of, median, progress, report, table, verdict
from scipy.interpolate import BSpline

from cnpgen.addons.benchmark.simulator.simulate import simulate_plans
from cnpgen.addons.online.plan_hits import plan_hits
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model_file import load_model
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import ProblemRecord, open_problem, record_problem
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.trajectory.boundary import anchor_line, assemble

TASKS, GRID = "airhockey-replan", "airhockey-pucks"
TARGET = np.array([2.49, 0.0])  # m, of the pucks
PUCKS = np.array([[0.75, -0.35], [1.2, 0.35]])  # m, range of the random pucks
GRID_TARGETS, MAX_PLANNING_RATIO = (
    {"time": 1.01, "cpu": 1.5},
    1.3,
)  # with the constraint over without
PLANNERS = "airhockey-replan", "airhockey-online"
LAST_M = 0.01  # path length of the mallet on which contact is legal
PHASES = np.linspace(0, 1, 2001)
DEPTH_TOLERANCE_M = 1e-6
MAX_GUESSES, MAX_REFERENCE_TIME_S = 50, 60.0  # of the reference, per hit
SOLVED_SHARE = (
    0.97  # target: of the hits that are solved after refining or by the reference
)


def early_depth(plans: Plans, pucks: np.ndarray) -> np.ndarray:
    """Return the largest penetration of the puck [m] with more than ``LAST_M`` of path left; negative without one."""
    contact = load_problem("airhockey").first(PuckContact)
    assert contact is not None
    _, robot = open_problem(plans.problem)
    data, depths = robot.model.createData(), []
    for path, puck in zip(plans.path_control_points, pucks, strict=True):
        degree = plans.motion.degree
        knots = np.r_[
            np.zeros(degree), np.linspace(0, 1, len(path) - degree + 1), np.ones(degree)
        ]
        tip = np.empty((len(PHASES), 2))
        for row, q in zip(tip, BSpline(knots, path, degree)(PHASES), strict=True):
            pin.forwardKinematics(robot.model, data, q)
            row[:] = pin.updateFramePlacement(
                robot.model, data, robot.tip_frame
            ).translation[:2]
        steps = np.linalg.norm(np.diff(tip, axis=0), axis=1)
        left = np.append(np.cumsum(steps[::-1])[::-1], 0.0)
        distance = np.linalg.norm(tip - puck, axis=1)[left > LAST_M]
        depths.append(
            contact.mallet_radius + contact.puck_radius - distance.min(initial=np.inf)
        )
    return np.array(depths)


def moving_tasks(
    count: int, seed: int
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """Draw moving states and pucks [m], shape (count, 2)."""
    start = draw_boundary_problems(TASKS, count, seed=seed).boundary
    pucks = np.random.default_rng(seed).uniform(PUCKS[0], PUCKS[1], (count, 2))
    return (start.start_q, start.start_dq, start.start_ddq), pucks


def evaluated(plans: Plans, pucks: np.ndarray) -> dict[str, Any]:
    """Count valid plans, and early contacts among them."""
    valid, depth = evaluate_plans(plans).valid, early_depth(plans, pucks)
    return {
        "plans": len(plans),
        "valid": int(valid.sum()),
        "early contacts of valid plans": int((depth[valid] > DEPTH_TOLERANCE_M).sum()),
        "deepest [mm]": float(1e3 * depth[valid].max(initial=-np.inf)),
    }


def by_via_points(plans: Plans, solved: np.ndarray, seed: int) -> np.ndarray:
    """Return a mask of the hits that are solved before or after refining motions through via points on the table.

    Args:
        plans: Planned hits.
        solved: Mask of those that are solved.
        seed: Seed of the via points.
    """
    found, spec = solved.copy(), load_problem("airhockey").trajectory
    configurations = draw_boundary_problems(
        TASKS, MAX_GUESSES, seed=seed
    ).boundary.start_q
    for index in np.flatnonzero(~solved).tolist():
        started = time.monotonic()
        for via_point in configurations:
            if found[index] or time.monotonic() - started > MAX_REFERENCE_TIME_S:
                break
            plan = plans[index]
            rate = plan.rate_control_points / 2
            line = anchor_line(plan.boundary, rate, spec)
            along = np.linspace(0, 1, line.shape[1])[:, None]
            interior = line + (1 - np.abs(2 * along - 1)) * (
                via_point - line.mean(axis=1)
            )
            path = assemble(plan.boundary, interior, rate, spec)
            guess = replace(plan, path_control_points=path, rate_control_points=rate)
            found[index] = refine_plans(guess, workers=1).valid[0]
        progress(
            f"hit {index}: {'solved' if found[index] else 'not solved'} by via points"
        )
    return found


def executed(plans: Plans, count: int) -> dict[str, str]:
    """Execute the first hits on two plants; return the successes."""
    chosen, results = plans[:count], dict[str, str]()
    for plant in ("nominal", "heavier"):
        successes = [
            one.success for one in simulate_plans(chosen, plant=plant).executed
        ]
        results[plant] = f"{sum(successes)} of {len(successes)}"
    return results


def without_contact(record: ProblemRecord) -> ProblemRecord:
    """Return a problem without its constraint ``puck-contact``."""
    with record.restored() as problem:
        others = tuple(
            item for item in problem.constraint if not isinstance(item, PuckContact)
        )
        return record_problem(replace(problem, constraint=others))


def planning_ratio(name: str, count: int, seed: int) -> float:
    """Return the CPU time of planning one hit with the constraint over that without: the median of alternating hits."""
    model = load_model(name)
    planners = (
        Planner(model),
        Planner(replace(model, problem=without_contact(model.problem))),
    )
    (q, dq, ddq), pucks = moving_tasks(count, seed)
    ratios = []
    for index in range(count):
        row = slice(index, index + 1)
        state = q[row], dq[row], ddq[row]
        seconds = [
            cpu_of(partial(plan_hits, planner, state, pucks[row], TARGET))
            for planner in planners
        ]
        ratios.append(seconds[0] / seconds[1])
    return median(ratios)


def grid() -> list[dict[str, Any]]:
    """Refine the hits of the grid of pucks from rest, with and without the constraint."""
    plans = Planner("airhockey-hit").plan_batch(
        draw_boundary_problems(GRID, 81, seed=0).boundary
    )
    problems = {
        "with puck-contact": plans.problem,
        "without": without_contact(plans.problem),
    }
    for record in problems.values():
        refine_plans(replace(plans[:1], problem=record), workers=1)  # loads the kernels
    refined, seconds = (
        {name: list[Plans]() for name in problems},
        dict.fromkeys(problems, 0.0),
    )
    for index in range(len(plans)):  # in turn, since the clock of processors changes
        for name, record in problems.items():
            start = time.process_time()
            refined[name].append(
                refine_plans(replace(plans[index], problem=record), workers=1).plans
            )
            seconds[name] += time.process_time() - start
    return [
        {
            "problem": name,
            "valid": sum(int(evaluate_plans(each).valid.sum()) for each in found),
            "time": median([float(each.duration[0]) for each in found]),
            "cpu": seconds[name],
        }
        for name, found in refined.items()
    ]


def grid_tables(records: list[dict[str, Any]], planning: dict[str, float]) -> list[str]:
    """Return the hits of the grid, and the ratios with and without the constraint with their targets."""
    rows = [
        (row["problem"], str(row["valid"]), f"{row['time']:.5f}", f"{row['cpu']:.2f}")
        for row in records
    ]
    head = ("problem", "valid", "time to hit [s]", "CPU time of refining [s]")
    names = {"time": "time to hit", "cpu": "CPU time of refining"}
    ratios = {
        label: (records[0][key] / records[1][key], GRID_TARGETS[key])
        for key, label in names.items()
    }
    ratios |= {
        f"CPU time of planning, {model}": (ratio, MAX_PLANNING_RATIO)
        for model, ratio in planning.items()
    }
    cells = [
        (name, f"{ratio:.4f}", *verdict(ratio, most, at_most=True))
        for name, (ratio, most) in ratios.items()
    ]
    return [
        table("81 pucks from rest, refined", head, rows),
        table("with the constraint over without", ("", "ratio", "target", ""), cells),
    ]


def reference_table(solved: np.ndarray, reference: np.ndarray) -> str:
    """Compare the numbers of hits that are solved after refining and by the reference."""
    share = float(solved.sum() / max(reference.sum(), 1))
    row = (
        str(solved.sum()),
        str(reference.sum()),
        f"{share:.4f}",
        *verdict(share, SOLVED_SHARE),
    )
    return table(
        "hits that are solved",
        ("refined", "with via points", "share", "target", ""),
        [row],
    )


def execution_table(simulated: dict[str, dict[str, str]]) -> str:
    """Return the executed hits that succeed, per planner and plant."""
    plants = list(next(iter(simulated.values())))
    rows = [
        (name, *(counts[plant] for plant in plants))
        for name, counts in simulated.items()
    ]
    return table("executed hits that succeed", ("planner", *plants), rows)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--hits", type=int, default=300)
    parser.add_argument("--seed", type=int, default=20261)
    parser.add_argument(
        "--reference",
        action="store_true",
        help="refine unsolved hits through via points",
    )
    parser.add_argument(
        "--simulate",
        type=int,
        default=0,
        help="refined hits of each planner that are executed",
    )


def main() -> None:
    chosen = arguments(__doc__, options)
    states, pucks = moving_tasks(chosen.hits, chosen.seed)
    hits = {name: plan_hits(Planner(name), states, pucks, TARGET) for name in PLANNERS}
    results, simulated, solved = (
        dict[str, dict[str, Any]](),
        dict[str, dict[str, str]](),
        dict[str, np.ndarray](),
    )
    for name, found in hits.items():
        progress(f"hits of {name}")
        refined, ahead = refine_plans(found.plans).plans, pucks[found.plans.sample_id]
        results |= {
            name: evaluated(found.plans, ahead),
            f"{name}, refined": evaluated(refined, ahead),
        }
        solved[name] = evaluate_plans(refined).valid
        if chosen.simulate:
            simulated[name] = executed(refined[solved[name]], chosen.simulate)
    planned = hits[PLANNERS[0]]
    plans, solved_hits = planned.plans, solved[PLANNERS[0]]
    reference = (
        by_via_points(plans, solved_hits, chosen.seed) if chosen.reference else None
    )
    reasons = {
        reason: planned.reasons.count(reason)
        for reason in sorted(set(planned.reasons))
        if reason
    }
    progress("the grid of pucks")
    records = grid()
    planning = {
        model: planning_ratio(model, chosen.hits, chosen.seed) for model in PLANNERS
    }
    tables = [
        f"{len(plans)} of {chosen.hits} hits have an answer; the others: {reasons or 'none'}",
        table(
            "hits from moving states",
            (
                "",
                "plans",
                "valid",
                "early contacts of valid plans",
                "target",
                "",
                "deepest [mm]",
            ),
            [
                (
                    name,
                    str(row["plans"]),
                    str(row["valid"]),
                    str(row["early contacts of valid plans"]),
                    *verdict(row["early contacts of valid plans"], 0, at_most=True),
                    f"{row['deepest [mm]']:.4f}",
                )
                for name, row in results.items()
            ],
        ),
        *([] if reference is None else [reference_table(solved_hits, reference)]),
        *([execution_table(simulated)] if simulated else []),
        *grid_tables(records, planning),
    ]
    counts = (
        {}
        if reference is None
        else {
            "refined": int(solved_hits.sum()),
            "with via points": int(reference.sum()),
        }
    )
    document = {
        "moving": results,
        "reference": counts,
        "reasons": reasons,
        "executed": simulated,
        "grid": records,
    }
    report({**document, "planning": planning}, tables, as_json=chosen.json)


if __name__ == "__main__":
    main()
