"""A planner that sees the scene: training problems in random scenes, and its validity in unseen ones.

``make`` writes training problems of families with tables to a scene file. States are drawn once, and every scene uses
those near its grasps that are free of collisions. This is faster than ``cnpgen make-scenes``, which makes the test
problems. ``measure`` counts over test problems whose straight line collides: validity of the plans alone, after
refining without another initial guess, and of ``solve``, with CPU times. The verdict is the independent one.
"""

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, progress, report, table
from numpy.typing import NDArray

from cnpgen.kernels.collision.collision_checker import CollisionChecker, load_collision_library
from cnpgen.kernels.library import KernelLibrary, choose_backend
from cnpgen.machine.threads import one_thread
from cnpgen.pipelines.families.catalog import FAMILIES, load_family
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_record import as_problem
from cnpgen.refine.options import DEFAULT_OPTIONS
from cnpgen.refine.refine_engine import refine_serially
from cnpgen.refine.task import Attempt, Outcome
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import place_obstacles
from cnpgen.scenes import SceneError, SceneProblem, load_scenes, make_scenes, plan_scenes, save_scenes

Array = NDArray[np.float64]

BANK_STATES = 1_000_000  # random states, of which some per cent point down
MAX_TILT_COSINE = -0.87  # of the tip's z axis with the world's
GRASP_DISTANCE_M = 0.06
LINE_SPACING_RAD = 0.05
STRAIGHT_SHARE = 0.15  # of the training problems that may be solved by a straight line
STARTS = ("neutral", "grasp", "random")
START_SHARES = (0.4, 0.4, 0.2)


def make_checker(robot: Robot) -> CollisionChecker:
    """Return the compiled collision checks of a robot."""
    library = load_collision_library(KernelLibrary(*choose_backend("compiled"), "", {}))
    assert library is not None
    return CollisionChecker(library, robot)


def is_line_clear(checker: CollisionChecker, start: Array, goal: Array) -> bool:
    """Return whether the straight line between two states is free of collisions."""
    count = int(np.ceil(np.abs(goal - start).max() / LINE_SPACING_RAD)) + 2
    return bool(checker.clear_states(np.linspace(start, goal, count).T.copy()).all())


class TrainingProblems:
    """Generator of training problems of a robot.

    Args:
        robot: The robot, with link geometry.
        random: Random numbers.
    """

    def __init__(self, robot: Robot, random: np.random.Generator) -> None:
        self.robot, self.random, self.checker = robot, random, make_checker(robot)
        self.any_states = self._clear(self._uniform(20_000), of_obstacles=False)
        self.down, self.tips = self._states_pointing_down()

    def _uniform(self, count: int) -> Array:
        return self.random.uniform(self.robot.position_lower, self.robot.position_upper, (count, self.robot.n))

    def _clear(self, states: Array, *, of_obstacles: bool = True) -> Array:
        distance = 0.005 if of_obstacles else None
        clear = self.checker.clear_states(states.T, obstacle_distance=distance, self_distance=0.0)
        return np.asarray(states[clear])

    def _states_pointing_down(self) -> tuple[Array, Array]:
        states, tips, chain = list[Array](), list[Array](), self.robot.chain
        for _ in range(BANK_STATES // 50_000):
            q = self._uniform(50_000)
            poses = self.checker.joint_poses(q.T)[:, -1]
            rotations = poses[:, :9].reshape(-1, 3, 3)
            tip = rotations @ chain.tip_translation + poses[:, 9:]
            down = (rotations @ chain.tip_rotation)[:, 2, 2] < MAX_TILT_COSINE
            down &= (tip[:, 2] > 0) & (tip[:, 2] < 0.8) & (np.hypot(tip[:, 0], tip[:, 1]) < 0.9)
            clear = self.checker.clear_states(q[down].T, obstacle_distance=None, self_distance=0.0)
            states.append(q[down][clear])
            tips.append(tip[down][clear])
        return np.concatenate(states), np.concatenate(tips)

    def problems(self, family: str, index: int, count: int) -> Iterator[SceneProblem]:
        """Yield up to ``count`` problems in one scene."""
        layout = load_family(family).draw(self.random)
        self.checker.place(layout.obstacles, place_obstacles(layout.obstacles))
        grasps = [states for grasp in layout.grasps if len(states := self._near(grasp.position))]
        starts = {
            "neutral": self._clear(self.robot.base + 0.1 * self.random.standard_normal((32, self.robot.n))),
            "random": self._clear(self.any_states[self.random.integers(len(self.any_states), size=64)]),
        }
        made = 0
        for _ in range(4 * count if grasps else 0):
            target = int(self.random.integers(len(grasps)))
            others = [states for i, states in enumerate(grasps) if i != target]
            chosen = starts | {"grasp": np.concatenate(others) if others else np.empty((0, self.robot.n))}
            states = chosen[str(self.random.choice(STARTS, p=START_SHARES))]
            if len(states) == 0 or made == count:
                continue
            start, goal = (each[self.random.integers(len(each))] for each in (states, grasps[target]))
            if self.random.random() > STRAIGHT_SHARE and is_line_clear(self.checker, start, goal):
                continue
            made += 1
            yield SceneProblem(
                name=f"{family} {index} {made}",
                obstacles=layout.obstacles,
                start_q=start,
                goal_q=goal[None],
                joint_names=self.robot.joint_names,
            )

    def _near(self, position: Array) -> Array:
        near = np.flatnonzero(((self.tips - position) ** 2).sum(axis=1) < GRASP_DISTANCE_M**2)
        return self._clear(self.down[self.random.permutation(near)[:40]])


def make(robot: str, families: Sequence[str], scenes: int, per_scene: int, seed: int) -> list[SceneProblem]:
    """Return training problems; families alternate."""
    generator = TrainingProblems(load_robot(as_problem(robot)), np.random.default_rng(seed))
    problems = list[SceneProblem]()
    for index in range(scenes):
        try:
            problems += generator.problems(families[index % len(families)], index, per_scene)
        except SceneError:
            continue
    return problems


def colliding_lines(problem: str, scenes: Sequence[SceneProblem]) -> list[SceneProblem]:
    """Return the scenes whose straight line collides."""
    checker, chosen = make_checker(load_robot(as_problem(problem))), []
    for scene in scenes:
        checker.place(scene.obstacles, place_obstacles(scene.obstacles))
        if not is_line_clear(checker, scene.start_q, scene.goal_q[0]):
            chosen.append(scene)
    return chosen


def refined(plans: Plans) -> tuple[list[Attempt], float]:
    """Refine plans one by one; return the results and the CPU time of each [s]."""
    begun = time.process_time()
    results = refine_serially(plans, DEFAULT_OPTIONS)
    return results, (time.process_time() - begun) / len(plans)


def without_motions(plans: Plans) -> Plans:
    """Return the boundary problems of plans, without motions."""
    return replace(
        plans,
        path_control_points=np.full_like(plans.path_control_points, np.nan),
        rate_control_points=np.full_like(plans.rate_control_points, np.nan),
    )


def fitting(planner: Planner, scenes: Sequence[SceneProblem]) -> list[SceneProblem]:
    """Return the scenes with at most as many obstacles of each kind as the problem of the planner's model."""
    with planner.model.problem.restored() as problem:
        most = Counter(obstacle.kind for obstacle in problem.obstacle)
    return [scene for scene in scenes if Counter(obstacle.kind for obstacle in scene.obstacles) <= most]


def measure(
    models: Sequence[str], robot: str, family: str, scenes: Sequence[SceneProblem], *, refining: bool
) -> list[dict[str, Any]]:
    """Return the figures of models for the scenes of one family; with ``refining`` also those of ``solve``."""
    planners = [Planner(name if not Path(name).exists() else Path(name)) for name in models]
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
                "refining cpu [s]": cpu,
                "solve": float(np.mean([each.valid for each in solved[0]])),
                "solve cpu [s]": solved[1],
                "motion time": float(np.median(plans.duration / [each.cost for each in attempts])),
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
    parser.add_argument("what", choices=("make", "measure"), help="make training problems, or measure models")
    parser.add_argument("--robot", default="panda", help="problem of a robot")
    parser.add_argument("--families", nargs="*", choices=list(FAMILIES), help="families of scenes")
    parser.add_argument("--seed", type=int, default=29_400_001, help="seed of the scenes")
    parser.add_argument("--scenes", type=int, default=2400, help="number of training scenes")
    parser.add_argument("--per-scene", type=int, default=8, help="largest number of training problems in one scene")
    parser.add_argument("--out", type=Path, default=Path("training-scenes.h5"), help="file of the training problems")
    parser.add_argument("--models", nargs="*", default=[], help="models by name or file, of scenes with equal capacity")
    parser.add_argument("--suite", type=Path, help="file of test problems, such as datasets/suites/clutter.h5")
    parser.add_argument("--alone", action="store_true", help="measure the plans alone, without refining")
    parser.add_argument("--count", type=int, default=100, help="test problems of every family, before the selection")


def main() -> None:
    """Run the benchmark."""
    chosen = arguments(__doc__, options)
    families = chosen.families or ["tabletop", "table-pick"]
    if chosen.what == "make":
        problems = make(chosen.robot, families, chosen.scenes, chosen.per_scene, chosen.seed)
        save_scenes(chosen.out, problems)
        print(f"{len(problems)} problems in {chosen.out}")
        return
    results = []
    with one_thread(), np.errstate(all="ignore"):
        for family in families:
            progress(family)
            if chosen.suite is None:
                scenes = make_scenes(family, chosen.robot, chosen.count, seed=chosen.seed, per_scene=2)
            else:
                scenes = [scene for scene in load_scenes(chosen.suite) if scene.name.rsplit(" ", 2)[0] == family]
            results += measure(chosen.models, chosen.robot, family, scenes, refining=not chosen.alone)
    head = ("family", "model", "problems", "alone", "refined", "with others", "solve", "cpu: plan", "refine", "solve")
    rows = [
        (
            each["family"],
            each["model"],
            f"{each['problems']}",
            *(cell(each, key) for key in ("alone", "refined", "refined, other guesses too", "solve")),
            *(cell(each, key) for key in ("planning cpu [s]", "refining cpu [s]", "solve cpu [s]")),
        )
        for each in results
    ]
    report(
        {"planners": results}, [table("unseen scenes, straight line collides", head, rows, left=2)], as_json=chosen.json
    )


if __name__ == "__main__":
    main()
