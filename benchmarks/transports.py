"""Transports between any two configurations: fresh problems of four sets, planned alone and refined.

* "found from the start": rows of the dataset heavy-object, whose goal configuration is the one that inverse kinematics
  finds from the start;
* "independent": as the dataset heavy-object-anywhere draws them, but all goals are found from guesses of their own;
* "on joint limits": the same with a joint of the start or of the goal on its limit;
* "another problem's": the goal of the next row of the dataset heavy-object, where both ends are free of collision.

No joint is farther from start to goal than 165 degrees, as in the dataset. Nothing was chosen by these seeds. The clock
is CPU time, one BLAS thread. Goals stand beside the figures.

With ``--again N``, N problems of each set are refined from the planner's plan and solved from nothing, and both results
refined once more, to see what the first one left: how many are valid later only, how many become shorter by more than
2 %, and how many take so much longer than the fastest of all four.

    python benchmarks/transports.py
    python benchmarks/transports.py --again 100
    python benchmarks/transports.py --problems 1000 --refined 300 --models heavy-object-anywhere heavy-object
"""

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from common import arguments, progress, report, table
from numpy.typing import NDArray
from online_replanning import Goals, figures, refine_each, rows_of

import cnpgen
from cnpgen.make.complete import complete
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.make.recipe_file import load_dataset_recipe
from cnpgen.pipelines.stages.ik import GoalIK, StartIK
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.planner.planner import Planner
from cnpgen.problems.load_robot import load_robot
from cnpgen.refine.refine_plans import Refinement, refine_plans, solve_plans
from cnpgen.trajectory.boundary import Boundary

OLD, NEW = "heavy-object", "heavy-object-anywhere"
OVERSAMPLING = 8  # drawn for each that is wanted of sets of which some are left out
MAX_JOINT_CHANGE_RAD = np.deg2rad(165)
GOALS = {"found from the start": 0.995, "independent": 0.9, "on joint limits": 0.9, "another problem's": 0.9}
REFINED_VALID, OVER_REFINED = 0.995, 1.04
SHORTER = 1.02


def independent(at_limit: float) -> DatasetRecipe:
    """Return the new dataset's recipe, no goal of which is found from the start."""
    recipe = load_dataset_recipe(NEW)
    stages = tuple(changed(stage, at_limit) for stage in recipe.pipeline.stage)
    return replace(recipe, pipeline=replace(recipe.pipeline, stage=stages))


def changed(stage: Stage, at_limit: float) -> Stage:
    """Make stages that have guesses use them always, with so many joints on limits."""
    if isinstance(stage, GoalIK):
        return replace(stage, at_limit=at_limit, from_start=0.0)
    return replace(stage, at_limit=at_limit) if isinstance(stage, StartIK) else stage


def on_limits(boundary: Boundary) -> NDArray[np.bool_]:
    """Say which problems have a joint on a limit at the start or at the goal."""
    robot = load_robot(cnpgen.load_problem(OLD))
    ends = np.concatenate([boundary.start_q, boundary.goal_q], axis=1)
    low, high = np.tile(robot.position_lower, 2), np.tile(robot.position_upper, 2)
    return np.asarray(((ends == low) | (ends == high)).any(axis=1))


def to_goals_of_others(count: int, seed: int) -> Boundary:
    """Problems from the start of one row to the goal configuration of the next."""
    rows = draw_boundary_problems(OLD, OVERSAMPLING * count, seed=seed).boundary
    found = complete(OLD, start_q=rows.start_q, goal_q=np.roll(rows.goal_q, 1, axis=0)).plans.boundary
    near = np.abs(found.goal_q - found.start_q).max(axis=1) <= MAX_JOINT_CHANGE_RAD
    return found[np.flatnonzero(near)[:count]]


def sets(count: int, seed: int) -> dict[str, Boundary]:
    """Make the four sets."""
    limits = draw_boundary_problems(independent(at_limit=0.5), OVERSAMPLING * count, seed=seed + 2).boundary
    return {
        "found from the start": draw_boundary_problems(OLD, count, seed=seed).boundary,
        "independent": draw_boundary_problems(independent(at_limit=0.0), count, seed=seed + 1).boundary,
        "on joint limits": limits[np.flatnonzero(on_limits(limits))[:count]],
        "another problem's": to_goals_of_others(count, seed + 3),
    }


def goals_of(name: str) -> Goals:
    """Say what is wanted of a set."""
    return {
        "valid alone": (GOALS[name], False),
        "valid refined": (REFINED_VALID, False),
        "T / refined": (OVER_REFINED, True),
    }


def refined_again(planner: Planner, boundary: Boundary) -> dict[str, dict[str, int]]:
    """Refine and solve, refine the results, and count what that makes shorter."""
    plans = planner.plan_batch(boundary)
    first = {"refined": refine_plans(plans, workers=1), "solved": solve_plans(plans, workers=1)}
    later = {name: refine_plans(each.plans, workers=1) for name, each in first.items()}
    min_duration = np.min([valid_durations(each) for each in (*first.values(), *later.values())], axis=0)
    found = {}
    for name, each in first.items():
        mine, then = valid_durations(each), valid_durations(later[name])
        found[name] = {
            "valid": int(each.valid.sum()),
            "later": int((~each.valid & np.isfinite(min_duration)).sum()),
            "refining again": int((each.valid & (mine > SHORTER * then)).sum()),
            "than any other": int((each.valid & (mine > SHORTER * min_duration)).sum()),
        }
    return found


def valid_durations(found: Refinement) -> NDArray[np.float64]:
    """Motion times [s], inf where a plan is not valid."""
    return np.where(found.valid, found.plans.duration, np.inf)


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--models", nargs="+", default=[NEW], help="shipped ones or files")
    parser.add_argument("--problems", type=int, default=300, help="of each set")
    parser.add_argument("--refined", type=int, default=60, help="how many of them are refined")
    parser.add_argument("--again", type=int, default=0, metavar="N", help="how many of them are refined twice")
    parser.add_argument("--seed", type=int, default=408_163_275, help="of the problems")


def main() -> None:
    """Run."""
    chosen = arguments(__doc__, options)
    problems, results, rows, twice = sets(chosen.problems, chosen.seed), dict[str, Any](), [], []
    for model in chosen.models:
        planner = Planner(model)
        for name, boundary in problems.items():
            progress(f"{model}: {name}")
            plans = planner.plan_batch(boundary)
            found = figures([plans], refine_each(plans[: chosen.refined]))
            results.setdefault(model, {})[name] = found
            rows += rows_of(model, name, found, goals_of(name))
            if chosen.again:
                again = refined_again(planner, boundary[: chosen.again])
                results[model][name] = {**found, "again": again}
                twice += [(model, name, how, *map(str, each.values())) for how, each in again.items()]
    tables = [table("transports", ("planner", "problems", "figure", "value", "goal", ""), rows, left=3)]
    if twice:
        head = ("planner", "problems", "plans", "valid", "later", "2 % shorter by refining again", "than any other")
        tables.append(table(f"{chosen.again} of them refined again", head, twice, left=3))
    report({"transports": results}, tables, as_json=chosen.json)


if __name__ == "__main__":
    main()
