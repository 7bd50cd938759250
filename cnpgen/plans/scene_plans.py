"""Scene problems as boundary problems of one problem whose obstacles differ from plan to plan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.obstacles import Capacity, with_capacity
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.problems.scenes.placement import placed_scene
from cnpgen.problems.scenes.requested_problem import refuse_changes
from cnpgen.problems.scenes.scene_problem import SceneError, SceneProblem, check_scenes
from cnpgen.robots.observation.primitives import KINDS, primitives_of
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import number_slices, place_obstacles, pose_width
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import numbers
from cnpgen.schema.units import suggested_unit
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.trajectory.boundary import Boundary

# Capacities are multiples of it, so that scenes share compiled kernels.

OBSTACLES_PER_STEP = 4
# Outside a limit, which rounding of files to float32 may cause.
JOINT_TOLERANCE_RAD = 1e-3


def capacity_of(scenes: Sequence[SceneProblem]) -> dict[str, int]:
    """Return the numbers of obstacles of each shape that hold every scene.

    The shape is a kind, or the corners of a mesh. Numbers of kinds are rounded up to
    ``OBSTACLES_PER_STEP``.
    """
    counts = [Counter(map(shape_of, scene.obstacles)) for scene in scenes]
    meshes = sorted({shape for count in counts for shape in count} - set(KINDS))
    most = {
        shape: max((count[shape] for count in counts), default=0)
        for shape in (*KINDS, *meshes)
    }
    # Each mesh is a shape of its own, whose places no other obstacle can use.
    steps = {shape: OBSTACLES_PER_STEP if shape in KINDS else 1 for shape in most}
    return {
        shape: -(-count // steps[shape]) * steps[shape]
        for shape, count in most.items()
        if count
    }


def shape_of(obstacle: Obstacle) -> str:
    """Return the key of an obstacle in capacities."""
    return obstacle.mesh or obstacle.kind


@checked_arguments
def scene_plans(
    problem: Problem,
    scenes: Sequence[SceneProblem],
    *,
    goals: Sequence[Array] | None = None,
    capacity: Capacity | None = None,
    sample_id: Sequence[int] | None = None,
) -> Plans:
    """Return the boundary problems of scenes, which end at rest, as plans without motions.

    Args:
        problem: The robot's problem. Obstacles of the scenes are added to its own.
        scenes: The scenes.
        goals: Joint positions at the goals in the order of the planned joints, shape
            (n,) each; by default the first goal state of each scene.
        capacity: Numbers of obstacles, see ``capacity_of``.
        sample_id: Sample IDs; by default the indices of the scenes.

    Raises:
        SceneError: A scene lacks a planned joint or a goal state, or a position is
            outside its limits.
    """
    check_scenes(scenes)
    full = with_capacity(problem, capacity_of(scenes) if capacity is None else capacity)
    record = record_problem(full)
    robot = open_problem(record)[1]
    # The start places the frames of links, so it is needed before the scene is placed.
    start = np.array([start_state(scene, robot) for scene in scenes])
    scenes = [
        placed_scene(scene, robot, q) for scene, q in zip(scenes, start, strict=True)
    ]
    refuse_changes(scenes, "solve_scenes changes the problem for them")
    start_dq = np.array([start_velocity(scene, robot) for scene in scenes])
    if goals is None:
        goals = [goal_states(scene, robot)[0] for scene in scenes]
    goal_q = numbers("goals", goals)
    if goal_q.shape != start.shape:
        text = f"must have shape {start.shape}, got {goal_q.shape}"
        raise UsageError(text, argument="goals")
    zero, spec, count = np.zeros_like(start), problem.trajectory, len(scenes)
    fixed = len(problem.obstacle)
    ids = None if sample_id is None else numbers("sample_id", sample_id, "int64")
    poses = np.array([poses_of_scene(full, fixed, scene) for scene in scenes])
    return make_plans(
        record,
        Boundary(start, start_dq, zero, goal_q, zero, None),
        path_control_points=np.full((count, spec.path_control_points, robot.n), np.nan),
        rate_control_points=np.full((count, spec.rate_control_points), np.nan),
        columns={OBSTACLE_POSES: poses},
        sample_id=ids,
        source=_source(scenes),
    )


def _source(scenes: Sequence[SceneProblem]) -> str:
    """Return the source of plans: the files, and their elements whose loss the caller accepted."""
    files = list(dict.fromkeys(scene.source for scene in scenes if scene.source))
    if not files:
        return ""
    others = f" and {len(files) - 1} other files" if len(files) > 1 else ""
    names = sorted({name for scene in scenes for name in scene.request.accepted})
    without = f", without {', '.join(names)}" if names else ""
    return f"scenes of {files[0]}{others}{without}"


def start_state(scene: SceneProblem, robot: Robot) -> Array:
    """Return the start state of a scene in the order of the planned joints [rad], shape (n,)."""
    return np.asarray(joint_order(scene, robot, scene.start_q[None], "start")[0])


def start_velocity(scene: SceneProblem, robot: Robot) -> Array:
    """Return the start velocity of a scene in the order of the planned joints [rad/s], shape (n,).

    Raise SceneError if a joint that is not planned moves.
    """
    velocity = scene.request.start_velocity(len(scene.start_q))
    if not scene.joint_names:
        return velocity
    moving = [
        name
        for name, rate in zip(scene.joint_names, velocity, strict=True)
        if rate and name not in robot.joint_names
    ]
    if moving:
        raise SceneError(
            f"{scene.place}: the joint {moving[0]!r} moves at the start and is not planned"
        )
    return velocity[[scene.joint_names.index(name) for name in robot.joint_names]]


def goal_states(scene: SceneProblem, robot: Robot) -> Array:
    """Return the goal states of a scene by ``joint_order``, shape (G, n).

    Raise SceneError for a scene without any.
    """
    if not len(scene.goal_q):
        raise SceneError(f"{scene.place} has no goal state")
    _check_still_joints(scene, robot)
    return joint_order(scene, robot, _within_limits(scene, robot), "goal")


def goal_tolerances(scene: SceneProblem, robot: Robot) -> tuple[Array, Array]:
    """Return the tolerances of the goal states below and above them [rad], shape (G, n), for the planned joints."""
    columns = _columns(scene, robot)
    zero = np.zeros_like(scene.goal_q)
    below, above = (
        np.asarray(zero if each is None else each)[:, columns]
        for each in (scene.request.goal_below, scene.request.goal_above)
    )
    return below, above


def _columns(scene: SceneProblem, robot: Robot) -> list[int]:
    """Return the columns of the planned joints in the states of a scene; those of missing joints are left out."""
    if not scene.joint_names:
        return list(range(len(scene.start_q)))
    names = [name for name in robot.joint_names if name in scene.joint_names]
    return [scene.joint_names.index(name) for name in names]


def _within_limits(scene: SceneProblem, robot: Robot) -> Array:
    """Return the goal states of a scene, moved into the joint limits as far as their tolerances allow."""
    request = scene.request
    columns = _columns(scene, robot)
    states = np.array(scene.goal_q, float)
    if request.goal_below is None or len(columns) != robot.n:
        return states
    below, above = goal_tolerances(scene, robot)
    goals = states[:, columns]
    # The nearest state within the limits, then the nearest to it within the tolerances
    # of the goal.
    clipped = np.clip(goals, robot.position_lower, robot.position_upper)
    states[:, columns] = np.clip(clipped, goals - below, goals + above)
    return states


def _check_still_joints(scene: SceneProblem, robot: Robot) -> None:
    """Raise SceneError if a joint that is not planned would have to move to a goal."""
    below, above = (
        np.zeros_like(scene.goal_q) if each is None else each
        for each in (scene.request.goal_below, scene.request.goal_above)
    )
    shift = scene.start_q - scene.goal_q
    # A joint that stays at the start meets the goal if -below <= start - goal <= above.
    violation = np.maximum(shift - above, -shift - below)
    for index, name in enumerate(scene.joint_names):
        if name in robot.joint_names or not len(scene.goal_q):
            continue
        # One goal state that needs no motion of the joint is enough.
        if violation[:, index].min() > JOINT_TOLERANCE_RAD:
            raise SceneError(
                f"{scene.place}: the goal moves the joint {name!r} from {scene.start_q[index]:g}"
                f" to {scene.goal_q[0, index]:g}, and the robot's problem does not plan it"
            )


def joint_order(scene: SceneProblem, robot: Robot, states: Array, end: str) -> Array:
    """Return states of a scene in the order of the planned joints [rad], shape (G, n), clipped to the limits.

    A missing joint, or a position outside of its limits by more than 1e-3 rad, raises
    SceneError.
    """
    if scene.joint_names:
        missing = [name for name in robot.joint_names if name not in scene.joint_names]
        if missing:
            raise SceneError(
                f"{scene.place} has no joint {missing[0]!r}, only {', '.join(scene.joint_names)}"
            )
        states = states[
            :, [scene.joint_names.index(name) for name in robot.joint_names]
        ]
    if states.shape[1] != robot.n:
        raise SceneError(
            f"{scene.place} has {states.shape[1]} joint positions at the {end}, the robot has {robot.n}"
        )
    violation = np.maximum(robot.position_lower - states, states - robot.position_upper)
    if violation.size and violation.max() > JOINT_TOLERANCE_RAD:
        goal, joint = np.unravel_index(violation.argmax(), violation.shape)
        low = robot.position_lower[joint]
        high = robot.position_upper[joint]
        value = float(states[goal, joint])
        unit = "m" if robot.prismatic[joint] else "rad"
        raise SceneError(
            f"{scene.place}: {robot.joint_names[joint]} is {value:.4f} {unit} at the {end}, outside of its limits"
            f" [{low:.4f}, {high:.4f}] {unit}{suggested_unit(value, unit, low, high)}"
        )
    # Violations up to the tolerance are rounding, and removed.
    return np.clip(states, robot.position_lower, robot.position_upper)


def poses_of_scene(problem: Problem, fixed: int, scene: SceneProblem) -> Array:
    """Return the poses and sizes of the problem's own obstacles and those of a scene, shape (width,)."""
    numbers = place_obstacles(problem.obstacle)
    slices = number_slices(problem.obstacle)
    free: dict[str, list[int]] = {}
    for index, obstacle in enumerate(problem.obstacle[fixed:], fixed):
        free.setdefault(shape_of(obstacle), []).append(index)
    for obstacle in scene.obstacles:
        if not free.get(shape_of(obstacle)):
            raise UsageError(
                f"{scene.place} has more obstacles of the kind {obstacle.kind} than the capacity",
                concerns="capacity",
            )
        # The first free place of the shape: places that remain stay parked.
        own = place_obstacles([obstacle])
        part = slices[free[shape_of(obstacle)].pop(0)]
        # Places of boxes have rotation matrices, also for an obstacle that is upright.
        if obstacle.kind == "box":
            box = primitives_of([obstacle], own)
            own = np.concatenate(
                [box.centers[0], box.sizes[0], box.rotations[0].ravel()]
            )
        numbers[part] = own
    return numbers


def with_wider_capacity(
    plans: Plans, problem: Problem, own: Capacity, capacity: Capacity
) -> Plans:
    """Return plans of a problem's own capacity with parked obstacles up to another one, so that they fit one file."""
    before = with_capacity(problem, own).obstacle
    after = with_capacity(problem, capacity)
    poses = np.tile(place_obstacles(after.obstacle), (len(plans), 1))
    # Parked obstacles have equal names in both capacities: places are matched by name.
    positions = {
        obstacle.name: part
        for obstacle, part in zip(
            after.obstacle, number_slices(after.obstacle), strict=True
        )
    }
    for obstacle, part in zip(before, number_slices(before), strict=True):
        poses[:, positions[obstacle.name]] = plans.columns[OBSTACLE_POSES][:, part]
    assert poses.shape[1] == pose_width(after.obstacle)
    return replace(
        plans,
        problem=record_problem(after),
        columns={**plans.columns, OBSTACLE_POSES: poses},
    )
