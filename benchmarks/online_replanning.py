"""Online planning: new problems that start on motions in execution, in six sets.

First motions are valid plans of the shipped planners for hits and replans. New problems start on them at a random time
between 0.05 and 0.95 of their motion time T, with the height error of the motion.

* "new puck": to a new puck anywhere on the table. The hit direction is within 120 degrees of the direction to the puck.
  A fifth of the hits has full speed. The goal configuration is close to the present one.
* "same goal": to the goal of the motion, by the network and by ``replan``. The latter keeps the remaining trajectory
  unless the network is faster by 2 %. If it has finer knots, it is also refined with all of its control points.
* "near the base": to goals of the dataset airhockey-hit at full speed, close to the base configuration.
* "another problem's": to goals of the dataset airhockey-replan, close to other starts.
* "on refined plans": as "new puck", on motions that were refined before their execution.
* "dataset rows": rows of the dataset airhockey-replan.

Nothing was selected with these seeds. The clock is CPU time with one BLAS thread. The tables have targets.

    python benchmarks/online_replanning.py
    python benchmarks/online_replanning.py --problems 1000 --refined 1000
"""

import argparse
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from common import arguments, median, progress, report, table, verdict
from numpy.typing import NDArray
from refiner_problems import Made, make_each

from cnpgen.machine.threads import one_thread
from cnpgen.make.complete import complete
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.stages.hitting_velocity import HittingVelocity
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.join import concatenate
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.refine.options import DEFAULT_OPTIONS
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.refine.refiner import Refiner
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

FIRST = (
    "airhockey-replan",
    "airhockey-hit",
)  # datasets and planners of the first motions
SWITCH_RANGE = (0.05, 0.95)  # of T
TIMES_PER_REFINED_MOTION = 4
OVERSAMPLING = 1.25  # problems sampled per problem: some first motions are invalid, some tasks are infeasible
TIME_TOLERANCE_S = 1e-9  # of a remaining trajectory, by rounding
FULL_SPEED_FRACTION = 0.2
MAX_DIRECTION_ERROR_RAD = np.deg2rad(120)
TABLE_RANGE_M = np.array([[0.6, 1.3], [-0.45, 0.45]])
VALID_TARGETS = {  # fraction of valid plans of the network
    "new puck": 0.97, "same goal": 0.96, "near the base": 0.95, "another problem's": 0.95, "on refined plans": 0.95,
    "dataset rows": 0.96,
}  # fmt: skip
REFINED_VALID, TIME_RATIO, REFINE_MS, REFINE_P95_MS = 0.998, 1.08, 8.0, 15.0  # targets

State = tuple[Any, Any, Any]
Targets = dict[
    str, tuple[float, bool]
]  # figure -> target, and whether it is an upper bound


@dataclass(frozen=True)
class Problems:
    """N problems.

    Attributes:
        boundary: Their boundary conditions.
        executed: The motions on which they start if the goals are the same, else None.
        time: Time of the switch on these motions [s], shape (N,).
    """

    boundary: Boundary
    executed: Plans | None = None
    time: NDArray[np.float64] | None = None

    def __getitem__(self, rows: NDArray[np.int64]) -> "Problems":
        executed = None if self.executed is None else self.executed[rows]
        return Problems(
            self.boundary[rows],
            executed,
            None if self.time is None else self.time[rows],
        )


def first_motions(count: int, seed: int) -> Plans:
    """Return valid plans of the shipped planners, half of them replans and half hits."""
    parts = []
    for name in FIRST:
        plans = Planner(name).plan_batch(
            draw_boundary_problems(
                name, int(OVERSAMPLING * count / 2), seed=seed
            ).boundary
        )
        parts.append(plans[evaluate_plans(plans).valid][: count // 2])
    return concatenate(parts)


def times_of(plans: Plans, random: np.random.Generator) -> NDArray[np.float64]:
    """Sample one time of every plan [s]."""
    return random.uniform(*SWITCH_RANGE, len(plans)) * plans.duration


def states_of(plans: Plans, random: np.random.Generator) -> State:
    """Return the state of every plan at a random time."""
    return plans.states_at(times_of(plans, random))


def to_new_pucks(
    state: State, problem: ProblemRecord, random: np.random.Generator
) -> Boundary:
    """Return the feasible problems from states to pucks anywhere on the table."""
    q, dq, ddq = state
    count = len(q)
    goal = random.uniform(TABLE_RANGE_M[:, 0], TABLE_RANGE_M[:, 1], (count, 2))
    x, y = (goal - problem.tip_positions(q)[:, :2]).T
    tasks = {"start_q": q, "start_dq": dq, "start_ddq": ddq, "goal_xyz": goal}
    tasks["hit_angle"] = np.arctan2(y, x) + random.uniform(
        -MAX_DIRECTION_ERROR_RAD, MAX_DIRECTION_ERROR_RAD, count
    )
    share = np.where(
        random.uniform(size=count) < FULL_SPEED_FRACTION,
        1.0,
        random.uniform(1e-3, 1.0, count),
    )
    return complete("airhockey-replan", **tasks, hit_speed_share=share).plans.boundary


def to_goals(state: State, goals: Boundary) -> Boundary:
    """Return problems from states to the goals of other problems."""
    q, dq, ddq = state
    return Boundary(q, dq, ddq, goals.goal_q[: len(q)], goals.goal_dq[: len(q)])


def to_same_goals(plans: Plans, random: np.random.Generator) -> Problems:
    """Return problems from random states of plans to their own goals."""
    time = times_of(plans, random)
    return Problems(to_goals(plans.states_at(time), plans.boundary), plans, time)


def full_speed_hits(count: int, seed: int) -> Boundary:
    """Return hits of the dataset airhockey-hit, all at full speed."""
    recipe = load_dataset_recipe("airhockey-hit")
    stages = (
        replace(stage, full_speed=1.0) if isinstance(stage, HittingVelocity) else stage
        for stage in recipe.pipeline.stage
    )
    full_speed = replace(recipe, pipeline=replace(recipe.pipeline, stage=tuple(stages)))
    return draw_boundary_problems(full_speed, count, seed=seed).boundary


def sets(count: int, seed: int) -> dict[str, Problems]:
    """Make the six sets."""
    random, sampled = np.random.default_rng(seed), int(OVERSAMPLING * count)
    progress(f"{sampled} first motions")
    plans = first_motions(sampled, seed)
    other_goals = draw_boundary_problems(
        "airhockey-replan", sampled, seed=seed + 1
    ).boundary
    progress(f"{sampled // TIMES_PER_REFINED_MOTION} first motions refined")
    refined = refine_plans(plans[::TIMES_PER_REFINED_MOTION])
    executed = refined.plans[
        np.repeat(np.flatnonzero(refined.valid), TIMES_PER_REFINED_MOTION)
    ]
    problems = {
        "new puck": Problems(
            to_new_pucks(states_of(plans, random), plans.problem, random)
        ),
        "same goal": to_same_goals(plans, random),
        "near the base": Problems(
            to_goals(states_of(plans, random), full_speed_hits(sampled, seed + 2))
        ),
        "another problem's": Problems(to_goals(states_of(plans, random), other_goals)),
        "on refined plans": Problems(
            to_new_pucks(states_of(executed, random), plans.problem, random)
        ),
        "dataset rows": Problems(
            draw_boundary_problems("airhockey-replan", count, seed=seed + 3).boundary
        ),
    }
    return {
        name: problem_set[random.permutation(len(problem_set.boundary))[:count]]
        for name, problem_set in problems.items()
    }


def measure(planner: Planner, problems: Problems, refined: int) -> dict[str, float]:
    """Plan, judge and refine; if the goal is unchanged, also by ``replan``."""
    plans = planner.plan_batch(problems.boundary)
    refined_plans = refine_each(plans[:refined])
    results = figures([plans], refined_plans)
    if problems.executed is None or problems.time is None:
        return results
    replans = replanned(planner, problems, problems.executed, problems.time)
    refined_replans = [
        plan for answer in replans[:refined] for plan in refine_each(answer)
    ]
    results |= {
        f"replan, {key}": value
        for key, value in figures(replans, refined_replans).items()
        if key != "problems"
    }
    both_valid = np.array(
        [
            a.valid and b.valid
            for a, b in zip(refined_plans, refined_replans, strict=True)
        ]
    )
    best = np.array(
        [
            min(a.duration, b.duration)
            for a, b in zip(refined_plans, refined_replans, strict=True)
        ]
    )[both_valid].mean()
    replan_times, remaining = (
        durations(replans),
        problems.executed.duration - problems.time,
    )
    return (
        results
        | {
            "replan, remaining trajectories of the old plan": float(
                (np.abs(replan_times - remaining) < TIME_TOLERANCE_S).mean()
            ),
            "T / best refined of both": float(
                plans.duration[:refined][both_valid].mean() / best
            ),
            "replan, T / best refined of both": float(
                replan_times[:refined][both_valid].mean() / best
            ),
        }
        | refine_finer_knots(replans[:refined], refined_replans, plans.motion.spec)
    )


def replanned(
    planner: Planner, problems: Problems, executed: Plans, time: NDArray[np.float64]
) -> list[Plans]:
    """Replan to unchanged goals, one after the other."""
    goals = problems.boundary
    rows = (slice(i, i + 1) for i in range(len(executed)))
    return [
        planner.replan(
            executed[i], time[i], goal_q=goals.goal_q[i], goal_dq=goals.goal_dq[i]
        )
        for i in rows
    ]


def refine_finer_knots(
    plans: list[Plans], refined: list[Made], spec: TrajectorySpec
) -> dict[str, float]:
    """Refine plans that have finer knots with all of their control points; return times and gains."""
    pairs = [
        (plan, result)
        for plan, result in zip(plans, refined, strict=True)
        if plan.motion.spec != spec
    ]
    if not pairs:
        return {}
    fine_refined = [
        result
        for plan, _ in pairs
        for result in refine_each(plan, load_refiner_of(plan))
    ]
    ratio = [
        a.duration / b.duration
        for (_, a), b in zip(pairs, fine_refined, strict=True)
        if b.valid
    ]
    return {
        "replan, with finer knots": len(pairs) / len(plans),
        "replan, finer knots, refine, median ms": median(
            result.ms for _, result in pairs
        ),
        "replan, finer knots, refine with all points, median ms": median(
            result.ms for result in fine_refined
        ),
        "replan, finer knots, refined / refined with all points": float(np.mean(ratio)),
    }


def load_refiner_of(plans: Plans) -> Refiner:
    """Load a refiner that uses all control points of plans."""
    problem, robot = open_problem(plans.problem)
    return Refiner(problem, robot, spec=plans.motion.spec)


def refine_each(plans: Plans, refiner: Refiner | None = None) -> list[Made]:
    """Refine plans one by one, with one BLAS thread."""
    with one_thread():
        return make_each(plans, DEFAULT_OPTIONS, refiner)


def durations(parts: list[Plans]) -> NDArray[np.float64]:
    """Return motion times [s]."""
    return np.concatenate([plans.duration for plans in parts])


def figures(parts: list[Plans], refined: list[Made]) -> dict[str, float]:
    """Return the figures of plans; the first ones are compared with the refined plans."""
    valid, before = np.array([item.valid for item in refined]), durations(parts)
    after, ms = (
        np.array([item.duration for item in refined]),
        [item.ms for item in refined],
    )
    return {
        "problems": len(before),
        "valid, planned": float(
            np.concatenate(
                [evaluate_plans(item, workers=1).valid for item in parts]
            ).mean()
        ),
        "valid, refined": float(valid.mean()),
        "T / refined": float(
            before[: len(refined)][valid].mean() / after[valid].mean()
        ),
        "refine, median ms": median(ms),
        "refine, p95 ms": float(np.quantile(ms, 0.95)),
    }


def targets_of(name: str) -> Targets:
    """Return the targets of a set."""
    return {
        "valid, planned": (VALID_TARGETS[name], False), "valid, refined": (REFINED_VALID, False),
        "T / refined": (TIME_RATIO, True), "refine, median ms": (REFINE_MS, True),
        "refine, p95 ms": (REFINE_P95_MS, True),
    }  # fmt: skip


def rows_of(
    model: str, name: str, figures: dict[str, float], targets: Targets
) -> list[tuple[str, ...]]:
    """Return the rows of a set."""
    rows: list[tuple[str, ...]] = []
    for figure, value in figures.items():
        target, at_most = targets.get(figure.removeprefix("replan, "), (None, False))
        rows.append(
            (
                model,
                name,
                figure,
                f"{value:,.4g}",
                *verdict(value, target, at_most=at_most),
            )
        )
    return rows


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--models",
        nargs="+",
        default=["airhockey-online"],
        help="names or files of models",
    )
    parser.add_argument(
        "--sets",
        nargs="+",
        choices=VALID_TARGETS,
        default=list(VALID_TARGETS),
        metavar="SET",
        help="sets of problems",
    )
    parser.add_argument(
        "--problems", type=int, default=300, help="problems of each set"
    )
    parser.add_argument(
        "--refined", type=int, default=60, help="refined problems of each set"
    )
    parser.add_argument(
        "--seed", type=int, default=271_828_183, help="seed of the problems"
    )


def main() -> None:
    """Run the benchmark."""
    chosen = arguments(__doc__, options)
    problems = {
        name: problem_set
        for name, problem_set in sets(chosen.problems, chosen.seed).items()
        if name in chosen.sets
    }
    results: dict[str, Any] = {}
    for model in chosen.models:
        planner = Planner(model)
        for name, problem_set in problems.items():
            progress(f"{model}: {name}")
            results.setdefault(model, {})[name] = measure(
                planner, problem_set, chosen.refined
            )
    measured = (
        (model, name, figures)
        for model, by_set in results.items()
        for name, figures in by_set.items()
    )
    rows = [
        row
        for model, name, figures in measured
        for row in rows_of(model, name, figures, targets_of(name))
    ]
    head = ("planner", "problems", "figure", "value", "target", "")
    report(
        {"online_replanning": results},
        [table("online planning", head, rows, left=3)],
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
