"""Transports between any two configurations: new problems of five sets, planned and refined.

* "the dataset's": rows of heavy-object-anywhere.
* "ik from start": rows of the dataset heavy-object, whose inverse kinematics begin at the start configuration.
* "independent": problems of heavy-object-anywhere whose inverse kinematics begin at independent guesses.
* "on joint limits": the same with a joint of the start or of the goal on its limit.
* "another problem's": the goal of the next row of the dataset heavy-object, if both ends are free of collision.

No joint moves by more than 165 degrees, as in the dataset. Nothing was selected with these seeds. The clock is CPU time
with one BLAS thread. The tables have targets. "valid, T / refined" compares the plans that are valid before refining.
"object in an arm link" is the share of refined plans whose object is more than 0.1 mm inside a link of the URDF other
than those that carry it. Pinocchio and Coal measure this every 2 ms, with SciPy's splines.

With ``--again N``, N problems of each set are refined from the planner's plan and solved without initial guess. Both
results are refined once more. The table counts the plans that only the second refinement makes valid or shorter by more
than 2 %. It also counts plans that are slower by more than 2 % than the fastest of all four.

    python benchmarks/transports.py
    python benchmarks/transports.py --again 100
    python benchmarks/transports.py --problems 1000 --refined 300 --models heavy-object-anywhere heavy-object
"""

import argparse
from dataclasses import replace
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from common import arguments, progress, report, table
from numpy.typing import NDArray
from online_replanning import Targets, figures, refine_each, rows_of
from refiner_problems import Made
from scene_datasets import plan_states

import cnpgen
from cnpgen.make.complete import complete
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.recipe import DatasetRecipe, load_dataset_recipe
from cnpgen.pipelines.stages.ik import GoalIK, StartIK
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.refine.refine_plans import refine_plans, solve_plans
from cnpgen.refine.refinement import Refinement
from cnpgen.trajectory.boundary import Boundary

NEAR_GOALS, ALL_GOALS = "heavy-object", "heavy-object-anywhere"
OVERSAMPLING = 8  # problems sampled per problem of sets with exclusions
MAX_JOINT_CHANGE_RAD = np.deg2rad(165)
VALID_TARGETS = {
    "the dataset's": 0.9,
    "ik from start": 0.995,
    "independent": 0.9,
    "on joint limits": 0.9,
    "another problem's": 0.9,
}
STATE_PERIOD_S, MAX_PENETRATION_M = 2e-3, 1e-4
REFINED_VALID, TIME_RATIO, VALID_TIME_RATIO = 0.995, 1.04, 1.1  # targets
MIN_SHORTENING = 1.02


def independent(at_limit: float) -> DatasetRecipe:
    """Return the recipe of heavy-object-anywhere with independent guesses of the inverse kinematics."""
    recipe = load_dataset_recipe(ALL_GOALS)
    stages = tuple(changed(stage, at_limit) for stage in recipe.pipeline.stage)
    return replace(recipe, pipeline=replace(recipe.pipeline, stage=stages))


def changed(stage: Stage, at_limit: float) -> Stage:
    """Change stages of inverse kinematics: independent guesses, and a fraction of joints on limits."""
    if isinstance(stage, GoalIK):
        return replace(stage, at_limit=at_limit, from_start=0.0)
    return replace(stage, at_limit=at_limit) if isinstance(stage, StartIK) else stage


def on_limits(boundary: Boundary) -> NDArray[np.bool_]:
    """Return a mask of the problems with a joint on a limit at the start or at the goal."""
    robot = load_robot(cnpgen.load_problem(NEAR_GOALS))
    ends = np.concatenate([boundary.start_q, boundary.goal_q], axis=1)
    low, high = np.tile(robot.position_lower, 2), np.tile(robot.position_upper, 2)
    return np.asarray(((ends == low) | (ends == high)).any(axis=1))


def to_goals_of_others(count: int, seed: int) -> Boundary:
    """Return problems from the start of one row to the goal configuration of the next."""
    rows = draw_boundary_problems(NEAR_GOALS, OVERSAMPLING * count, seed=seed).boundary
    problems = complete(
        NEAR_GOALS, start_q=rows.start_q, goal_q=np.roll(rows.goal_q, 1, axis=0)
    ).plans.boundary
    near = (
        np.abs(problems.goal_q - problems.start_q).max(axis=1) <= MAX_JOINT_CHANGE_RAD
    )
    return problems[np.flatnonzero(near)[:count]]


def sets(count: int, seed: int) -> dict[str, Boundary]:
    """Make the five sets."""
    limits = draw_boundary_problems(
        independent(at_limit=0.5), OVERSAMPLING * count, seed=seed + 2
    ).boundary
    return {
        "the dataset's": draw_boundary_problems(
            ALL_GOALS, count, seed=seed + 4
        ).boundary,
        "ik from start": draw_boundary_problems(NEAR_GOALS, count, seed=seed).boundary,
        "independent": draw_boundary_problems(
            independent(at_limit=0.0), count, seed=seed + 1
        ).boundary,
        "on joint limits": limits[np.flatnonzero(on_limits(limits))[:count]],
        "another problem's": to_goals_of_others(count, seed + 3),
    }


def targets_of(name: str) -> Targets:
    """Return the targets of a set."""
    return {
        "valid, planned": (VALID_TARGETS[name], False),
        "valid, refined": (REFINED_VALID, False),
        "T / refined": (TIME_RATIO, True),
        "valid, T / refined": (VALID_TIME_RATIO, True),
        "object in an arm link": (0.0, True),
    }


def durations_of_valid_plans(plans: Plans, refined: list[Made]) -> dict[str, float]:
    """Compare the durations of plans that are valid before and after refining with the refined ones."""
    after = np.array([item.duration for item in refined])
    valid = evaluate_plans(plans, workers=1).valid & [item.valid for item in refined]
    before, after = plans.duration[valid], after[valid]
    return {
        "valid, T / refined": float(before.mean() / after.mean()),
        "valid, T / refined, median": float(np.median(before / after)),
    }


def in_arm_links(plans: Plans, refined: list[Made]) -> dict[str, float]:
    """Return the share of refined plans whose object is inside a link of the arm."""
    problem = cnpgen.load_problem(plans.problem.name)
    assert problem.object is not None
    touch_links, body = problem.object.touch_links, coal.Box(*problem.object.size)
    urdf = problem.urdf_path.read_text(encoding="utf-8")
    model = pin.buildModelFromXML(urdf)
    links = pin.buildGeomFromUrdfString(model, urdf, pin.COLLISION).geometryObjects
    links = [
        link for link in links if model.frames[link.parentFrame].name not in touch_links
    ]
    data, tip = model.createData(), model.getFrameId(problem.robot.tip)

    def is_inside(q: NDArray[np.float64]) -> bool:
        pin.framesForwardKinematics(model, data, q)
        place = coal.Transform3s(data.oMf[tip].rotation, data.oMf[tip].translation)
        for link in links:
            pose = data.oMi[link.parentJoint] * link.placement
            request, result = coal.DistanceRequest(True, True), coal.DistanceResult()
            shape = coal.Transform3s(pose.rotation, pose.translation)
            if (
                coal.distance(body, place, link.geometry, shape, request, result)
                < -MAX_PENETRATION_M
            ):
                return True
        return False

    attempts = [item.refined for item in refined]
    states = [
        plan_states(each.path, each.rate, plans.degree, STATE_PERIOD_S)
        for each in attempts
    ]
    return {
        "object in an arm link": float(
            np.mean([any(map(is_inside, q)) for q in states])
        )
    }


def refined_again(planner: Planner, boundary: Boundary) -> dict[str, dict[str, int]]:
    """Refine and solve, refine both results again, and count the plans that improve."""
    plans = planner.plan_batch(boundary)
    first = {
        "refined": refine_plans(plans, workers=1),
        "solved": solve_plans(plans, workers=1),
    }
    later = {
        name: refine_plans(refinement.plans, workers=1)
        for name, refinement in first.items()
    }
    min_duration = np.min(
        [
            valid_durations(refinement)
            for refinement in (*first.values(), *later.values())
        ],
        axis=0,
    )
    counts = {}
    for name, refinement in first.items():
        before, after = valid_durations(refinement), valid_durations(later[name])
        counts[name] = {
            "valid": int(refinement.valid.sum()),
            "later": int((~refinement.valid & np.isfinite(min_duration)).sum()),
            "refining again": int(
                (refinement.valid & (before > MIN_SHORTENING * after)).sum()
            ),
            "above the fastest": int(
                (refinement.valid & (before > MIN_SHORTENING * min_duration)).sum()
            ),
        }
    return counts


def valid_durations(refinement: Refinement) -> NDArray[np.float64]:
    """Return motion times [s]; inf for invalid plans."""
    return np.where(refinement.valid, refinement.plans.duration, np.inf)


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--models", nargs="+", default=[ALL_GOALS], help="names or files of models"
    )
    parser.add_argument(
        "--problems", type=int, default=300, help="problems of each set"
    )
    parser.add_argument(
        "--refined", type=int, default=60, help="refined problems of each set"
    )
    parser.add_argument(
        "--again",
        type=int,
        default=0,
        metavar="N",
        help="problems of each set that are refined twice",
    )
    parser.add_argument(
        "--sets",
        nargs="+",
        choices=VALID_TARGETS,
        default=list(VALID_TARGETS),
        metavar="SET",
    )
    parser.add_argument(
        "--seed", type=int, default=408_163_275, help="seed of the problems"
    )


def main() -> None:
    """Run the benchmark."""
    chosen = arguments(__doc__, options)
    problems, results, rows, again_rows = (
        sets(chosen.problems, chosen.seed),
        dict[str, Any](),
        [],
        [],
    )
    for model in chosen.models:
        planner = Planner(model)
        for name, boundary in ((name, problems[name]) for name in chosen.sets):
            progress(f"{model}: {name}")
            plans = planner.plan_batch(boundary)
            refined = refine_each(plans[: chosen.refined])
            figures_of_set = figures([plans], refined) | durations_of_valid_plans(
                plans[: chosen.refined], refined
            )
            figures_of_set |= in_arm_links(plans, refined)
            results.setdefault(model, {})[name] = figures_of_set
            rows += rows_of(model, name, figures_of_set, targets_of(name))
            if chosen.again:
                again = refined_again(planner, boundary[: chosen.again])
                results[model][name] = {**figures_of_set, "again": again}
                again_rows += [
                    (model, name, source, *map(str, counts.values()))
                    for source, counts in again.items()
                ]
    tables = [
        table(
            "transports",
            ("planner", "problems", "figure", "value", "target", ""),
            rows,
            left=3,
        )
    ]
    if again_rows:
        head = (
            "planner", "problems", "plans", "valid", "valid later", "2 % shorter if refined again",
            "2 % above the fastest",
        )  # fmt: skip
        tables.append(
            table(
                f"{chosen.again} problems of each set, refined again",
                head,
                again_rows,
                left=3,
            )
        )
    report({"transports": results}, tables, as_json=chosen.json)


if __name__ == "__main__":
    main()
