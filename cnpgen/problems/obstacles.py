"""Scenes of samples: obstacles at the ends of motions, values that depend on the goal, and capacities."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.problem import Problem
from cnpgen.robots.observation.primitives import KINDS
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.obstacle_shapes.obstacle_shape import shape_class
from cnpgen.robots.scene import PARKED_POSITION_M, Scene
from cnpgen.robots.solid import place_obstacles
from cnpgen.robots.table_frame import TableFrame, table_frame
from cnpgen.schema.arguments import integer

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

MAX_CAPACITY = 10_000  # obstacles of one kind
Capacity = Mapping[str, int]  # kind, or corners of a mesh -> number of obstacles
# Any rotation: boxes of scenes have rotation matrices.
_PARKED_ROTATION = 0.1, 0.1, 0.1
_PARKED_SIZE_M = 0.01


def scene_of(
    problem: Problem,
    start_xyz: Array,
    goal_xyz: Array,
    goal_velocity: Array | None = None,
    parameters: Array | None = None,
    *,
    obstacle_poses: Array | None = None,
) -> Scene:
    """Place the obstacles of N samples, compute the values that a constraint depends on, and append the parameters.

    An obstacle with ``below`` ends at the bottom of the object (at the tip without an
    object) at that end.

    Args:
        problem: The problem.
        start_xyz: Tip positions at the start [m], shape (N, 3).
        goal_xyz: Tip positions at the goal [m], shape (N, 3).
        goal_velocity: Tip velocities at the goal [m/s], shape (N, 3), for problems with
            a ``scene_constraint``.
        parameters: Parameters of the samples, shape (N, width), for problems with
            parameters; nominal by default.
        obstacle_poses: Poses and sizes of the obstacles of each sample, shape (N,
            width), in place of the problem's.
    """
    # The object is upright and centered at the tip: half of its height is below.
    half = 0.0 if problem.object is None else problem.object.size[2] / 2
    parts = []
    if problem.obstacle:
        bottoms = {"start": start_xyz[:, 2] - half, "goal": goal_xyz[:, 2] - half}
        parts.append(place_obstacles(problem.obstacle, bottoms))
    # Parameters without ranges have no columns.
    if not problem.parameters:
        parameters = None
    elif parameters is None:
        parameters = np.tile(problem.nominal_parameters, (len(start_xyz), 1))
    if (constraint := problem.scene_constraint) is not None:
        goal_velocity = _checked_velocity(problem, start_xyz, goal_xyz, goal_velocity)
        # The puck lies on the table, whose frame differs from sample to sample.
        if (frame := table_frame_of(problem, parameters)) is not None:
            goal_velocity = frame.along_table(goal_velocity)
            goal_xyz = frame.to_table(goal_xyz)
        parts.append(constraint.scene_values(goal_xyz, goal_velocity))
    if parameters is not None:
        parts.append(parameters)
    if len(parts) == 1:
        (poses,) = parts
    else:
        parts.append(np.empty((len(start_xyz), 0)))
        poses = np.concatenate(parts, axis=1)
    scene = Scene(tuple(problem.obstacle), poses)
    return scene if obstacle_poses is None else scene.with_poses(obstacle_poses)


def _checked_velocity(
    problem: Problem, start_xyz: Array, goal_xyz: Array, velocity: Array | None
) -> Array:
    """Return the tip velocities at the goal, which a constraint on scenes needs, in the shape of the positions."""
    if velocity is None:
        raise UsageError(
            f"is missing: the problem {problem.name!r} needs it",
            argument="goal_velocity",
        )
    shapes = [xyz.shape for xyz in (start_xyz, goal_xyz, velocity)]
    if set(shapes) != {(len(start_xyz), 3)}:
        raise UsageError(
            f"positions and velocities must have one shape (N, 3), got {shapes}"
        )
    return velocity


def table_frame_of(problem: Problem, parameters: Array | None) -> TableFrame | None:
    """Return the frame of the table of N samples, with parameters of shape (N, width); None if none move it."""
    if parameters is None or not problem.parameters.tilts_table:
        return None
    return table_frame(problem.parameters, problem.table_origin, parameters)


def goal_velocities(
    problem: Problem, robot: Robot, goal_q: Array, goal_dq: Array
) -> Array | None:
    """Compute tip velocities at the goals with Pinocchio [m/s], shape (N, 3); None if the problem needs none.

    Joint positions [rad] and velocities [rad/s] at the goals have shape (N, n).
    """
    from cnpgen.world.path import PathWorld

    if problem.scene_constraint is None:
        return None
    if not len(goal_q):
        return np.empty((0, 3))
    world = PathWorld(robot)
    # Accelerations do not affect velocities of the tip.
    world.set_path(goal_q.T, goal_dq.T, np.zeros(goal_q.T.shape), np.empty(0))
    return world.tip_velocity.T


def with_capacity(problem: Problem, capacity: Capacity) -> Problem:
    """Return a problem with further obstacles, which stand far below the robot until a plan places them.

    Raises:
        UsageError: The problem cannot have further obstacles, or a capacity is no
            number of obstacles up to ``MAX_CAPACITY``.
    """
    for shape, count in capacity.items():
        if not isinstance(shape, str):
            raise UsageError(
                f"must be a mapping of kinds to numbers, got the kind {shape!r:.60}",
                argument="capacity",
            )
        integer("capacity", count, least=0, most=MAX_CAPACITY)
    error = ""
    if problem.first(RobotClearance) is None:
        error = "has no constraint robot-clearance: obstacles would be ignored"
    elif problem.parameters or problem.scene_constraint is not None:
        values = "values of each sample (parameters or a puck)"
        error = (
            f"has {values}, which are not supported among obstacles that samples place"
        )
    if error:
        raise UsageError(f"the problem {problem.name!r} {error}", concerns="problem")
    # The order of obstacles does not depend on the order of the mapping.
    shapes = [*KINDS, *sorted(capacity.keys() - set(KINDS))]
    parked = [
        _parked(shape, index)
        for shape in shapes
        for index in range(1, capacity.get(shape, 0) + 1)
    ]
    return problem.replaced(obstacle=(*problem.obstacle, *parked))


def _parked(kind: str, index: int) -> Obstacle:
    if kind not in KINDS:
        # The corners of a mesh are its kind; a part of their hash keeps names short.
        name = f"mesh {hashlib.sha256(kind.encode()).hexdigest()[:8]} {index}"
        return Obstacle(
            name=name,
            kind="mesh",
            mesh=kind,
            position=PARKED_POSITION_M,
            rotation=_PARKED_ROTATION,
        )
    parked = Obstacle(
        name=f"{kind} {index}",
        kind=kind,
        position=PARKED_POSITION_M,
        **shape_class(kind).with_sizes([_PARKED_SIZE_M] * 3),
    )
    return replace(parked, rotation=_PARKED_ROTATION) if kind == "box" else parked
