"""The scene of a page: the robot at several times, its obstacles, and its joints relative to their limits."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.cli.view.view_bodies import Body, capsule_bodies, robot_bodies, tube, wrapped
from cnpgen.judges.plans.plan_plot import along, shares_of_limits
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import PARKED_POSITION_M, Scene
from cnpgen.robots.shape.hull import CUBE
from cnpgen.world.forward_kinematics import ForwardKinematics

Array = NDArray[np.float64]

FRAMES_PER_MOTION = 240
DRAWN_DEPTH_M = 1.0  # of obstacles without a lower end
THIN = 5e-3  # m: what a table is drawn as thick as
LINE = 4e-3  # m: radius of the line that the tip draws


@dataclass(frozen=True)
class ViewScene:
    """The content of a page.

    Attributes:
        title: What it is of.
        labels: Label of each of the K frames: its time, "start" or "goal".
        times: Times of the frames [s], shape (K,); 0, 1, ... without a motion.
        poses: Where the joints are, the universe first and the tip last, shape (K, joints, 4, 4).
        robot: Bodies of the robot.
        kind: What they are: "meshes", "pieces" or "line".
        capsules: Capsules round its links.
        world: Obstacles, and the table.
        path: The path of the tip, of a motion.
        held: The held object, in the tip's frame.
        joints: Names of the planned joints.
        shares: Quantity -> share of the limits, shape (n, K); nothing where there is no motion.
    """

    title: str
    labels: tuple[str, ...]
    times: Array
    poses: Array
    robot: tuple[Body, ...]
    kind: str
    capsules: tuple[Body, ...]
    world: tuple[Body, ...]
    path: tuple[Body, ...]
    held: tuple[Body, ...]
    joints: tuple[str, ...]
    shares: dict[str, Array]


def scene_of_problem(problem: Problem, robot: Robot) -> ViewScene:
    """Show a robot in its base configuration."""
    q = robot.base[:, None]
    title, bodies = f"{problem.name}: base configuration", robot_bodies(problem, robot)
    return _scene(problem, robot, title, q, bodies, labels=("base",), times=np.zeros(1))


def scene_of_plan(problem: Problem, robot: Robot, plans: Plans, title: str, *, with_meshes: bool) -> ViewScene:
    """Show the motion of one plan or, of a row without a plan, its start and its goal.

    Args:
        problem: The problem.
        robot: Its robot.
        plans: The plan.
        title: What the page is called.
        with_meshes: Whether the URDF's visual meshes are read.

    Raises:
        UsageError: The plan cannot be evaluated.
    """
    bodies = robot_bodies(problem, robot, with_meshes=with_meshes)
    if not np.isfinite(plans.duration[0]):
        boundary = plans.boundary
        q = np.array([boundary.start_q[0], boundary.goal_q[0]]).T
        return _scene(
            problem, robot, title, q, bodies, labels=("start", "goal"), times=np.arange(2.0), scene=plans.scene
        )
    world, _, times = along(problem, robot, plans.motion, 0, samples=FRAMES_PER_MOTION)
    labels = tuple(f"{time:.3f} s" for time in times)
    shares = shares_of_limits(world)
    return _scene(problem, robot, title, world.q, bodies, labels=labels, times=times, shares=shares, scene=plans.scene)


def _scene(
    problem: Problem,
    robot: Robot,
    title: str,
    q: Array,
    bodies: tuple[list[Body], str],
    *,
    labels: tuple[str, ...],
    times: Array,
    shares: dict[str, Array] | None = None,
    scene: Scene | None = None,
) -> ViewScene:
    poses = _poses(robot, q)
    tip = poses[:, -1, :3, 3]
    if scene is None:
        scene = scene_of(problem, tip[:1], tip[-1:], np.zeros((1, 3)))
    size = problem.object_size
    return ViewScene(
        title=title,
        labels=labels,
        times=times,
        poses=poses,
        robot=tuple(bodies[0]),
        kind=bodies[1],
        capsules=tuple(capsule_bodies(robot)),
        world=tuple(_world(problem, scene)),
        path=(tube("path of the tip", tip, LINE),) if shares else (),
        held=() if size is None else (wrapped("object", robot.n + 1, CUBE * np.array(size), 0.0),),
        joints=robot.joint_names,
        shares=shares or {},
    )


def _poses(robot: Robot, q: Array) -> Array:
    """Return the poses of all joints and of the tip at K states, shape (K, n + 2, 4, 4)."""
    n = robot.n
    rotations, positions = ForwardKinematics(robot.model).poses(q)
    poses = np.zeros((q.shape[1], n + 2, 4, 4))
    for joint, (rotation, position) in enumerate(zip(rotations, positions, strict=True)):
        poses[:, joint, :3, :3], poses[:, joint, :3, 3] = rotation.transpose(2, 0, 1), position.T
    poses[..., 3, 3] = 1.0
    poses[:, -1] = poses[:, n] @ robot.model.frames[robot.tip_frame].placement.homogeneous
    return poses


def _world(problem: Problem, scene: Scene) -> Iterator[Body]:
    """Draw obstacles, and a table."""
    for obstacle, solid in zip(problem.obstacle, scene.bodies(), strict=True):
        if solid.position[2] <= PARKED_POSITION_M[2]:  # the plan has fewer obstacles than the problem
            continue
        if obstacle.upright and obstacle.height is None:
            yield _box(obstacle.name, np.array([*solid.low[:2], solid.high[2] - DRAWN_DEPTH_M]), solid.high)
        else:
            yield wrapped(obstacle.name, 0, solid.position + solid.corners, solid.radius)
    for each in problem.constraint:
        if isinstance(each, Table):
            low, high = (each.x.low, each.y.low, each.z - THIN), (each.x.high, each.y.high, each.z)
            yield _box("table", np.array(low), np.array(high))


def _box(name: str, low: Array, high: Array) -> Body:
    return wrapped(name, 0, (low + high) / 2 + CUBE * (high - low), 0.0)
