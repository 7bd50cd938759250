"""Hits of random pucks from random moving states: validity, early contact and execution.

Plans of the planner are refined. Early contacts are counted by SciPy and Pinocchio along the mallet's path, independent
of the verdict: any contact with more than 10 mm of path left. With ``--simulate N``, N refined hits are executed in
MuJoCo on the nominal and on the heavier plant. The last table compares hits of the 81-puck grid from rest with and
without the constraint, planned and refined in one run. The seed was not used for training or tuning.

With ``--reference``, hits that are not valid after refining are refined again through via points: 50 configurations
on the table, for at most 60 s each. The target is 97 % of all hits that either method solves.

    python benchmarks/puck_contact.py
    python benchmarks/puck_contact.py --hits 300 --seed 777302 --reference --simulate 60
"""

import argparse
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
from common import arguments, median, progress, report, table, verdict
from scipy.interpolate import BSpline

from cnpgen.benchmark.simulator.simulate import simulate_plans
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import load_model
from cnpgen.planner.plan_hits import PlannedHits, plan_hits
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.trajectory.boundary import Boundary, anchor_line, assemble

NAME, GRID = "airhockey-replan", "airhockey-pucks"
TARGET = np.array([2.49, 0.0])  # m, of the pucks
PUCKS = np.array([[0.75, -0.35], [1.2, 0.35]])  # m, range of the random pucks
GRID_TARGETS = {"time": 1.01, "cpu": 1.5, "planning": 1.3}  # with the constraint over without
LAST_M = 0.01  # path length of the mallet on which contact is legal
PHASES = np.linspace(0, 1, 2001)
DEPTH_TOLERANCE_M = 1e-6
MAX_GUESSES, MAX_REFERENCE_TIME_S = 50, 60.0  # of the reference, per hit
SOLVED_SHARE = 0.97  # target: of the hits that are solved after refining or by the reference


def early_depth(plans: Plans, pucks: np.ndarray) -> np.ndarray:
    """Return the largest penetration of the puck [m] with more than ``LAST_M`` of path left; negative without one."""
    contact = load_problem("airhockey").first(PuckContact)
    assert contact is not None
    _, robot = open_problem(plans.problem)
    data, depths = robot.model.createData(), []
    for path, puck in zip(plans.path_control_points, pucks, strict=True):
        degree = plans.motion.degree
        knots = np.r_[np.zeros(degree), np.linspace(0, 1, len(path) - degree + 1), np.ones(degree)]
        tip = np.empty((len(PHASES), 2))
        for row, q in zip(tip, BSpline(knots, path, degree)(PHASES), strict=True):
            pin.forwardKinematics(robot.model, data, q)
            row[:] = pin.updateFramePlacement(robot.model, data, robot.tip_frame).translation[:2]
        steps = np.linalg.norm(np.diff(tip, axis=0), axis=1)
        left = np.append(np.cumsum(steps[::-1])[::-1], 0.0)
        distance = np.linalg.norm(tip - puck, axis=1)[left > LAST_M]
        depths.append(contact.mallet_radius + contact.puck_radius - distance.min(initial=np.inf))
    return np.array(depths)


def moving_hits(count: int, seed: int) -> tuple[PlannedHits, np.ndarray]:
    """Plan hits of random pucks from random moving states; return them and the pucks [m], shape (count, 2)."""
    start = draw_boundary_problems(NAME, count, seed=seed).boundary
    pucks = np.random.default_rng(seed).uniform(PUCKS[0], PUCKS[1], (count, 2))
    return plan_hits(Planner(NAME), (start.start_q, start.start_dq, start.start_ddq), pucks, TARGET), pucks


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
    configurations = draw_boundary_problems(NAME, MAX_GUESSES, seed=seed).boundary.start_q
    for index in np.flatnonzero(~solved).tolist():
        started = time.monotonic()
        for via_point in configurations:
            if found[index] or time.monotonic() - started > MAX_REFERENCE_TIME_S:
                break
            plan = plans[index]
            rate = plan.rate_control_points / 2
            line = anchor_line(plan.boundary, rate, spec)
            along = np.linspace(0, 1, line.shape[1])[:, None]
            interior = line + (1 - np.abs(2 * along - 1)) * (via_point - line.mean(axis=1))
            path = assemble(plan.boundary, interior, rate, spec)
            guess = replace(plan, path_control_points=path, rate_control_points=rate)
            found[index] = refine_plans(guess, workers=1).valid[0]
        progress(f"hit {index}: {'solved' if found[index] else 'not solved'} by via points")
    return found


def executed(plans: Plans, count: int) -> dict[str, str]:
    """Execute the first valid hits on two plants; return the successes."""
    chosen = plans[evaluate_plans(plans).valid][:count]
    results = {}
    for plant in ("nominal", "heavier"):
        successes = [one.success for one in simulate_plans(chosen, plant=plant).executed]
        results[plant] = f"{sum(successes)} of {len(successes)}"
    return results


def planning_time(model: Model, boundary: Boundary) -> float:
    """Return the CPU time of planning one by one, per plan [s]."""
    planner = Planner(model)
    planner.plan_batch(boundary[:1])
    start = time.process_time()
    for index in range(len(boundary)):
        planner.plan_batch(boundary[index : index + 1])
    return (time.process_time() - start) / len(boundary)


def grid() -> list[dict[str, Any]]:
    """Plan and refine the hits of the grid of pucks from rest, with and without the constraint."""
    boundary, model, records = draw_boundary_problems(GRID, 81, seed=0).boundary, load_model("airhockey-hit"), []
    plans = Planner(model).plan_batch(boundary)
    problem = load_problem("airhockey")
    others = tuple(item for item in problem.constraint if not isinstance(item, PuckContact))
    without = record_problem(replace(problem, constraint=others))
    for name, record in (("with puck-contact", plans.problem), ("without", without)):
        start = time.process_time()
        refined = refine_plans(replace(plans, problem=record), workers=1).plans
        seconds = time.process_time() - start
        valid, planning = evaluate_plans(refined).valid, planning_time(replace(model, problem=record), boundary)
        records.append(
            {"problem": name, "valid": int(valid.sum()), "time": median(refined.duration.tolist()), "cpu": seconds}
            | {"planning": planning}
        )
    return records


def grid_tables(records: list[dict[str, Any]]) -> list[str]:
    """Return the hits of the grid, and the ratios with and without the constraint with their targets."""
    rows = [
        (row["problem"], str(row["valid"]), f"{row['time']:.5f}", f"{row['cpu']:.2f}", f"{1e3 * row['planning']:.3f}")
        for row in records
    ]
    head = ("problem", "valid", "time to hit [s]", "CPU time of refining [s]", "of planning one [ms]")
    ratios = {key: records[0][key] / records[1][key] for key in GRID_TARGETS}
    names = {"time": "time to hit", "cpu": "CPU time of refining", "planning": "CPU time of planning"}
    cells = [
        (names[key], f"{ratio:.4f}", *verdict(ratio, GRID_TARGETS[key], at_most=True)) for key, ratio in ratios.items()
    ]
    return [
        table("81 pucks from rest, refined", head, rows),
        table("with the constraint over without", ("", "ratio", "target", ""), cells),
    ]


def reference_table(solved: np.ndarray, reference: np.ndarray) -> str:
    """Compare the numbers of hits that are solved after refining and by the reference."""
    share = float(solved.sum() / max(reference.sum(), 1))
    row = (str(solved.sum()), str(reference.sum()), f"{share:.4f}", *verdict(share, SOLVED_SHARE))
    return table("hits that are solved", ("refined", "with via points", "share", "target", ""), [row])


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--hits", type=int, default=300)
    parser.add_argument("--seed", type=int, default=20261)
    parser.add_argument("--reference", action="store_true", help="refine unsolved hits through via points")
    parser.add_argument("--simulate", type=int, default=0, help="refined hits that are executed")


def main() -> None:
    chosen = arguments(__doc__, options)
    progress("planning")
    planned, pucks = moving_hits(chosen.hits, chosen.seed)
    plans, pucks = planned.plans, pucks[planned.plans.sample_id]
    progress("refining")
    results = {"planned": evaluated(plans, pucks)}
    refined = refine_plans(plans).plans
    results["refined"] = evaluated(refined, pucks)
    solved = evaluate_plans(refined).valid
    reference = by_via_points(plans, solved, chosen.seed) if chosen.reference else None
    reasons = {reason: planned.reasons.count(reason) for reason in sorted(set(planned.reasons)) if reason}
    simulated = executed(refined, chosen.simulate) if chosen.simulate else {}
    progress("the grid of pucks")
    records = grid()
    tables = [
        f"{len(plans)} of {chosen.hits} hits have an answer; the others: {reasons or 'none'}",
        table(
            "hits from moving states",
            ("", "plans", "valid", "early contacts of valid plans", "target", "", "deepest [mm]"),
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
        *([] if reference is None else [reference_table(solved, reference)]),
        *([table("executed hits that succeed", ("plant", ""), list(simulated.items()))] if simulated else []),
        *grid_tables(records),
    ]
    counts = {} if reference is None else {"refined": int(solved.sum()), "with via points": int(reference.sum())}
    report(
        {"moving": results, "reference": counts, "reasons": reasons, "executed": simulated, "grid": records},
        tables,
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
