"""MoveIt's collision objects, their operations, and objects that the robot carries."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cnpgen.addons.scene_files.document_values import part, scalar
from cnpgen.addons.scene_files.moveit_frames import (
    IDENTITY,
    FrameTable,
    Pose,
    frame_id,
    optional_pose,
    pose_of,
)
from cnpgen.addons.scene_files.moveit_shapes import (
    ObjectShape,
    built,
    read_shapes,
    shape_poses,
)
from cnpgen.documents import Names
from cnpgen.problems.scenes.scene_problem import SceneError, check_count
from cnpgen.problems.scenes.scene_request import AttachedObject

_LOG = logging.getLogger(__name__)
OPERATIONS = ("ADD", "REMOVE", "APPEND", "MOVE")  # in the order of their codes


@dataclass(frozen=True, eq=False)
class CollisionObject:
    """Object of the world or of a link: its frame, its pose in it, its shapes and subframes."""

    name: str
    frame: str
    pose: Pose
    shapes: tuple[ObjectShape, ...]
    subframes: tuple[tuple[str, Pose], ...] = ()

    @property
    def origin(self) -> Pose:
        """Pose of the frame of the object; without a pose that of its only shape, as in MoveIt."""
        # Without a pose of its own, an object with one shape is placed by the shape.
        if self.pose is IDENTITY and len(self.shapes) == 1:
            return self.shapes[0].pose
        return self.pose


def read_world(scene: Any, place: str) -> dict[str, CollisionObject]:
    """Return the objects of a world by their names, after all operations in their order."""
    world = part(scene, "world", dict, place)
    entries = part(
        world if "collision_objects" in world else scene,
        "collision_objects",
        list,
        place,
    )
    check_count(len(entries), place)
    objects: dict[str, CollisionObject] = {}
    for entry in entries:
        _apply(objects, entry, place)
        # The count is checked after every message, before a later one removes shapes.
        check_count(sum(len(each.shapes) for each in objects.values()), place)
    return objects


def _apply(objects: dict[str, CollisionObject], entry: Any, place: str) -> None:
    """Apply the operation of one message to the objects of the world."""
    if not isinstance(entry, dict):
        raise SceneError(f"{place}: an object must be a mapping, got {entry!r:.60}")
    name = str(entry.get("id", "object"))
    where = f"{place}: obstacle {name!r}"
    operation = operation_of(entry, where)
    if operation == "REMOVE":
        _remove(objects, entry, where)
    elif operation == "MOVE":
        objects[name] = _moved(objects.get(name), entry, where)
    elif operation == "APPEND" and name in objects:
        objects[name] = _appended(objects[name], read_object(entry, where), where)
    # Objects without an id get numbered names instead.
    elif name in objects and "id" in entry:
        raise SceneError(
            f"{where} is added twice: ADD replaces the first; APPEND adds shapes, and different objects need different ids"
        )
    else:
        item = read_object(entry, where)
        if not item.shapes:
            raise SceneError(f"{where} has neither primitives nor meshes")
        objects[name if name not in objects else f"{name} {len(objects)}"] = item


def operation_of(entry: Any, where: str) -> str:
    """Return the operation of an object, from its code or its name; ADD without one."""
    value = entry.get("operation")
    text = "0" if value is None else str(value).strip().upper()
    codes = dict(zip("0123", OPERATIONS, strict=True))
    if text not in OPERATIONS and text not in codes:
        raise SceneError(
            f"{where}: operation must be 0 to 3 or one of {', '.join(OPERATIONS)}, got {value!r:.60}"
        )
    return codes.get(text, text)


def read_object(entry: Any, where: str) -> CollisionObject:
    """Return the object of a message, which may have no shapes."""
    shapes = tuple(read_shapes(entry, where))
    names = [str(name) for name in part(entry, "subframe_names", list, where)]
    poses = [
        pose_of(pose, f"{where}: subframe")
        for pose in part(entry, "subframe_poses", list, where)
    ]
    if len(names) != len(poses):
        raise SceneError(
            f"{where} has {len(names)} subframe_names and {len(poses)} subframe_poses, expected equal numbers"
        )
    _check_different(names, where)
    return CollisionObject(
        name=str(entry.get("id", "object")),
        frame=frame_id(entry, where),
        pose=optional_pose(entry, "pose", where),
        shapes=shapes,
        subframes=tuple(zip(names, poses, strict=True)),
    )


def _remove(objects: dict[str, CollisionObject], entry: Any, where: str) -> None:
    """Remove an object, or all of them without a name."""
    read_object(entry, where)
    name = str(entry.get("id", ""))
    if name and name not in objects:
        raise SceneError(f"{where} is removed, and the world has no such object")
    for each in [name] if name else list(objects):
        del objects[each]


def _moved(item: CollisionObject | None, entry: Any, where: str) -> CollisionObject:
    """Return an object after MOVE: with another pose, or other poses of its shapes."""
    if item is None:
        raise SceneError(f"{where} is moved, and the world has no such object")
    if part(entry, "primitives", list, where) or part(entry, "meshes", list, where):
        raise SceneError(f"{where} is moved and has shapes, expected poses only")
    poses = shape_poses(entry, where)
    if poses and len(poses) != len(item.shapes):
        raise SceneError(
            f"{where} is moved by {len(poses)} poses of shapes, and has {len(item.shapes)}"
        )
    shapes = (
        tuple(
            replace(shape, pose=pose)
            for shape, pose in zip(item.shapes, poses, strict=True)
        )
        if poses
        else item.shapes
    )
    pose = optional_pose(entry, "pose", where)
    if not poses and pose is IDENTITY:
        raise SceneError(f"{where} is moved without a pose")
    if not poses and item.pose is IDENTITY and len(item.shapes) == 1:
        # the only shape has the pose of the object, as in CollisionObject.origin
        shapes = (replace(item.shapes[0], pose=IDENTITY),)
    return replace(item, frame=frame_id(entry, where), pose=pose, shapes=shapes)


def _appended(
    item: CollisionObject, more: CollisionObject, where: str
) -> CollisionObject:
    """Return an object after APPEND, whose message has the frame and the pose of the object."""
    same = all(np.array_equal(a, b) for a, b in zip(item.pose, more.pose, strict=True))
    if more.frame != item.frame or not (same or more.pose is IDENTITY):
        raise SceneError(
            f"{where} is appended to in another frame or pose than it was added in"
        )
    _check_different([name for name, _ in (*item.subframes, *more.subframes)], where)
    return replace(
        item,
        shapes=(*item.shapes, *more.shapes),
        subframes=(*item.subframes, *more.subframes),
    )


def _check_different(names: list[str], where: str) -> None:
    """Raise SceneError for a subframe that an object has twice."""
    if twice := [name for name in names if names.count(name) > 1]:
        raise SceneError(f"{where} has the subframe {twice[0]!r} twice")


def add_object_frames(table: FrameTable, objects: dict[str, CollisionObject]) -> None:
    """Add the frames of objects and their subframes, ``object/subframe``."""
    for name, item in objects.items():
        table.add(name, item.frame, item.origin)
        for subframe, pose in item.subframes:
            table.add(f"{name}/{subframe}", name, pose)


def read_attached(
    state: Any, objects: dict[str, CollisionObject], where: str
) -> list[tuple[CollisionObject, AttachedObject]]:
    """Return the objects that a robot state attaches, and take them out of the world.

    An object without shapes is the one of the world with its name. Poses are placed
    later.
    """
    found = []
    for entry in part(state, "attached_collision_objects", list, where):
        body = part(entry, "object", dict, where)
        name = part(body, "id", str, where)
        place = f"{where}: attached object {name!r}"
        link = part(entry, "link_name", str, where)
        if not link:
            raise SceneError(f"{place} has no link_name")
        if operation_of(body, place) != "ADD":
            raise SceneError(f"{place}: operation must be ADD, which attaches it")
        # An attached object leaves the world, as it moves with the link from here on.
        item = read_object(body, place)
        known = objects.pop(name, None)
        if not item.shapes and known is None:
            raise SceneError(
                f"{place} has no shapes, and the world has no object of this name"
            )
        if not item.shapes and known is not None:
            item = known
        elif not item.frame:
            raise SceneError(
                f"{place} has no header.frame_id, expected {link!r} or another frame"
            )
        elif known is not None:
            _LOG.warning("%s takes the place of the object in the world", place)
        weight = entry.get("weight")
        mass = 0.0 if weight is None else scalar(weight, f"{place}: weight")
        if not 0 <= mass < np.inf:
            raise SceneError(
                f"{place}: weight must be positive, or 0 if it is unknown, got {mass:g}"
            )
        links = tuple(str(each) for each in part(entry, "touch_links", list, where))
        found.append((item, AttachedObject(name, link, (), (), links, mass)))
    return found


def with_touch_links(
    attached: AttachedObject, touching: Mapping[str, Names]
) -> AttachedObject:
    """Return an attached object with further links that may touch it, object -> links."""
    links = dict.fromkeys((*attached.touch_links, *touching.get(attached.name, ())))
    return replace(attached, touch_links=tuple(links))


def placed_attached(
    item: CollisionObject, attached: AttachedObject, table: FrameTable, place: str
) -> AttachedObject:
    """Return an attached object with its shapes in the frame of a link, or of the base."""
    frame, pose = table.resolve(item.frame, item.pose)
    shapes = tuple(built(item.name, item.shapes, pose, place))
    return replace(attached, shapes=shapes, frames=(frame,) * len(shapes))
