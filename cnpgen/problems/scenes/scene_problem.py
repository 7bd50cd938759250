"""Scene problem: one planning problem of a scene file, and its validation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.problems.scenes.quaternions import (
    quaternion_error,
    roll_pitch_yaw,
    rotation_matrix,
)
from cnpgen.problems.scenes.scene_request import NO_REQUEST, SceneRequest
from cnpgen.robots.observation.primitives import KINDS, depths_of_origin, primitives_of
from cnpgen.robots.obstacle import Obstacle, invalid_obstacle
from cnpgen.robots.obstacle_shapes.obstacle_shape import shape_class
from cnpgen.robots.shape.hull import MAX_COORDINATE_M, check_solid, hull_corners
from cnpgen.robots.shape.inline import address_of, is_inline
from cnpgen.robots.solid import place_obstacles
from cnpgen.schema.argument_types import check_fields, checked_arguments
from cnpgen.schema.arguments import numbers
from cnpgen.schema.units import PLAUSIBLE_MAX

MAX_SCENE_OBSTACLES = 100  # as many as a problem may have
MAX_SCENES = 100_000  # of one call
# Of the robot's base in an obstacle, such as the plate that it stands on.
MAX_BASE_DEPTH_M = 0.01
MIN_OBSTACLE_SIZE_M = 1e-6
MAX_ROTATION_ERROR = 1e-6  # of the products of the rows of a rotation matrix


class SceneError(UsageError):
    """A scene with invalid content; the message names file, scene and obstacle."""


@dataclass(frozen=True, eq=False)
class GoalPose:
    """Goal pose of a frame of the robot, in the frame of the robot's base.

    Attributes:
        frame: Name of the link or frame; empty for the problem's tip.
        position: Position [m], shape (3,).
        rotation: Rotation matrix, shape (3, 3).
        position_tolerance: Accepted displacements along the axes of the pose [m], a
            number or shape (3,).
        rotation_tolerance: Accepted components of the rotation vector in these axes
            [rad], a number or shape (3,). About an axis with pi or more, any rotation
            is accepted.
    """

    frame: str
    position: Array
    rotation: Array
    position_tolerance: float | Array = 0.0
    rotation_tolerance: float | Array = 0.0

    @property
    def tolerances(self) -> tuple[Array, Array]:
        """Tolerances of position [m] and rotation [rad], shape (3,) each."""
        position, rotation = (
            np.asarray(each, float)
            for each in (self.position_tolerance, self.rotation_tolerance)
        )
        return np.broadcast_to(position, 3), np.broadcast_to(rotation, 3)

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False)
class SceneProblem:
    """One planning problem in a scene: obstacles, a start, and a goal at rest.

    Attributes:
        name: Name of the scene, unique in its file.
        obstacles: Obstacles with poses in the frame of the robot's base, which is the
            world frame.
        start_q: Joint positions at the start [rad], shape (n,); empty if the file has
            none.
        goal_q: Goal states [rad], any of which is a goal, shape (G, n); G may be 0 with
            a goal pose.
        goal_pose: Goal pose, or None.
        joint_names: Names of the n joints; empty for the planned joints of the problem
            in their order.
        source: File of the scene, for messages.
        request: Further demands, such as a start velocity.
        other_goal_poses: Goal poses that are alternatives to the goal states, or to the
            goal pose without any.
    """

    name: str
    obstacles: tuple[Obstacle, ...]
    start_q: Array
    goal_q: Array
    goal_pose: GoalPose | None = None
    joint_names: tuple[str, ...] = ()
    source: str = ""
    request: SceneRequest = NO_REQUEST
    other_goal_poses: tuple[GoalPose, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)

    def __repr__(self) -> str:
        kinds = Counter(obstacle.kind for obstacle in self.obstacles)
        counts = (
            ", ".join(f"{count} x {kind}" for kind, count in sorted(kinds.items()))
            or "no obstacles"
        )
        return f"<scene {self.name!r}: {counts}>"

    @property
    def place(self) -> str:
        """File and scene, for messages."""
        return (
            f"{self.source}: scene {self.name!r}"
            if self.source
            else f"scene {self.name!r}"
        )


def make_obstacle(
    name: str,
    kind: str,
    sizes: Sequence[float] | Array,
    position: Array,
    wxyz: Array,
    *,
    place: str,
) -> Obstacle:
    """Build an obstacle from the numbers of a file; ``place`` is the file and scene, for messages.

    Sizes [m] are edge lengths, a radius, or a radius and a length along z (of a capsule
    without its round ends). The center [m], shape (3,), and the quaternion (w, x, y, z)
    are in the frame of the robot's base.
    """
    where = f"{place}: obstacle {name!r}"
    if kind not in KINDS:
        raise SceneError(f"{where} is a {kind}, expected one of {', '.join(KINDS)}")
    shape = shape_class(kind)
    sizes = _checked_numbers(where, "size", sizes, sum(shape.sizes().values()))
    position = _checked_numbers(where, "position", position, 3)
    wxyz = _checked_numbers(where, "quaternion", wxyz, 4)
    if (sizes < MIN_OBSTACLE_SIZE_M).any():
        raise SceneError(
            f"{where}: sizes must be at least {MIN_OBSTACLE_SIZE_M:g} m, got {sizes.tolist()}"
        )
    if text := quaternion_error(wxyz):
        raise SceneError(f"{where}: {text}")
    x, y, z = position.tolist()
    dimensions = shape.with_sizes(sizes.tolist())
    if "rotation" in shape.placement:
        dimensions["rotation"] = roll_pitch_yaw(rotation_matrix(wxyz))
    return Obstacle(name=name, kind=kind, position=(x, y, z), **dimensions)


def _checked_numbers(
    where: str, what: str, values: Sequence[float] | Array, count: int
) -> Array:
    """Return numbers of a file as an array; raise SceneError for another count or values that are not plausible."""
    array = np.asarray(values, float)
    if array.shape != (count,):
        raise SceneError(
            f"{where}: {what} must have {count} numbers, got {array.tolist()!r:.60}"
        )
    # Also false for nan.
    if not (np.abs(array) <= MAX_COORDINATE_M).all():
        raise SceneError(
            f"{where}: {what} must be finite and at most {MAX_COORDINATE_M:g}, got {array.tolist()}"
        )
    return array


@checked_arguments
def make_mesh(
    name: str,
    points: ArrayLike,
    position: ArrayLike = (0.0, 0.0, 0.0),
    rotation: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    *,
    place: str = "",
) -> Obstacle:
    """Build an obstacle from the points of a mesh; it is their convex hull.

    Args:
        name: Name of the obstacle.
        points: Points in the frame of the mesh [m], shape (V, 3).
        position: Origin of that frame in the frame of the robot's base [m], shape (3,).
        rotation: Rotation matrix of that frame, shape (3, 3).
        place: File and scene, for messages.

    Raises:
        SceneError: A number is not finite, or the points are not those of a body.
        UsageError: An argument has another shape.
    """
    where = f"{place}: obstacle {name!r}" if place else f"obstacle {name!r}"
    vertices = numbers("points", points)
    origin = numbers("position", position)
    turn = numbers("rotation", rotation)
    if not vertices.size:
        raise SceneError(f"{where} is a mesh without vertices", concerns="points")
    _check_shape("points", vertices, (*vertices.shape[:1], 3))
    _check_shape("position", origin, (3,))
    _check_shape("rotation", turn, (3, 3))
    # False for nan, too.
    if not (np.abs([*vertices.ravel(), *origin]) <= MAX_COORDINATE_M).all():
        text = f"points and position must be finite and at most {MAX_COORDINATE_M:g}"
        raise SceneError(f"{where}: {text}", concerns="points")
    if not is_rotation(turn):
        text = f"its rotation is no rotation matrix: {turn.tolist()}"
        raise SceneError(f"{where}: {text}")
    try:
        # Only the convex hull counts; a flat one has no interior and no depth.
        corners = hull_corners(vertices)
        check_solid(corners)
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from error
    x, y, z = origin.tolist()
    return Obstacle(
        name=name,
        kind="mesh",
        mesh=address_of(corners),
        position=(x, y, z),
        rotation=roll_pitch_yaw(turn),
    )


def _check_shape(argument: str, values: Array, shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        raise UsageError(
            f"must have shape {shape}, got {values.shape}", argument=argument
        )


def is_rotation(matrix: Array) -> bool:
    """Return whether a matrix of shape (3, 3) is a rotation up to rounding."""
    # R R^T = 1 and det R = 1; det R = -1 is a reflection.
    error = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(error <= MAX_ROTATION_ERROR and np.linalg.det(matrix) > 0)


def check_count(count: int, place: str) -> None:
    """Raise SceneError for more obstacles than a scene may have, before any is built."""
    if count > MAX_SCENE_OBSTACLES:
        raise SceneError(
            f"{place} has {count:,} obstacles, expected at most {MAX_SCENE_OBSTACLES}"
        )


def check_scenes(scenes: Sequence[SceneProblem]) -> None:
    """Check the type of every scene, the numbers of its obstacles, and that there is one."""
    if not scenes:
        raise UsageError("there are no scenes", concerns="scenes")
    for index, scene in enumerate(scenes):
        if not isinstance(scene, SceneProblem):
            raise UsageError(
                f"must be SceneProblems, got {scene!r:.100} at {index}",
                argument="scenes",
            )
        if error := invalid_obstacle(scene.obstacles):
            raise SceneError(f"{scene.place}: {error}")
        _refuse_packages(scene)
        for name, axes, expected in (("start_q", 1, "(n,)"), ("goal_q", 2, "(G, n)")):
            shape = np.shape(getattr(scene, name))
            if len(shape) != axes:
                raise SceneError(
                    f"{scene.place}: {name} must have shape {expected}, got {shape}"
                )


def _refuse_packages(scene: SceneProblem) -> None:
    """Raise SceneError for the shape of a package: capacities and files of scenes do not name its dimensions."""
    for obstacle in scene.obstacles:
        if obstacle.shape is not None:
            raise SceneError(
                f"{scene.place}: obstacle {obstacle.name!r} has the shape of a package, which problem files alone may"
                " have: give its hull, see make_mesh"
            )


def _check_pose(pose: GoalPose, place: str) -> None:
    """Raise SceneError for a goal pose with invalid numbers."""
    tolerances = pose.position_tolerance, pose.rotation_tolerance
    shapes = (
        np.shape(pose.position),
        np.shape(pose.rotation),
        *map(np.shape, tolerances),
    )
    if shapes[:2] != ((3,), (3, 3)) or not {(), (3,)}.issuperset(shapes[2:]):
        text = f"of shape (3,), (3, 3), and (3,) or () for tolerances, got {', '.join(map(str, shapes))}"
        raise SceneError(
            f"{place}: a goal pose has a position, a rotation and tolerances {text}"
        )
    if not (np.abs([*pose.position, *pose.rotation.ravel()]) <= MAX_COORDINATE_M).all():
        raise SceneError(
            f"{place}: the goal pose has numbers that are not finite or too large"
        )
    if not is_rotation(pose.rotation):
        raise SceneError(
            f"{place}: the rotation of the goal pose is no rotation matrix: {pose.rotation.tolist()}"
        )
    limits = PLAUSIBLE_MAX["m"], PLAUSIBLE_MAX["rad"]
    if any(
        (each > limit).any()
        for each, limit in zip(pose.tolerances, limits, strict=True)
    ):
        raise SceneError(
            f"{place}: tolerances of the goal pose are in m and rad, got {pose.tolerances}"
        )
    if not all((each >= 0).all() for each in pose.tolerances):
        raise SceneError(
            f"{place}: tolerances of the goal pose must not be negative, got {pose.tolerances}"
        )


def checked_scene(scene: SceneProblem) -> SceneProblem:
    """Check a scene and return it with unique names of obstacles."""
    check_count(len(scene.obstacles), scene.place)
    _refuse_packages(scene)
    for pose in (scene.goal_pose, *scene.other_goal_poses):
        if pose is not None:
            _check_pose(pose, scene.place)
    for what, values in (("start", scene.start_q), ("goal", scene.goal_q)):
        if not np.isfinite(values).all():
            raise SceneError(
                f"{scene.place}: the {what} has joint positions that are not finite"
            )
    for obstacle in scene.obstacles:
        if obstacle.kind == "mesh" and not is_inline(obstacle.mesh):
            raise SceneError(
                f"{scene.place}: obstacle {obstacle.name!r} is a mesh file, expected corners: see make_mesh"
            )
    counts = len(scene.start_q), len(scene.goal_q), len(scene.obstacles)
    if error := next(scene.request.errors(*counts), ""):
        raise SceneError(f"{scene.place}: {error}")
    # Messages and verdicts name obstacles.
    scene = replace(scene, obstacles=_uniquely_named(scene.obstacles))
    bodies = primitives_of(scene.obstacles, place_obstacles(scene.obstacles))
    # Poses in frames of links are not known yet.
    relative = [bool(scene.request.frame_of(i)) for i in range(len(scene.obstacles))]
    depths = np.where(relative, -np.inf, depths_of_origin(bodies))
    if len(depths) and depths.max() > MAX_BASE_DEPTH_M:
        name = scene.obstacles[int(depths.argmax())].name
        depth = float(depths.max())
        raise SceneError(
            f"{scene.place}: obstacle {name!r} contains the robot's base, the origin, at a depth of {depth:.3g} m,"
            f" expected at most {MAX_BASE_DEPTH_M:g} m: poses are relative to the base"
        )
    return scene


def _uniquely_named(obstacles: tuple[Obstacle, ...]) -> tuple[Obstacle, ...]:
    """Append numbers to names that occur more than once."""
    counts = Counter(obstacle.name for obstacle in obstacles)
    seen = Counter[str]()
    renamed = []
    for obstacle in obstacles:
        seen[obstacle.name] += 1
        suffix = f" {seen[obstacle.name]}" if counts[obstacle.name] > 1 else ""
        renamed.append(
            replace(obstacle, name=obstacle.name + suffix) if suffix else obstacle
        )
    return tuple(renamed)
