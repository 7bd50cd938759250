"""Planners that see the scene: validity of their plans in unseen scenes.

The problems are those of a family, or of a suite, whose straight line collides. The figures are the validity of the
plans alone, after refining without another initial guess, and of ``solve``, with CPU times. The verdict is the
independent one.
"""

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, progress, report, table
from numpy.typing import NDArray
from scenes import make_checker

from cnpgen.addons.families.scene_generator import shipped_families
from cnpgen.kernels.collision.collision_checker import CollisionChecker
from cnpgen.machine.threads import one_thread
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_record import as_problem
from cnpgen.refine.options import DEFAULT_OPTIONS
from cnpgen.refine.refine_engine import refine_serially
from cnpgen.refine.task import Attempt, Outcome
from cnpgen.robots.solid import place_obstacles
from cnpgen.scenes import SceneProblem, load_scenes, make_scenes, plan_scenes

Array = NDArray[np.float64]

DEFAULT_FAMILIES = ("tabletop", "table-pick")
LINE_SPACING_RAD = 0.05


def is_line_clear(checker: CollisionChecker, start: Array, goal: Array) -> bool:
    """Return whether the straight line between two states is free of collisions."""
    count = int(np.ceil(np.abs(goal - start).max() / LINE_SPACING_RAD)) + 2
    return bool(checker.clear_states(np.linspace(start, goal, count).T.copy()).all())


def colliding_lines(problem: str, scenes: Sequence[SceneProblem]) -> list[SceneProblem]:
    """Return the scenes whose straight line collides."""
    robot_problem, chosen = as_problem(problem), []
    checker = make_checker(robot_problem, load_robot(robot_problem))
    for scene in scenes:
        checker.place(scene.obstacles, place_obstacles(scene.obstacles))
        if not is_line_clear(checker, scene.start_q, scene.goal_q[0]):
            chosen.append(scene)
    return chosen


def refined(plans: Plans) -> tuple[list[Attempt], Array]:
    """Refine plans one by one; return the results and their CPU times [s], shape (N,)."""
    results, times = list[Attempt](), list[float]()
    for index in range(len(plans)):
        begun = time.process_time()
        results += refine_serially(plans[index : index + 1], DEFAULT_OPTIONS)
        times.append(time.process_time() - begun)
    return results, np.array(times)


def without_motions(plans: Plans) -> Plans:
    """Return the boundary problems of plans, without motions."""
    return replace(
        plans,
        path_control_points=np.full_like(plans.path_control_points, np.nan),
        rate_control_points=np.full_like(plans.rate_control_points, np.nan),
    )


def fitting(planner: Planner, scenes: Sequence[SceneProblem]) -> list[SceneProblem]:
    """Return the scenes with at most as many obstacles of each kind as the problem of the planner's model."""
    most = Counter(
        obstacle.kind for obstacle in as_problem(planner.model.problem).obstacle
    )
    return [
        scene
        for scene in scenes
        if Counter(obstacle.kind for obstacle in scene.obstacles) <= most
    ]


def measure(
    models: Sequence[str],
    robot: str,
    family: str,
    scenes: Sequence[SceneProblem],
    *,
    refining: bool,
) -> list[dict[str, Any]]:
    """Return the figures of models for the scenes of one family; with ``refining`` also those of ``solve``."""
    planners = [
        Planner(name if not Path(name).exists() else Path(name)) for name in models
    ]
    scenes = fitting(planners[0], colliding_lines(robot, scenes))
    if not scenes:
        return []
    results, solved = [], None
    for name, planner in zip(models, planners, strict=True):
        plan_scenes(planner, scenes[:2])
        begun = time.process_time()
        plans = plan_scenes(planner, scenes)
        planning = (time.process_time() - begun) / len(scenes)
        alone = evaluate_plans(plans, workers=1).summary()
        facts = {"family": family, "model": Path(name).stem, "problems": len(scenes)}
        facts |= {"alone": alone["valid_ratio"], "planning cpu [s]": planning}
        if not refining:
            results.append(facts)
            continue
        if solved is None:
            refine_serially(without_motions(plans[:2]), DEFAULT_OPTIONS)
            progress(f"{family}: solve")
            solved = refined(without_motions(plans))
        progress(f"{family}: refine plans of {name}")
        attempts, cpu = refined(plans)
        valid = np.array([each.valid for each in attempts])
        own = np.array([each.outcome is not Outcome.RESTARTED for each in attempts])
        results.append(
            facts
            | {
                "refined": float((valid & own).mean()),
                "refined, other guesses too": float(valid.mean()),
                "refining cpu [s]": float(cpu.mean()),
                "solve": float(np.mean([each.valid for each in solved[0]])),
                "solve cpu [s]": float(solved[1].mean()),
                "refine / solve, medians": float(np.median(cpu) / np.median(solved[1])),
                "motion time": float(
                    np.median(plans.duration / [each.cost for each in attempts])
                ),
            }
        )
    return results


def cell(facts: dict[str, Any], key: str) -> str:
    """Return a share, or a time in ms; empty if it was not measured."""
    if key not in facts:
        return ""
    return f"{1e3 * facts[key]:.2f} ms" if key.endswith("[s]") else f"{facts[key]:.3f}"


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "models",
        nargs="+",
        help="models by name or file, of scenes with equal capacity",
    )
    parser.add_argument("--robot", default="panda-3kg", help="problem of a robot")
    parser.add_argument(
        "--families",
        nargs="*",
        choices=list(shipped_families()),
        help="families of scenes",
    )
    parser.add_argument(
        "--seed", type=int, default=29_400_001, help="seed of the scenes"
    )
    parser.add_argument(
        "--suite",
        type=Path,
        help="file of test problems, such as datasets/suites/clutter.h5",
    )
    parser.add_argument(
        "--alone", action="store_true", help="measure the plans alone, without refining"
    )
    parser.add_argument(
        "--count",
        type=int,
        default=100,
        help="test problems of every family, before the selection",
    )


def main() -> None:
    """Run the benchmark."""
    chosen = arguments(__doc__, options)
    results = []
    with one_thread(), np.errstate(all="ignore"):
        for family in chosen.families or DEFAULT_FAMILIES:
            progress(family)
            if chosen.suite is None:
                scenes = make_scenes(
                    family, chosen.robot, chosen.count, seed=chosen.seed, per_scene=2
                )
            else:
                scenes = [
                    scene
                    for scene in load_scenes(chosen.suite)
                    if scene.name.rsplit(" ", 2)[0] == family
                ]
            results += measure(
                chosen.models, chosen.robot, family, scenes, refining=not chosen.alone
            )
    shares = ("alone", "refined", "with others", "solve")
    head = (
        "family",
        "model",
        "problems",
        *shares,
        "cpu: plan",
        "refine",
        "solve",
        "refine / solve, medians",
    )
    rows = [
        (
            each["family"],
            each["model"],
            f"{each['problems']}",
            *(
                cell(each, key)
                for key in ("alone", "refined", "refined, other guesses too", "solve")
            ),
            *(
                cell(each, key)
                for key in (
                    "planning cpu [s]",
                    "refining cpu [s]",
                    "solve cpu [s]",
                    "refine / solve, medians",
                )
            ),
        )
        for each in results
    ]
    report(
        {"planners": results},
        [table("unseen scenes, straight line collides", head, rows, left=2)],
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
