"""Families by name, and planning problems in their scenes: obstacles, collision-free ends, and lines that collide."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.random import Generator

from cnpgen.arrays import Array
from cnpgen.documents import JsonMapping
from cnpgen.errors import RecipeError, UsageError, nearest
from cnpgen.pipelines.resting_states import RestingStates, seeds_of
from cnpgen.pipelines.scene_family import Grasp, Layout, SceneFamily
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_problem
from cnpgen.problems.scenes.scene_problem import (
    MAX_SCENES,
    SceneError,
    SceneProblem,
    checked_scene,
)
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.hull import frame_along
from cnpgen.schema import addons, registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import parse
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.world.pose_ik import PoseKinematics, solve_pose_ik
from cnpgen.world.world import World

POSES_PER_GRASP = 24  # random rotations about the approach
MAX_GRASPS = 8  # of one scene that are tried
MAX_PAIRS = 24  # of a start and a goal that are tried for one problem
MAX_FAILED_SCENES = 20  # in a row, without any problem
END_MARGIN_M = 0.005  # clearance of starts and goals
STRAIGHT_SHARE = 0.1  # of the problems that may be solvable by a straight line
# Standard deviation of neutral starts around the base configuration.
NEUTRAL_SPREAD_RAD = 0.1
_STARTS = {"neutral": 0.4, "grasp": 0.4, "random": 0.2}  # kind of start -> probability


def shipped_families() -> dict[str, type[SceneFamily]]:
    """Return the families of this add-on by their names.

    Those of other packages may not be importable.
    """
    own = (
        entry.name
        for entry in addons.installed(registry.FAMILIES)
        if addons.addon_of(entry.module)
    )
    return {name: registry.load(registry.FAMILIES, name) for name in own}


@checked_arguments
def load_family(name: str, parameters: JsonMapping | None = None) -> SceneFamily:
    """Return a family by its name.

    Args:
        name: Its name among ``shipped_families``, or that of an installed package.
        parameters: Values of its fields, as in recipes: ``{"tables": [1, 2], "height":
            "[0, 30] cm"}``.

    Raises:
        UsageError: The family or a parameter is unknown, or a value is invalid.
    """
    known = registry.names(registry.FAMILIES)
    if name not in known:
        text = f"unknown family {name!r}{nearest(name, known)}, expected one of {', '.join(known)}"
        raise UsageError(text, concerns="name")
    errors: list[str] = []
    try:
        kind = registry.load(registry.FAMILIES, name)
    except RecipeError as error:
        raise UsageError(str(error), concerns="family") from error
    family = parse(
        kind, dict(parameters or {}), where=RecipeLocation(name), errors=errors
    )
    if family is None or errors:
        raise UsageError("; ".join(errors), concerns="parameters")
    assert isinstance(family, SceneFamily)
    return family


@checked_arguments
def make_scenes(
    family: str | SceneFamily,
    problem: Problem | StoredProblem | str | Path,
    n: int,
    *,
    seed: int = 0,
    per_scene: int = 4,
    parameters: JsonMapping | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[SceneProblem]:
    """Generate planning problems in scenes of a family.

    Goals are grasp-like poses, for which inverse kinematics finds collision-free states
    with feasible holding torques. Starts are neutral states around the base
    configuration, other grasps, or random states. At least nine of ten straight lines
    between start and goal collide. The same arguments give the same problems.

    Args:
        family: Name of a family, or a family.
        problem: The robot's problem, such as "panda"; its robot needs link geometry.
        n: Number of problems.
        seed: Seed.
        per_scene: Largest number of problems in one scene.
        parameters: Values of the fields of a named family.
        progress: Called with the number of problems since the last call.

    Raises:
        UsageError: An argument is invalid, the problem has an equality constraint, or
            no problems are found for this robot.
    """
    n, seed = integer("n", n, least=1, most=MAX_SCENES), integer("seed", seed, least=0)
    per_scene = integer("per_scene", per_scene, least=1)
    if parameters and not isinstance(family, str):
        raise UsageError("parameters are for families by name", concerns="parameters")
    if isinstance(family, str):
        name, family = family, load_family(family, parameters)
    else:
        name = type(family).__name__
    loaded = as_problem(problem)
    robot = load_robot(loaded)
    _check_no_manifold(loaded, robot)
    generator = _Generator(loaded, robot, family)
    scenes, failed, index = list[SceneProblem](), 0, 0
    while len(scenes) < n:
        random = np.random.default_rng([seed, zlib.crc32(name.encode()), index])
        count = min(per_scene, n - len(scenes))
        found = list(generator.problems(random, f"{name} {index}", count))
        scenes += found
        index, failed = index + 1, 0 if found else failed + 1
        if failed > MAX_FAILED_SCENES:
            raise UsageError(
                f"{failed} scenes of the family {name!r} in a row have no collision-free start and goal for"
                f" {loaded.name!r}: are they within its reach?"
            )
        if progress is not None and found:
            progress(len(found))
    return scenes


def _check_no_manifold(problem: Problem, robot: Robot) -> None:
    """Raise UsageError for constraints that hardly any drawn end meets."""
    world = World(robot, problem.obstacle, problem.object_size)
    rest = np.zeros(robot.n)
    zero = np.zeros((1, 3))
    world.set_state(
        robot.home, rest, rest, scene_of(problem, zero, zero, zero).poses[0]
    )
    # The lack of a shape is reported later.
    for constraint in problem.constraint if robot.shape is not None else ():
        if any(
            condition.g and condition.is_equality
            for condition in constraint.measured(world)
        ):
            name = registry.name_of(registry.CONSTRAINTS, type(constraint))
            raise UsageError(
                f"the problem {problem.name!r} has the equality constraint {name!r}, which the ends that a family draws"
                " do not meet: build SceneProblems with own ends, or use a problem without it",
                concerns="problem",
            )


@dataclass(frozen=True, eq=False)
class _Generator:
    """Generator of problems for one robot."""

    problem: Problem
    robot: Robot
    family: SceneFamily

    def problems(
        self, random: Generator, name: str, count: int
    ) -> Iterator[SceneProblem]:
        """Yield up to ``count`` problems in one scene."""
        layout = self.family.draw(random)
        names = self.robot.joint_names
        start = np.zeros(self.robot.n)
        goal = np.zeros((0, self.robot.n))
        scene = SceneProblem(
            name=name,
            obstacles=layout.obstacles,
            start_q=start,
            goal_q=goal,
            joint_names=names,
        )
        try:
            scene = checked_scene(scene)
        except SceneError:
            # An obstacle contains the base.
            return
        states = RestingStates(self.problem, self.robot, scene.obstacles)
        grasps = self._grasp_states(states, layout, random)
        if not grasps:
            return
        for number in range(count):
            pair = self._pair(states, grasps, random)
            if pair is not None:
                start, goal = pair
                yield replace(
                    scene, name=f"{name} {number}", start_q=start, goal_q=goal[None]
                )

    def _grasp_states(
        self, states: RestingStates, layout: Layout, random: Generator
    ) -> list[Array]:
        """Return collision-free states at grasps, a few for each grasp, shape (G, n) each."""
        kinematics = PoseKinematics(self.robot)
        found = list[Array]()
        for index in random.permutation(len(layout.grasps))[:MAX_GRASPS]:
            grasp = layout.grasps[index]
            rotations = grasp_rotations(grasp, POSES_PER_GRASP, random)
            positions = np.tile(grasp.position, (POSES_PER_GRASP, 1))
            q, met = solve_pose_ik(
                kinematics,
                positions,
                rotations,
                seeds_of(self.robot, POSES_PER_GRASP, random),
            )
            valid = q[:, met][
                :, states.are_ends(q[:, met], margin=END_MARGIN_M)
            ].T.copy()
            if len(valid):
                found.append(valid)
        return found

    def _pair(
        self, states: RestingStates, grasps: list[Array], random: Generator
    ) -> tuple[Array, Array] | None:
        """Return a start and a goal, or None after ``MAX_PAIRS`` attempts."""
        may_be_straight = random.random() < STRAIGHT_SHARE
        for _ in range(MAX_PAIRS):
            target = int(random.integers(len(grasps)))
            goal = grasps[target][random.integers(len(grasps[target]))]
            start = self._start(
                states, [grasps[i] for i in range(len(grasps)) if i != target], random
            )
            if start is not None and (
                may_be_straight or not states.is_line_clear(start, goal)
            ):
                return start, goal
        return None

    def _start(
        self, states: RestingStates, grasps: list[Array], random: Generator
    ) -> Array | None:
        """Return a collision-free start of a random kind, or None."""
        kind = str(random.choice(list(_STARTS), p=list(_STARTS.values())))
        if kind == "grasp":
            if not grasps:
                return None
            chosen = grasps[int(random.integers(len(grasps)))]
            return np.asarray(chosen[random.integers(len(chosen))])
        if kind == "neutral":
            q = self.robot.home + NEUTRAL_SPREAD_RAD * random.standard_normal(
                self.robot.n
            )
        else:
            q = seeds_of(self.robot, 1, random)[:, 0]
        return q if states.are_ends(q[:, None], margin=END_MARGIN_M)[0] else None


def grasp_rotations(grasp: Grasp, count: int, random: Generator) -> Array:
    """Draw rotations whose z axis is within the tilt of a grasp's approach, shape (count, 3, 3)."""
    cosine = 1 - random.uniform(size=count) * (1 - np.cos(grasp.tilt))
    angle, roll = random.uniform(-np.pi, np.pi, (2, count))
    sine = np.sqrt(1 - cosine**2)
    z = np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=1)
    z = z @ _frame(grasp.approach).T
    x = np.stack([_frame(axis)[:, 0] for axis in z])
    y = np.cross(z, x)
    turned = np.cos(roll)[:, None] * x + np.sin(roll)[:, None] * y
    return np.stack([turned, np.cross(z, turned), z], axis=2)


def _frame(axis: Array) -> Array:
    """Return a rotation matrix whose third column is a unit vector."""
    return frame_along(axis.tolist(), 1.0)
