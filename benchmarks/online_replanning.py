"""Planning online: fresh problems that start on motions which are being executed, set by set.

First motions are valid plans of the shipped planners for hits and replans; new problems start on them at a time
between 0.05 and 0.95 of their time T, where they are, off the table by what plans are:

* "new puck": to a new puck, anywhere on the table, in a direction within 120 degrees of the way to it, at full speed in
  a fifth of the cases; the goal configuration is chosen close to where the arm is;
* "same goal": to the goal of the motion; as the network plans it, and as ``replan`` answers, which keeps the rest of
  the motion where the network is not faster by 2 %; where that has finer knots, also refined with all of them;
* "near the base": to goals of the dataset airhockey-hit at full speed, chosen close to the base configuration;
* "another problem's": to goals of the dataset airhockey-replan, chosen close to other starts;
* "on refined plans": as "new puck", from motions that were refined before they were executed;
* "today's rows": rows of the dataset airhockey-replan.

Nothing was chosen by these seeds. The clock is CPU time, one BLAS thread. Goals stand beside the figures.

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
from cnpgen.make.recipe_file import load_dataset_recipe
from cnpgen.pipelines.stages.hitting_velocity import HittingVelocity
from cnpgen.planner.planner import Planner
from cnpgen.plans.concatenate import concatenate
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.refine.options import DEFAULT_OPTIONS
from cnpgen.refine.refine_engine import load_refiner
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.refine.refiner import Refiner
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

FIRST = ("airhockey-replan", "airhockey-hit")  # datasets and planners of the first motions
SWITCH_RANGE = (0.05, 0.95)  # of T
REFINED_TIMES = 4  # on every refined motion
OVERSAMPLING = (
    1.25  # problems drawn for each that is wanted: some first motions are not valid, some tasks have no answer
)
TIME_TOLERANCE_S = 1e-9  # s: of the rest of a plan, by rounding
FULL_SPEED = 0.2
CONE = np.deg2rad(120)
TABLE = np.array([[0.6, 1.3], [-0.45, 0.45]])  # m
GOALS = {  # share of valid plans, as the network gives them
    "new puck": 0.97, "same goal": 0.96, "near the base": 0.95, "another problem's": 0.95, "on refined plans": 0.95,
    "today's rows": 0.96,
}  # fmt: skip
REFINED_VALID, OVER_REFINED, REFINE_MS, REFINE_P95_MS = 0.998, 1.08, 8.0, 15.0

State = tuple[Any, Any, Any]
Goals = dict[str, tuple[float, bool]]  # figure -> its goal, and whether that is the most rather than the least


@dataclass(frozen=True)
class Problems:
    """N problems.

    Attributes:
        boundary: Their boundary conditions.
        executed: The motions that they begin on, where these go to the same goals; else None.
        time: Since when these are executed [s], shape (N,).
    """

    boundary: Boundary
    executed: Plans | None = None
    time: NDArray[np.float64] | None = None

    def __getitem__(self, rows: NDArray[np.int64]) -> "Problems":
        executed = None if self.executed is None else self.executed[rows]
        return Problems(self.boundary[rows], executed, None if self.time is None else self.time[rows])


def first_motions(count: int, seed: int) -> Plans:
    """Valid plans of the shipped planners, half for replans and half for hits."""
    parts = []
    for name in FIRST:
        plans = Planner(name).plan_batch(
            draw_boundary_problems(name, int(OVERSAMPLING * count / 2), seed=seed).boundary
        )
        parts.append(plans[evaluate_plans(plans).valid][: count // 2])
    return concatenate(parts)


def times_of(plans: Plans, random: np.random.Generator) -> NDArray[np.float64]:
    """One random time of every plan."""
    return random.uniform(*SWITCH_RANGE, len(plans)) * plans.duration


def states_of(plans: Plans, random: np.random.Generator) -> State:
    """Return the state of every plan at a random time."""
    return plans.states_at(times_of(plans, random))


def to_new_pucks(state: State, problem: ProblemRecord, random: np.random.Generator) -> Boundary:
    """Problems from states to pucks anywhere, those that have an answer."""
    q, dq, ddq = state
    count = len(q)
    goal = random.uniform(TABLE[:, 0], TABLE[:, 1], (count, 2))
    x, y = (goal - problem.tip_positions(q)[:, :2]).T
    asked = {"start_q": q, "start_dq": dq, "start_ddq": ddq, "goal_xyz": goal}
    asked["hit_angle"] = np.arctan2(y, x) + random.uniform(-CONE, CONE, count)
    share = np.where(random.uniform(size=count) < FULL_SPEED, 1.0, random.uniform(1e-3, 1.0, count))
    return complete("airhockey-replan", **asked, hit_speed_share=share).plans.boundary


def to_goals(state: State, goals: Boundary) -> Boundary:
    """Problems from states to the goals of others."""
    q, dq, ddq = state
    return Boundary(q, dq, ddq, goals.goal_q[: len(q)], goals.goal_dq[: len(q)])


def to_same_goals(plans: Plans, random: np.random.Generator) -> Problems:
    """Problems from times of plans to their own goals."""
    time = times_of(plans, random)
    return Problems(to_goals(plans.states_at(time), plans.boundary), plans, time)


def full_speed_hits(count: int, seed: int) -> Boundary:
    """Hits of the dataset airhockey-hit, all of them at full speed."""
    recipe = load_dataset_recipe("airhockey-hit")
    stages = (
        replace(each, full_speed=1.0) if isinstance(each, HittingVelocity) else each for each in recipe.pipeline.stage
    )
    fast = replace(recipe, pipeline=replace(recipe.pipeline, stage=tuple(stages)))
    return draw_boundary_problems(fast, count, seed=seed).boundary


def sets(count: int, seed: int) -> dict[str, Problems]:
    """Make the six sets."""
    random, drawn = np.random.default_rng(seed), int(OVERSAMPLING * count)
    progress(f"{drawn} first motions")
    plans = first_motions(drawn, seed)
    others = draw_boundary_problems("airhockey-replan", drawn, seed=seed + 1).boundary
    progress(f"{drawn // REFINED_TIMES} first motions refined")
    refined = refine_plans(plans[::REFINED_TIMES])
    executed = refined.plans[np.repeat(np.flatnonzero(refined.valid), REFINED_TIMES)]
    found = {
        "new puck": Problems(to_new_pucks(states_of(plans, random), plans.problem, random)),
        "same goal": to_same_goals(plans, random),
        "near the base": Problems(to_goals(states_of(plans, random), full_speed_hits(drawn, seed + 2))),
        "another problem's": Problems(to_goals(states_of(plans, random), others)),
        "on refined plans": Problems(to_new_pucks(states_of(executed, random), plans.problem, random)),
        "today's rows": Problems(draw_boundary_problems("airhockey-replan", count, seed=seed + 3).boundary),
    }
    return {name: each[random.permutation(len(each.boundary))[:count]] for name, each in found.items()}


def measure(planner: Planner, problems: Problems, refined: int) -> dict[str, float]:
    """Plan, judge, refine some; also what replanning answers where the goal has not moved."""
    plans = planner.plan_batch(problems.boundary)
    made = refine_each(plans[:refined])
    found = figures([plans], made)
    if problems.executed is None or problems.time is None:
        return found
    answers = replanned(planner, problems, problems.executed, problems.time)
    others = [each for answer in answers[:refined] for each in refine_each(answer)]
    found |= {f"replan, {what}": value for what, value in figures(answers, others).items() if what != "problems"}
    good = np.array([one.valid and other.valid for one, other in zip(made, others, strict=True)])
    best = np.array([min(one.duration, other.duration) for one, other in zip(made, others, strict=True)])[good].mean()
    given, left = durations(answers), problems.executed.duration - problems.time
    return (
        found
        | {
            "replan, rests of the old plan": float((np.abs(given - left) < TIME_TOLERANCE_S).mean()),
            "T / best refined of both": float(plans.duration[:refined][good].mean() / best),
            "replan, T / best refined of both": float(given[:refined][good].mean() / best),
        }
        | finely(answers[:refined], others, plans.motion.spec)
    )


def replanned(planner: Planner, problems: Problems, executed: Plans, time: NDArray[np.float64]) -> list[Plans]:
    """Replan to goals that have not moved, one after the other, as a robot does."""
    goals = problems.boundary
    rows = (slice(i, i + 1) for i in range(len(executed)))
    return [planner.replan(executed[i], time[i], goal_q=goals.goal_q[i], goal_dq=goals.goal_dq[i]) for i in rows]


def finely(plans: list[Plans], usual: list[Made], spec: TrajectorySpec) -> dict[str, float]:
    """Refine plans with finer knots with all of their control points, and say what that takes and gains."""
    pairs = [(each, made) for each, made in zip(plans, usual, strict=True) if each.motion.spec != spec]
    if not pairs:
        return {}
    fine = [made for each, _ in pairs for made in refine_each(each, load_refiner_of(each))]
    ratio = [one.duration / other.duration for (_, one), other in zip(pairs, fine, strict=True) if other.valid]
    return {
        "replan, with finer knots": len(pairs) / len(plans),
        "replan, finer knots, refine, median ms": median(made.ms for _, made in pairs),
        "replan, finer knots, refine with all of them, median ms": median(made.ms for made in fine),
        "replan, finer knots, refined / refined with all of them": float(np.mean(ratio)),
    }


def load_refiner_of(plans: Plans) -> Refiner:
    """Load a refiner that uses all control points of plans."""
    problem, robot = open_problem(plans.problem)
    return load_refiner(problem, robot, spec=plans.motion.spec)


def refine_each(plans: Plans, refiner: Refiner | None = None) -> list[Made]:
    """Refine plans one by one, with one BLAS thread."""
    with one_thread():
        return make_each(plans, DEFAULT_OPTIONS, refiner)


def durations(parts: list[Plans]) -> NDArray[np.float64]:
    """Motion times [s]."""
    return np.concatenate([each.duration for each in parts])


def figures(parts: list[Plans], made: list[Made]) -> dict[str, float]:
    """Say how good plans are, and the first of them beside what was refined from them."""
    good, given = np.array([each.valid for each in made]), durations(parts)
    after, ms = np.array([each.duration for each in made]), [each.ms for each in made]
    return {
        "problems": len(given),
        "valid alone": float(np.concatenate([evaluate_plans(each, workers=1).valid for each in parts]).mean()),
        "valid refined": float(good.mean()),
        "T / refined": float(given[: len(made)][good].mean() / after[good].mean()),
        "refine, median ms": median(ms),
        "refine, p95 ms": float(np.quantile(ms, 0.95)),
    }


def goals_of(name: str) -> Goals:
    """Say what is wanted of a set."""
    return {
        "valid alone": (GOALS[name], False), "valid refined": (REFINED_VALID, False),
        "T / refined": (OVER_REFINED, True), "refine, median ms": (REFINE_MS, True),
        "refine, p95 ms": (REFINE_P95_MS, True),
    }  # fmt: skip


def rows_of(model: str, name: str, found: dict[str, float], goals: Goals) -> list[tuple[str, ...]]:
    """Lay out what was found of a set, each figure beside its goal."""
    rows: list[tuple[str, ...]] = []
    for what, value in found.items():
        goal, at_most = goals.get(what.removeprefix("replan, "), (None, False))
        rows.append((model, name, what, f"{value:,.4g}", *verdict(value, goal, at_most=at_most)))
    return rows


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--models", nargs="+", default=["airhockey-online"], help="shipped ones or files")
    parser.add_argument(
        "--sets", nargs="+", choices=GOALS, default=list(GOALS), metavar="SET", help="which are measured"
    )
    parser.add_argument("--problems", type=int, default=300, help="of each set")
    parser.add_argument("--refined", type=int, default=60, help="how many of them are refined")
    parser.add_argument("--seed", type=int, default=271_828_183, help="of the problems")


def main() -> None:
    """Run."""
    chosen = arguments(__doc__, options)
    problems = {name: each for name, each in sets(chosen.problems, chosen.seed).items() if name in chosen.sets}
    results: dict[str, Any] = {}
    for model in chosen.models:
        planner = Planner(model)
        for name, each in problems.items():
            progress(f"{model}: {name}")
            results.setdefault(model, {})[name] = measure(planner, each, chosen.refined)
    every = ((model, name, found) for model, by_set in results.items() for name, found in by_set.items())
    rows = [row for model, name, found in every for row in rows_of(model, name, found, goals_of(name))]
    head = ("planner", "problems", "figure", "value", "goal", "")
    report({"online_replanning": results}, [table("planning online", head, rows, left=3)], as_json=chosen.json)


if __name__ == "__main__":
    main()
