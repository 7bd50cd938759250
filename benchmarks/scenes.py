"""Collision checks and plans among obstacles: states/s against Coal, and the CPU time of solving new scenes.

The scenes are generated: tables, shelves, cages, boxes and desks, or with ``--shipped`` the families of
``cnpgen.scenes``. The robot is a Panda with 3 kg, a UR5, or a Panda that holds a cup upright (``--robots panda-cup``).
Every scene is solved once, in one process and thread, from a new problem: the set-up of the scene is part of its time.
Kernels of a robot are compiled before, since they do not depend on its obstacles. With ``--meshes`` Pinocchio and Coal
check valid plans on the meshes of the URDF. With ``--reference`` RRT-Connect alone searches for paths of unsolved
problems.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from common import arguments, cpu_of, median, progress, report, table
from numpy.typing import NDArray
from scene_datasets import Meshes, plan_states

from cnpgen.addons.families.scene_generator import make_scenes
from cnpgen.addons.scene_files.scene_files import load_scenes
from cnpgen.kernels.collision.collision_checker import (
    CollisionChecker,
    load_collision_library,
)
from cnpgen.kernels.collision.tree_search import TreeSettings, find_tree_path
from cnpgen.kernels.library import KernelLibrary, choose_backend
from cnpgen.pipelines.resting_states import RestingStates
from cnpgen.plans.boundary_problems import plans_of_rows
from cnpgen.plans.plans import Plans
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.problems.constraints.axis import Vertical
from cnpgen.problems.constraints.joint import JointJerk
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import as_problem, record_problem
from cnpgen.refine.options import DEFAULT_OPTIONS, RefineOptions
from cnpgen.refine.refine_engine import prepare, refine_serially
from cnpgen.refine.task import Attempt
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.shape import with_held_object
from cnpgen.robots.solid import place_obstacles
from cnpgen.schema import registry
from cnpgen.schema.catalogue import list_recipes
from cnpgen.schema.keys import PerJoint

Array = NDArray[np.float64]
Random = np.random.Generator
Box = tuple[
    tuple[float, float, float], tuple[float, float, float]
]  # lowest and highest corner [m]

SAMPLES, MAX_BATCHES = 20_000, 40  # random states per batch of the search of ends
PROJECTIONS, MAX_PROJECTION_STEP, PROJECTION_DAMPING = (
    12,
    0.5,
    1e-6,
)  # of random states that hold a cup upright
MAX_TILT = 1e-9  # of their ends
MIN_END_CLEARANCE_M = 1e-3
TORQUE_FRACTION = 0.95  # of the limits, at rest at both ends
JERK_LIMITS = {
    "panda": (7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0)
}  # data sheet [rad/s^3]
JERK_TOLERANCE = 0.01  # of the limits
MESH_STEP_S = 0.002  # between the states that are checked on meshes
REFERENCE_EXTENSIONS = 100_000  # of the trees of one search
PROBLEM = """
name = "scenes"
[robot]
{robot}
geometry = "urdf"
[limits]
{limits}
{payload}
[trajectory]
degree = 7
path_control_points = 15
rate_control_points = 20
[[constraint]]
use = "joint-position"
tolerance = "1e-3 rad"
[[constraint]]
use = "joint-velocity"
tolerance = "0.2 %"
[[constraint]]
use = "joint-acceleration"
tolerance = "0.5 %"
[[constraint]]
use = "joint-torque"
tolerance = "0.5 %"
[[constraint]]
use = "robot-clearance"
tolerance = "0 mm"
[[constraint]]
use = "self-clearance"
tolerance = "0 mm"
"""
UPRIGHT = """
[[constraint]]
use = "vertical"
tolerance = "1.8 deg"
[[constraint]]
use = "object-contact"
depth = "0 mm"
tolerance = "0 mm"
[[constraint]]
use = "object-clearance"
[object]
size = "[7, 7, 12] cm"
"""
PANDA = PROBLEM.format(
    robot="""urdf = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
joints = [
  "panda_joint1", "panda_joint2", "panda_joint3", "panda_joint4", "panda_joint5", "panda_joint6", "panda_joint7",
]
tip = "panda_hand_tcp"
base = "[0, -45, 0, -135, 0, 90, 45] deg"
""",
    limits="""velocity = [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]
acceleration = [15, 7.5, 10, 12.5, 15, 20, 20]
torque = [87, 87, 87, 87, 12, 12, 12]
""",
    payload='[payload]\nmass = "3 kg"\nsize = "[8, 8, 8] cm"',
)
LEVEL = 'tip_rotation = "[0, 90, 0] deg"\nbase = "[0, -30, 0, -150, 0, 210, 45] deg"'
CUP = PANDA.replace('base = "[0, -45, 0, -135, 0, 90, 45] deg"', LEVEL) + UPRIGHT
ROBOTS = {
    "panda": PANDA,
    "panda-cup": CUP,
    "ur5": PROBLEM.format(
        robot="""urdf = "package://example-robot-data/robots/ur_description/urdf/ur5_joint_limited_robot.urdf"
joints = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
tip = "tool0"
base = "[0, -90, 90, -90, -90, 0] deg"
""",
        limits='acceleration_rate = "10 1/s"\nacceleration_cap = "20 rad/s^2"',
        payload='[payload]\nmass = "3 kg"\nsize = "[8, 8, 8] cm"',
    ),
}


@dataclass(frozen=True)
class GeneratedScene:
    """Obstacles, and the boxes in which the tip starts and ends [m]."""

    obstacles: tuple[Obstacle, ...]
    regions: tuple[Box, ...]


@dataclass(frozen=True)
class Solved:
    """A boundary problem without a motion, the best attempt at it, its obstacles, and CPU times [s].

    ``set_up`` is the part of ``cpu`` until the solver of the scene is ready.
    """

    plans: Plans
    attempt: Attempt
    obstacles: tuple[Obstacle, ...]
    set_up: float
    cpu: float


def box(name: str, position: Any, size: Any, yaw: float = 0.0) -> Obstacle:
    """Return a box with a pose."""
    return Obstacle(
        name=name,
        position=(float(position[0]), float(position[1]), float(position[2])),
        size=tuple(size),
        rotation=(0.0, 0.0, yaw),
    )


def cylinder(
    name: str, position: Any, radius: float, length: float, roll: float = 0.0
) -> Obstacle:
    """Return a cylinder that is upright or turned about x."""
    return Obstacle(
        name=name,
        kind="cylinder",
        position=(float(position[0]), float(position[1]), float(position[2])),
        radius=radius,
        length=length,
        rotation=(roll, 0.0, 0.0),
    )


def table_scene(random: Random) -> GeneratedScene:
    """Return a table with five boxes and four cylinders."""
    top, obstacles = random.uniform(-0.05, 0.2), list[Obstacle]()
    obstacles.append(box("table", (0.6, 0.0, top - 0.02), (0.7, 1.4, 0.04)))
    for index in range(9):
        x, y, height = (
            random.uniform(0.4, 0.8),
            random.uniform(-0.55, 0.55),
            random.uniform(0.1, 0.4),
        )
        if index < 5:
            size = (random.uniform(0.04, 0.15), random.uniform(0.04, 0.15), height)
            obstacles.append(
                box(
                    f"box {index}",
                    (x, y, top + height / 2),
                    size,
                    random.uniform(-3.1, 3.1),
                )
            )
        else:
            radius = random.uniform(0.03, 0.07)
            obstacles.append(
                cylinder(f"can {index}", (x, y, top + height / 2), radius, height)
            )
    region = ((0.35, -0.55, top + 0.05), (0.75, 0.55, top + 0.3))
    return GeneratedScene(tuple(obstacles), (region,))


def shelf_scene(random: Random) -> GeneratedScene:
    """Return a shelf of four boards with six cylinders on them."""
    x, width, depth = (
        random.uniform(0.6, 0.75),
        random.uniform(0.7, 1.0),
        random.uniform(0.25, 0.4),
    )
    bottom, gap = random.uniform(0.0, 0.15), random.uniform(0.28, 0.4)
    midpoint = bottom + 1.5 * gap
    obstacles = [
        box(f"board {i}", (x, 0.0, bottom + i * gap), (depth, width, 0.02), 1e-9)
        for i in range(4)
    ]
    sides = (depth, 0.02, 3 * gap + 0.02)
    obstacles += [
        box(f"side {side}", (x, side * width / 2, midpoint), sides, 1e-9)
        for side in (-1, 0, 1)
    ]
    obstacles.append(
        box("back", (x + depth / 2, 0.0, midpoint), (0.02, width, 3 * gap), 1e-9)
    )
    for index in range(6):
        y, height = random.uniform(-0.45, 0.45) * width, random.uniform(0.08, 0.15)
        z = bottom + 0.015 + height / 2 + random.integers(3) * gap
        obstacles.append(
            cylinder(
                f"can {index}",
                (x + random.uniform(-0.3, 0.3) * depth, y, z),
                0.03,
                height,
            )
        )
    regions = tuple(
        ((x - depth / 2, sign * 0.25 * width - 0.2 * width, bottom + i * gap + 0.05),
         (x, sign * 0.25 * width + 0.2 * width, bottom + (i + 1) * gap - 0.05))
        for i in range(3)
        for sign in (-1, 1)
    )  # fmt: skip
    return GeneratedScene(tuple(obstacles), regions)


def cage_scene(random: Random) -> GeneratedScene:
    """Return a cage of ten bars around the arm, two bars above it, and a table."""
    radius, obstacles = (
        random.uniform(0.45, 0.6),
        [box("table", (0.0, 0.0, -0.15), (1.8, 1.8, 0.1), 1e-9)],
    )
    angles = np.linspace(-2.2, 2.2, 10) + random.uniform(-0.08, 0.08, 10)
    for index, angle in enumerate(angles):
        place = (radius * np.cos(angle), radius * np.sin(angle), 0.5)
        obstacles.append(
            cylinder(f"bar {index}", place, random.uniform(0.012, 0.02), 1.2)
        )
    for index, x in enumerate((0.25, 0.5)):
        obstacles.append(
            cylinder(
                f"top {index}", (x, 0.0, random.uniform(0.8, 1.0)), 0.02, 1.4, np.pi / 2
            )
        )
    regions = tuple(
        (
            (c * 0.65 - 0.12, s * 0.65 - 0.12, 0.15),
            (c * 0.65 + 0.12, s * 0.65 + 0.12, 0.6),
        )
        for c, s in zip(np.cos(angles[2:8]), np.sin(angles[2:8]), strict=True)
    )
    return GeneratedScene(tuple(obstacles), regions)


def boxes_scene(random: Random) -> GeneratedScene:
    """Return two open boxes beside each other, with a post between them."""
    obstacles, regions = list[Obstacle](), list[Box]()
    for index, side in enumerate((-1, 1)):
        x, y, z = (
            random.uniform(0.45, 0.6),
            side * random.uniform(0.27, 0.4),
            random.uniform(0.0, 0.2),
        )
        size, height = random.uniform(0.3, 0.42), random.uniform(0.15, 0.3)
        yaw = random.uniform(-0.4, 0.4)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        obstacles.append(box(f"floor {index}", (x, y, z), (size, size, 0.02), yaw))
        for wall, (dx, dy) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)]):
            place = np.array([x, y]) + turn @ np.array([dx, dy]) * size / 2
            sides = (0.02, size, height) if dx else (size, 0.02, height)
            obstacles.append(
                box(f"wall {index} {wall}", (*place, z + height / 2), sides, yaw)
            )
        regions.append(
            ((x - 0.12, y - 0.12, z + 0.04), (x + 0.12, y + 0.12, z + 0.6 * height))
        )
    height = random.uniform(0.5, 0.9)
    obstacles.append(
        cylinder("post", (random.uniform(0.4, 0.6), 0.0, height / 2), 0.04, height)
    )
    return GeneratedScene(tuple(obstacles), tuple(regions))


def desk_scene(random: Random) -> GeneratedScene:
    """Return a desk with four legs and a lower board; the arm moves between its top and below."""
    top, x = random.uniform(0.35, 0.5), random.uniform(0.6, 0.7)
    obstacles = [
        box("top", (x, 0.0, top), (0.5, 1.0, 0.03), 1e-9),
        box("board", (x, 0.0, top - random.uniform(0.42, 0.5)), (0.5, 1.0, 0.03), 1e-9),
        box(
            "monitor",
            (x + 0.1, random.uniform(-0.3, 0.3), top + 0.2),
            (0.05, 0.4, 0.35),
            random.uniform(-0.5, 0.5),
        ),
    ]
    for index, (dx, dy) in enumerate(
        [(0.22, 0.47), (0.22, -0.47), (-0.22, 0.47), (-0.22, -0.47)]
    ):
        obstacles.append(cylinder(f"leg {index}", (x + dx, dy, top / 2), 0.025, top))
    above = ((x - 0.2, -0.4, top + 0.05), (x + 0.1, 0.4, top + 0.3))
    below = ((x - 0.2, -0.35, top - 0.3), (x + 0.05, 0.35, top - 0.05))
    return GeneratedScene(tuple(obstacles), (above, below))


FAMILIES: dict[str, Callable[[Random], GeneratedScene]] = {
    "table": table_scene,
    "shelf": shelf_scene,
    "cage": cage_scene,
    "boxes": boxes_scene,
    "desk": desk_scene,
}


class EndSampler:
    """Random ends of motions: free of collisions, with feasible torques at rest, and the tip in a region.

    The object that a problem's robot holds is upright.
    """

    def __init__(
        self, problem: Problem, robot: Robot, checker: CollisionChecker
    ) -> None:
        self.robot, self.checker, self.is_upright = (
            robot,
            checker,
            problem.first(Vertical) is not None,
        )

    def ends(
        self, scene: GeneratedScene, random: Random, *, line_may_be_free: bool
    ) -> tuple[Array, Array] | None:
        """Return start and goal in different regions, or None if there are none in ``MAX_BATCHES`` batches."""
        self.checker.place(scene.obstacles, place_obstacles(scene.obstacles))
        found: list[list[Array]] = [[] for _ in scene.regions]
        robot = self.robot
        for _ in range(MAX_BATCHES):
            q = random.uniform(
                robot.position_lower, robot.position_upper, (SAMPLES, robot.n)
            )
            q = self.upright(q) if self.is_upright else q
            poses = self.checker.joint_poses(q.T)[:, -1]
            tip = (
                poses[:, :9].reshape(-1, 3, 3) @ robot.chain.tip_translation
                + poses[:, 9:]
            )
            for region, states in zip(scene.regions, found, strict=True):
                inside = q[((tip > region[0]) & (tip < region[1])).all(axis=1)]
                if len(inside):
                    clear = self.checker.clear_states(
                        inside.T,
                        obstacle_distance=MIN_END_CLEARANCE_M,
                        self_distance=MIN_END_CLEARANCE_M,
                    )
                    states.extend(state for state in inside[clear] if self.holds(state))
            usable = [
                states
                for states in found
                if len(states) >= (3 if len(found) > 1 else 6)
            ]
            if len(usable) >= min(2, len(found)):
                for _ in range(20):
                    a, b = (
                        random.choice(len(usable), 2, replace=False)
                        if len(usable) > 1
                        else (0, 0)
                    )
                    start, goal = (
                        usable[i][random.integers(len(usable[i]))] for i in (a, b)
                    )
                    if np.abs(start - goal).max() < 0.2:
                        continue
                    if line_may_be_free or not self.line_is_free(start, goal):
                        return start, goal
        return None

    def upright(self, q: Array) -> Array:
        """Project states (K, n) by Gauss-Newton steps; return those with an upright tip axis within the limits."""
        robot, chain = self.robot, self.robot.chain
        joint_axes = np.array([joint.axis for joint in chain.joints])
        for last in range(PROJECTIONS + 1):
            rotations = self.checker.joint_poses(q.T)[:, 1:, :9].reshape(*q.shape, 3, 3)
            tip_axis = rotations[:, -1] @ chain.tip_rotation[:, 2]
            tilt = tip_axis[:, :2]
            if last == PROJECTIONS:
                break
            axes = np.einsum("kjxy,jy->kjx", rotations, joint_axes)
            columns = np.cross(axes, tip_axis[:, None])[..., :2]
            square = np.einsum(
                "kjx,kjy->kxy", columns, columns
            ) + PROJECTION_DAMPING * np.eye(2)
            step = np.einsum(
                "kjx,kx->kj", columns, np.linalg.solve(square, tilt[..., None])[..., 0]
            )
            q = q - np.clip(step, -MAX_PROJECTION_STEP, MAX_PROJECTION_STEP)
        inside = ((q > robot.position_lower) & (q < robot.position_upper)).all(axis=1)
        upright = inside & (np.abs(tilt).max(axis=1) < MAX_TILT) & (tip_axis[:, 2] > 0)
        return np.asarray(q[upright])

    def holds(self, q: Array) -> bool:
        """Return whether the torques at rest are within a fraction of the limits."""
        import pinocchio as pin

        tau = pin.computeGeneralizedGravity(
            self.robot.model, self.robot.model.createData(), q
        )
        return bool((np.abs(tau) <= TORQUE_FRACTION * self.robot.torque_limit).all())

    def line_is_free(self, start: Array, goal: Array) -> bool:
        """Return whether the straight line between two configurations is free of collisions."""
        count = int(np.ceil(np.abs(goal - start).max() / 0.02)) + 1
        return bool(
            self.checker.clear_states(
                start[:, None] + (goal - start)[:, None] * np.linspace(0, 1, count)
            ).all()
        )


def generate(
    base: Problem, sampler: EndSampler, family: str, count: int, seed: int
) -> Iterator[tuple[Problem, Array, Array]]:
    """Yield problems of a family with start and goal; every fifth may have a free straight line."""
    made, number = 0, 0
    while made < count:
        random = np.random.default_rng([seed, list(FAMILIES).index(family), number])
        number += 1
        scene = FAMILIES[family](random)
        ends = sampler.ends(scene, random, line_may_be_free=made % 5 == 4)
        if ends is not None:
            made += 1
            yield base.with_obstacles(scene.obstacles), *ends


def generate_shipped(
    base: Problem, sampler: EndSampler, family: str, count: int, seed: int
) -> Iterator[tuple[Problem, Array, Array]]:
    """Yield problems of a family of ``cnpgen.scenes.make_scenes``, one in each scene; see ``generate``."""
    made, batch = 0, 0
    while made < count:
        for scene in make_scenes(family, base, count, seed=seed + batch, per_scene=1):
            start, goal = scene.start_q, scene.goal_q[0]
            sampler.checker.place(scene.obstacles, place_obstacles(scene.obstacles))
            usable = sampler.holds(start) and sampler.holds(goal)
            if (
                made < count
                and usable
                and (made % 5 == 4 or not sampler.line_is_free(start, goal))
            ):
                made += 1
                yield base.with_obstacles(scene.obstacles), start, goal
        batch += 1


def boundary_columns(start: Array, goal: Array) -> dict[str, Array]:
    """Return the columns of a motion from rest to rest."""
    rest = np.zeros((1, len(start)))
    columns = {
        "start_q": start[None],
        "start_dq": rest,
        "start_ddq": rest,
        "goal_q": goal[None],
        "goal_dq": rest,
    }
    return columns | {"start_xyz": np.zeros((1, 3)), "goal_xyz": np.zeros((1, 3))}


def solve_scene(
    problem: Problem,
    start: Array,
    goal: Array,
    refine_options: RefineOptions = DEFAULT_OPTIONS,
) -> Solved:
    """Solve a new scene."""
    columns = boundary_columns(start, goal)
    return solve_problem(
        lambda: plans_of_rows(record_problem(problem), columns),
        problem.obstacle,
        refine_options,
    )


def solve_suite(problem: Problem, count: int) -> list[Solved]:
    """Solve the first problems of the suite clutter one by one; the first one, which may compile, is solved twice."""
    scenes = load_scenes(list_recipes("suite")["clutter"].with_suffix(".h5"), n=count)
    set_ups = [
        (partial(scene_plans, problem, [scene]), scene.obstacles)
        for scene in (scenes[0], *scenes)
    ]
    return [solve_problem(*set_up) for set_up in set_ups][1:]


def solve_problem(
    set_up: Callable[[], Plans],
    obstacles: tuple[Obstacle, ...],
    refine_options: RefineOptions = DEFAULT_OPTIONS,
) -> Solved:
    """Set up one boundary problem and solve it; the CPU time includes both."""
    begun = time.process_time()
    plans = set_up()
    prepare(plans, DEFAULT_OPTIONS)
    ready = time.process_time()
    (attempt,) = refine_serially(plans, refine_options)
    return Solved(plans, attempt, obstacles, ready - begun, time.process_time() - begun)


def with_jerk_limits(problem: Problem, limits: tuple[float, ...]) -> Problem:
    """Return the problem with limits on the jerk [rad/s^3], too."""
    limited = replace(
        problem,
        limits=replace(problem.limits, jerk=PerJoint(limits)),
        constraint=(*problem.constraint, JointJerk(tolerance=JERK_TOLERANCE)),
    )
    vars(limited)["urdf_text"] = (
        problem.urdf_text
    )  # a cached property, whose file may be temporary
    return limited


def check_meshes(problem: Problem, solved: list[Solved]) -> dict[str, Any]:
    """Return the number of valid plans with contacts of the URDF's meshes, by SciPy, Pinocchio and Coal."""
    robot, contacts, depth, states = load_robot(problem), 0, 0.0, 0
    assert robot.shape is not None
    left_out = {
        frozenset((pair.first, pair.second))
        for pair in robot.shape.pairs
        if pair.left_out
    }
    meshes = Meshes(problem.urdf_path.read_text(), robot.joint_names, left_out)
    valid = [each for each in solved if each.attempt.valid]
    for each in valid:
        meshes.place([coal_obstacle(obstacle) for obstacle in each.obstacles])
        q = plan_states(
            each.attempt.path, each.attempt.rate, each.plans.degree, MESH_STEP_S
        )
        states += len(q)
        if touching := [state for state in q if meshes.touch(state)]:
            contacts, depth = contacts + 1, max(depth, *map(meshes.depth, touching))
    return {
        "plans": len(valid),
        "states": states,
        "with contact": contacts,
        "depth [mm]": 1e3 * depth,
    }


def coal_obstacle(obstacle: Obstacle) -> tuple[Any, Any]:
    """Return Coal's exact shape of a box or a cylinder, and its placement."""
    if obstacle.kind not in {"box", "cylinder"} or obstacle.position is None:
        raise ValueError(f"expected a box or a cylinder with a pose, got {obstacle}")
    sizes = (
        (obstacle.size or ())
        if obstacle.kind == "box"
        else (obstacle.radius, obstacle.length)
    )
    rotation = pin.rpy.rpyToMatrix(*obstacle.rotation)
    return getattr(coal, obstacle.kind.capitalize())(*sizes), pin.SE3(
        rotation, np.array(obstacle.position)
    )


def search_reference(
    problem: Problem, solved: list[Solved], seconds: float
) -> dict[str, int]:
    """Return the number of unsolved problems for which RRT-Connect finds a path in so much CPU time [s]."""
    robot = load_robot(problem)
    checker, found = make_checker(problem, robot), 0
    unsolved = [each for each in solved if not each.attempt.valid]
    for each in unsolved:
        checker.place(each.obstacles, place_obstacles(each.obstacles))
        ends, box_of_joints = (
            each.plans.boundary,
            (robot.position_lower, robot.position_upper),
        )
        settings = TreeSettings(
            0.0, 0.0, max_extensions=REFERENCE_EXTENSIONS, max_nodes=10**9, shortcuts=0
        )
        begun, path, seed = time.process_time(), None, 0
        while path is None and time.process_time() - begun < seconds:
            end_states = ends.start_q[0], ends.goal_q[0]
            path = find_tree_path(
                checker,
                end_states,
                box_of_joints,
                robot.velocity_limit,
                settings,
                seed=seed,
            )
            seed += 1
        found += path is not None
    return {"unsolved": len(unsolved), "with a path": found}


def checks(states: int) -> dict[str, float]:
    """Return states/s of compiled checks and of Coal on recorded tree edges: a Panda among 20 obstacles."""
    base, robot, checker = loaded("panda")
    random, scene = np.random.default_rng(20), table_scene(np.random.default_rng(20))
    more = cage_scene(random).obstacles[:11]
    obstacles = (*scene.obstacles[:9], *more)
    checker.place(obstacles, place_obstacles(obstacles))
    q = random.uniform(robot.position_lower, robot.position_upper, (SAMPLES, robot.n))
    free, edges, settings = (
        q[checker.clear_states(q.T)],
        list[Array](),
        TreeSettings(0.0, 0.0, shortcuts=0),
    )
    box_of_joints, total = (robot.position_lower, robot.position_upper), 0
    for start, goal in zip(free[::2], free[1::2], strict=False):
        path = find_tree_path(
            checker,
            (start, goal),
            box_of_joints,
            robot.velocity_limit,
            settings,
            seed=0,
        )
        for a, b in pairwise(() if path is None else path):
            count = int(np.ceil(np.abs(b - a).max() / settings.spacing)) + 1
            edges.append(a[:, None] + (b - a)[:, None] * np.linspace(0, 1, count))
            total += count
        if total > states:
            break
    recorded = np.concatenate(edges, axis=1)
    by_coal = RestingStates(base.with_obstacles(obstacles), robot)
    part = recorded[:, : states // 50]
    times = [median(cpu_of(lambda: checker.clear_states(recorded)) for _ in range(5))]
    times.append(cpu_of(lambda: by_coal.are_clear(part)))
    equal = bool(np.array_equal(checker.clear_states(part), by_coal.are_clear(part)))
    close = cpu_of(
        lambda: [
            checker.close_bodies(recorded[:, :100], 0.04, of_obstacles=kind)
            for kind in (True, False)
        ]
    )
    return {
        "states": recorded.shape[1],
        "compiled states/s": recorded.shape[1] / times[0],
        "coal states/s": part.shape[1] / times[1],
        "equal results": float(equal),
        "close bodies of 100 states [ms]": 1e3 * close,
    }


def loaded(name: str) -> tuple[Problem, Robot, CollisionChecker]:
    """Return the problem of a robot without obstacles, the robot, and its collision checks."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "problem.toml"
        path.write_text(ROBOTS[name], encoding="utf-8")
        problem = load_problem(path)
        robot = load_robot(problem)
        problem = problem.with_obstacles(())  # with the text of the URDF
    return problem, robot, make_checker(problem, robot)


def make_checker(problem: Problem, robot: Robot) -> CollisionChecker:
    """Return the compiled collision checks of a robot with the object that it holds."""
    library = load_collision_library(KernelLibrary(*choose_backend("compiled"), "", {}))
    assert library is not None
    assert robot.shape is not None
    size = problem.object_size
    return CollisionChecker(
        library,
        robot,
        size and with_held_object(robot.shape, robot.held_shape, robot.chain, size),
    )


def solve_family(
    base: Problem,
    sampler: EndSampler,
    family: str,
    count: int,
    seed: int,
    *,
    shipped: bool,
) -> list[Solved]:
    """Solve problems of a family, each from a new scene; the first one, which may compile kernels, is solved twice."""
    problems = list(
        (generate_shipped if shipped else generate)(base, sampler, family, count, seed)
    )
    solve_scene(*problems[0])
    return [solve_scene(*problem) for problem in problems[1:]]


def summary(solved: list[Solved]) -> dict[str, Any]:
    """Summarize solved problems."""
    cpu, valid = (
        np.array([each.cpu for each in solved]),
        [each.attempt.valid for each in solved],
    )
    set_up = [each.set_up for each in solved]
    return {
        "problems": len(solved),
        "valid": sum(valid),
        "median cpu [s]": float(np.median(cpu)),
        "p95 cpu [s]": float(np.percentile(cpu, 95)),
        "p99 cpu [s]": float(np.percentile(cpu, 99)),
        "cpu above 1 s": int((cpu > 1).sum()),
        "median set-up [s]": float(np.median(set_up)),
        "p95 set-up [s]": float(np.percentile(set_up, 95)),
        "mean motion time [s]": float(
            np.mean([each.attempt.cost for each in solved if each.attempt.valid])
        ),
        "reasons": sorted(
            {str(each.attempt.reason) for each in solved if not each.attempt.valid}
        ),
    }


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--robots", nargs="*", default=["panda"], choices=list(ROBOTS), help="robots"
    )
    parser.add_argument("--families", nargs="*", help="families (default: all)")
    parser.add_argument(
        "--shipped", action="store_true", help="families of cnpgen.scenes.make_scenes"
    )
    parser.add_argument(
        "--count",
        type=int,
        default=21,
        help="problems of every family; the first is not counted",
    )
    parser.add_argument(
        "--seed", type=int, default=29_110_301, help="seed of the scenes"
    )
    parser.add_argument(
        "--suite", type=int, default=0, help="problems of the suite clutter"
    )
    parser.add_argument(
        "--jerk", action="store_true", help="limit the jerk, too (panda)"
    )
    parser.add_argument(
        "--meshes",
        action="store_true",
        help="check valid plans on the meshes of the URDF",
    )
    parser.add_argument(
        "--reference",
        type=float,
        default=0.0,
        metavar="S",
        help="CPU time of RRT-Connect [s]",
    )
    parser.add_argument(
        "--states", type=int, default=100_000, help="states of the collision checks"
    )


def main() -> None:
    """Run the benchmark."""
    chosen = arguments(__doc__, options)
    families = chosen.families or list(
        registry.names(registry.FAMILIES) if chosen.shipped else FAMILIES
    )
    with np.errstate(all="ignore"):
        checked, rows, results = (
            checks(chosen.states),
            list[tuple[str, ...]](),
            dict[str, Any](),
        )
        for name, family in [("panda", "clutter")] * bool(chosen.suite) + list(
            product(chosen.robots, families)
        ):
            progress(f"{name}: {family}")
            problem, robot, checker = loaded(name)
            problem = as_problem("panda-3kg") if family == "clutter" else problem
            problem = (
                with_jerk_limits(problem, JERK_LIMITS[name]) if chosen.jerk else problem
            )
            if family == "clutter":
                solved = solve_suite(problem, chosen.suite)
            else:
                solved = solve_family(
                    problem,
                    EndSampler(problem, robot, checker),
                    family,
                    chosen.count,
                    chosen.seed,
                    shipped=chosen.shipped,
                )
            figures = results[f"{name} {family}"] = summary(solved)
            rows.append(
                (
                    name,
                    family,
                    *(
                        f"{value:.4g}"
                        for key, value in figures.items()
                        if key != "reasons"
                    ),
                )
            )
            if chosen.meshes:
                figures["meshes"] = check_meshes(problem, solved)
            if chosen.reference:
                figures["reference"] = search_reference(
                    problem, solved, chosen.reference
                )
    head = (
        "robot",
        "family",
        "problems",
        "valid",
        "median",
        "p95",
        "p99",
        "> 1 s",
        "set-up",
        "p95",
        "motion time",
    )
    tables = [
        table(
            "collision checks",
            ("figure", "value"),
            [(key, f"{value:,.4g}") for key, value in checked.items()],
        )
    ]
    tables.append(table("new scenes, CPU time in s with set-up", head, rows, left=2))
    for part, title in (
        ("meshes", "contacts of the meshes"),
        ("reference", "RRT-Connect on unsolved problems"),
    ):
        parts = {
            key: figures[part] for key, figures in results.items() if part in figures
        }
        if parts:
            cells = [
                (key, *(f"{value:.6g}" for value in figures.values()))
                for key, figures in parts.items()
            ]
            tables.append(table(title, ("scenes", *next(iter(parts.values()))), cells))
    report({"checks": checked, "scenes": results}, tables, as_json=chosen.json)


if __name__ == "__main__":
    main()
