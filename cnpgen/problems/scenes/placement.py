"""Placement of scenes: obstacles and goal poses in frames of links, moved to the frame of the robot's base."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError, listed, nearest
from cnpgen.problems.constraints.constraint import LinkConstraint
from cnpgen.problems.scenes.quaternions import roll_pitch_yaw
from cnpgen.problems.scenes.scene_problem import (
    GoalPose,
    SceneError,
    SceneProblem,
    checked_scene,
)
from cnpgen.problems.scenes.scene_request import (
    BASE_FRAMES,
    AttachedObject,
    SceneRequest,
)
from cnpgen.robots.chain import frame_of
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.urdf import urdf_tree
from cnpgen.schema.arguments import numbers

Pose = tuple[Array, Array]  # position [m] and rotation matrix

_LOG = logging.getLogger(__name__)


def placed_scene(scene: SceneProblem, robot: Robot, start: Array) -> SceneProblem:
    """Return a scene with all poses in the frame of the robot's base, and those of attached objects in their links.

    A robot of another name is a warning.

    Args:
        scene: The scene.
        robot: The robot.
        start: Joint positions at the start in the order of the planned joints [rad],
            shape (n,), which place the frames of links.

    Raises:
        SceneError: A frame or a link is unknown.
        UsageError: The start does not have a finite position of every planned joint.
    """
    q = numbers("start", start)
    if q.shape != (robot.n,) or not np.isfinite(q).all():
        text = f"must have {robot.n} finite joint positions for {scene.place}, got {q.tolist()!r:.80}"
        raise UsageError(text, argument="start")
    request = scene.request
    warn_of_another_robot(scene, robot)
    if not request.places:
        return scene
    frames = LinkFrames(scene, robot, q)
    obstacles, touchable = _placed_obstacles(scene, frames)
    goal = scene.goal_pose
    if goal is not None:
        goal = _moved_goal(goal, request.goal_frame, frames)
    poses = scene.other_goal_poses
    origins = request.other_goal_frames or ("",) * len(poses)
    pairs = zip(poses, origins, strict=True)
    others = tuple(_moved_goal(pose, frame, frames) for pose, frame in pairs)
    for link, *_ in request.link_sizes:
        frames.check_link(link, "a padding or scale")
    placed = replace(
        scene,
        obstacles=tuple(obstacles),
        goal_pose=goal,
        other_goal_poses=others,
        request=_placed_request(request, frames, touchable),
    )
    return checked_scene(placed)


def _placed_request(
    request: SceneRequest, frames: LinkFrames, touchable: Iterable[AttachedObject]
) -> SceneRequest:
    """Return a request without frames, whose second placement changes nothing."""
    carried = (_in_link(each, request, frames) for each in request.attached)
    return replace(
        request,
        obstacle_frames=(),
        obstacle_touch_links=(),
        goal_frame="",
        other_goal_frames=(),
        fixed_frames=(),
        attached=(*carried, *touchable),
        constraints=tuple(_in_world(request, frames)),
        constraint_frames=(),
    )


def _placed_obstacles(
    scene: SceneProblem, frames: LinkFrames
) -> tuple[list[Obstacle], list[AttachedObject]]:
    """Return the obstacles in the frame of the robot's base, and those that links may touch."""
    request = scene.request
    obstacles = list[Obstacle]()
    touchable = list[AttachedObject]()
    touching = request.obstacle_touch_links or ((),) * len(scene.obstacles)
    for index, (each, names) in enumerate(zip(scene.obstacles, touching, strict=True)):
        frame = request.frame_of(index)
        what = f"obstacle {each.name!r}"
        pose = frames.pose(frame, what)
        obstacle = moved_obstacle(each, pose) if frame else each
        # An obstacle that links may touch becomes a fixed body of the robot, whose
        # pairs can be left out.
        if links := _moving(names, request, frames, f"an allowed collision of {what}"):
            item = AttachedObject(each.name, "", (obstacle,), ("",), links)
            touchable.append(item)
        else:
            obstacles.append(obstacle)
    return obstacles, touchable


def _moved_goal(goal: GoalPose, frame: str, frames: LinkFrames) -> GoalPose:
    """Return a goal pose in the frame of the robot's base."""
    if not frame:
        return goal
    position, rotation = frames.pose(frame, "the goal pose")
    return replace(
        goal,
        # p' = p_frame + R_frame p, R' = R_frame R
        position=position + rotation @ goal.position,
        rotation=rotation @ goal.rotation,
    )


class LinkFrames:
    """Frames of the links of a robot at the start state of a scene."""

    def __init__(self, scene: SceneProblem, robot: Robot, start: Array) -> None:
        import pinocchio as pin

        self._scene = scene
        self._model = robot.model
        tree = urdf_tree(robot.urdf_text)
        self.links = tuple(link.get("name", "") for link in tree.findall("link"))
        # Links are placed at the start state.
        self._data = self._model.createData()
        pin.framesForwardKinematics(self._model, self._data, start)
        children = {child.get("link") for child in tree.iter("child")}
        for frame, is_base in scene.request.fixed_frames:
            # Only the root link has a constant pose in the base frame, the identity.
            if frame in self.links and (not is_base or frame in children):
                raise SceneError(
                    f"{scene.place}: its frame {frame!r} is a link of the robot, which"
                    " the transforms of the file cannot place"
                )

    def pose(self, frame: str, what: str) -> Pose:
        """Return the pose of a frame in the frame of the robot's base."""
        if frame in self.links:
            placement = self._data.oMf[frame_of(self._model, frame)]
            return np.array(placement.translation), np.array(placement.rotation)
        if frame in BASE_FRAMES:
            return np.zeros(3), np.eye(3)
        raise SceneError(
            f"{self._scene.place}: {what} is in the frame {frame!r}, which the robot"
            f" lacks{nearest(frame, self.links)}; expected world, a link of the robot,"
            f" an object or a fixed frame of the file; links: {listed(self.links, 12)}"
        )

    def moves(self, link: str) -> bool:
        """Return whether planned joints move a link."""
        # Joint 0 of Pinocchio is the universe, which does not move.
        return bool(self._model.frames[frame_of(self._model, link)].parentJoint)

    def check_moves(self, link: str, what: str, *, moves: bool) -> None:
        """Raise SceneError for a link that planned joints move, or for one that they do not move."""
        if link in self.links and self.moves(link) != moves:
            text = (
                "a link that planned joints move" if moves else "a frame of the world"
            )
            raise SceneError(
                f"{self._scene.place}: {what} names {link!r}, expected {text}"
            )

    def check_link(self, link: str, what: str) -> None:
        """Raise SceneError for an unknown link."""
        if link not in self.links:
            raise SceneError(
                f"{self._scene.place}: {what} names the link {link!r}, which the robot"
                f" lacks{nearest(link, self.links)}; links: {listed(self.links, 12)}"
            )


def moved_obstacle(obstacle: Obstacle, pose: Pose) -> Obstacle:
    """Return an obstacle after the motion of its frame by a pose."""
    position, rotation = pose
    if not position.any() and np.array_equal(rotation, np.eye(3)):
        # Its numbers stay exact.
        return obstacle
    # p' = p_frame + R_frame p
    x, y, z = (position + rotation @ np.array(obstacle.position)).tolist()
    if "rotation" not in obstacle.form.placement:
        return replace(obstacle, position=(x, y, z))
    turn = roll_pitch_yaw(rotation @ turned(*obstacle.rotation))
    return replace(obstacle, position=(x, y, z), rotation=turn)


def _in_world(request: SceneRequest, frames: LinkFrames) -> Iterator[LinkConstraint]:
    """Yield the constraints of a request in the frame of the robot's base."""
    origins = request.constraint_frames or ("",) * len(request.constraints)
    for constraint, frame in zip(request.constraints, origins, strict=True):
        what = "a constraint of the path"
        frames.check_link(constraint.link, what)
        frames.check_moves(constraint.link, what, moves=True)
        frames.check_moves(frame, what, moves=False)
        yield constraint.moved(*frames.pose(frame, what))


def _moving(
    names: tuple[str, ...], request: SceneRequest, frames: LinkFrames, what: str
) -> tuple[str, ...]:
    """Return the links among names that planned joints move, and the attached objects."""
    carried = {each.name for each in request.attached}
    for name in names:
        if name not in carried:
            frames.check_link(name, what)
    return tuple(name for name in names if name in carried or frames.moves(name))


def _in_link(
    item: AttachedObject, request: SceneRequest, frames: LinkFrames
) -> AttachedObject:
    """Return an attached object with the poses of its shapes in the frame of its link."""
    what = f"the attached object {item.name!r}"
    frames.check_link(item.link, what)
    _moving(item.touch_links, request, frames, what)
    # T_link_shape = T_base_link^-1 T_base_frame T_frame_shape
    position, rotation = frames.pose(item.link, what)
    shapes = []
    for shape, frame in zip(item.shapes, item.frames, strict=True):
        if frame == item.link:
            shapes.append(shape)
            continue
        origin, turn = frames.pose(frame, what)
        # R_link^T (p_frame - p_link) and R_link^T R_frame
        back = rotation.T @ (origin - position), rotation.T @ turn
        shapes.append(moved_obstacle(shape, back))
    return replace(item, shapes=tuple(shapes), frames=(item.link,) * len(item.shapes))


def warn_of_another_robot(scene: SceneProblem, robot: Robot) -> None:
    """Warn if the scene names another robot than the URDF."""
    expected = scene.request.robot_name
    actual = urdf_tree(robot.urdf_text).get("name", "") if expected else ""
    if expected != actual:
        _LOG.warning(
            "%s is for the robot %r, the URDF is that of %r: joints and links are matched by name",
            scene.source or "the scene",
            expected,
            actual,
        )
