"""Path constraints of MoveIt's motion plan requests, as constraints on every state."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from cnpgen.addons.scene_files.document_values import part, vector
from cnpgen.addons.scene_files.link_constraints import (
    MIN_LIMIT_RAD,
    MIN_REGION_M,
    LinkOrientation,
    LinkPosition,
)
from cnpgen.addons.scene_files.moveit_frames import IDENTITY, FrameTable, frame_id
from cnpgen.addons.scene_files.moveit_goals import check_weight, orientation_of
from cnpgen.addons.scene_files.moveit_shapes import built, read_regions
from cnpgen.arrays import Vector3
from cnpgen.problems.constraints.constraint import LinkConstraint
from cnpgen.problems.scenes.placement import moved_obstacle
from cnpgen.problems.scenes.quaternions import roll_pitch_yaw
from cnpgen.problems.scenes.scene_problem import SceneError
from cnpgen.robots.obstacle import Obstacle

PATH = "path_constraints"


def read_path_constraints(
    request: Any, table: FrameTable, where: str
) -> Iterator[tuple[str, LinkConstraint]]:
    """Yield the constraints of a path with their frames; those that are not supported are refused."""
    where = f"{where}: {PATH}"
    constraints = part(request, PATH, dict, where)
    for key, text in (
        ("joint_constraints", "give ranges of joints by 'position' in [limits]"),
        ("visibility_constraints", "visibility is not supported"),
    ):
        if constraints:
            constraints.refuse(key, text)
    for entry in part(constraints, "orientation_constraints", list, where):
        frame, link = _frame_and_link(entry, where)
        rotation, limits, kind = orientation_of(entry, where)
        if limits.min() < MIN_LIMIT_RAD:
            raise SceneError(
                f"{where}: orientation tolerances must be at least {MIN_LIMIT_RAD:g} rad,"
                f" got {limits.tolist()}"
            )
        frame, pose = table.resolve(frame, (np.zeros(3), rotation))
        a, b, c = limits.tolist()
        constraint = LinkOrientation(
            link=link,
            rpy=roll_pitch_yaw(pose[1]),
            limits=(a, b, c),
            parametrization=kind,
        )
        yield frame, constraint
    for entry in part(constraints, "position_constraints", list, where):
        frame, link = _frame_and_link(entry, where)
        check_weight(entry, where)
        frame, pose = table.resolve(frame, (np.zeros(3), np.eye(3)))
        placed = tuple(moved_obstacle(each, pose) for each in _regions(entry, where))
        offset = _offset(entry, where)
        yield frame, LinkPosition(link=link, offset=offset, region=placed)


def _frame_and_link(entry: Any, where: str) -> tuple[str, str]:
    link = part(entry, "link_name", str, where)
    if not link:
        raise SceneError(f"{where} has a constraint without link_name")
    return frame_id(entry, where), link


def _offset(entry: Any, where: str) -> Vector3:
    """Return the point of the link that a position constraint is about [m]."""
    value = entry.get("target_point_offset")
    x, y, z = (
        (0.0, 0.0, 0.0)
        if value is None
        else vector(value, "xyz", f"{where}: target_point_offset").tolist()
    )
    if not np.isfinite([x, y, z]).all():
        raise SceneError(f"{where}: target_point_offset must be finite")
    return x, y, z


def _regions(constraint: Any, where: str) -> list[Obstacle]:
    """Return the primitives of a constraint's region, one of which contains the point."""
    shapes = read_regions(constraint, "a region", where)
    if not shapes:
        raise SceneError(f"{where}: a region must have at least one primitive")
    for shape in shapes:
        if not (shape.sizes >= MIN_REGION_M).all():
            raise SceneError(
                f"{where}: dimensions of a region must be at least {MIN_REGION_M:g} m,"
                f" got {shape.sizes.tolist()!r:.60}"
            )
    return list(built("region", shapes, IDENTITY, where))
