"""Octomaps of MoveIt's scenes: occupied cells of an octree as boxes.

The data are those of OctoMap (Hornung et al. 2013): depth first, with two bits per
child in binary trees, and a log-odds and a mask of children per node in full ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from cnpgen.addons.scene_files.document_values import part, scalar, vector
from cnpgen.addons.scene_files.moveit_collisions import is_true
from cnpgen.addons.scene_files.moveit_frames import (
    FrameTable,
    composed,
    frame_id,
    optional_pose,
)
from cnpgen.addons.scene_files.point_cloud import (
    MAX_POINTS,
    MIN_VOXEL_M,
    obstacles_of_points,
)
from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.problems.scenes.placement import moved_obstacle
from cnpgen.problems.scenes.scene_problem import MAX_SCENE_OBSTACLES, SceneError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.schema.units import PLAUSIBLE_MAX
from cnpgen.store.files.accounted import mark_read

VOXEL_ROUNDING = (
    1e-9  # by which voxels are smaller than cells, so that each has one center
)
DEPTH = 16  # levels of an octree below its root
MIN_RESOLUTION_M = 1e-3
MAX_RESOLUTION_M = 1.0
FREE, OCCUPIED, INNER = 1, 2, 3  # two bits of a child in a binary tree
Cell = tuple[int, int, int, int]  # lower corner in finest cells, and edge length


def read_octomap(
    world: Any, table: FrameTable, free: int, place: str
) -> Iterator[tuple[str, Obstacle]]:
    """Yield frames and boxes of the occupied cells of a world's octomap, at most ``free`` boxes.

    Boxes contain all occupied cells. They exceed them where there are too many.
    """
    message = part(world, "octomap", dict, place)
    tree = part(message, "octomap", dict, place)
    if not part(tree, "data", list, place):
        # An empty map has no frame; other keys may be misspelt ones.
        for key in ("header", "origin"):
            mark_read(part(message, key, dict, place))
        for key in ("id", "resolution", "binary"):
            tree.get(key)
        return
    where = f"{place}: octomap"
    kind = part(tree, "id", str, where)
    if kind != "OcTree":
        raise SceneError(f"{where}: id must be OcTree, got {kind!r:.60}")
    resolution = scalar(tree.get("resolution"), f"{where}: resolution")
    if not MIN_RESOLUTION_M <= resolution <= MAX_RESOLUTION_M:
        raise SceneError(
            f"{where}: resolution must be {MIN_RESOLUTION_M:g} to {MAX_RESOLUTION_M:g} m, got {resolution:g}"
        )
    data = _data(tree, where)
    is_binary = is_true(tree.get("binary"), f"{where}: binary")
    cells = decoded_cells(data, is_binary=is_binary, where=where)
    frame, pose = table.resolve(
        frame_id(message, where),
        composed(optional_pose(message, "origin", where), (np.zeros(3), np.eye(3))),
    )
    if not cells:
        return
    if free < 1:
        raise SceneError(
            f"{where}: the scene has {MAX_SCENE_OBSTACLES} obstacles beside it already"
        )
    for box in _boxes(cells, resolution, free, where):
        yield frame, moved_obstacle(box, pose)


def _data(tree: Any, where: str) -> bytes:
    """Return the bytes of an octree."""
    values = vector(part(tree, "data", list, where), "", f"{where}: data")
    if not (
        np.isfinite(values) & (np.abs(values) < 256) & (values == values.round())
    ).all():
        raise SceneError(f"{where}: data must be bytes")
    # Messages have signed bytes, octrees unsigned ones.
    return (values.astype(int) % 256).astype(np.uint8).tobytes()


def decoded_cells(data: bytes, *, is_binary: bool, where: str) -> list[Cell]:
    """Return the occupied leaves of an octree, in cells of the finest level from its lower corner."""
    cells: list[Cell] = []
    read = _read_binary if is_binary else _read_full
    try:
        end = read(data, 0, (0, 0, 0, 1 << DEPTH), cells)
    except (IndexError, ValueError) as error:
        raise SceneError(
            f"{where}: data are not those of an octree: {error}"
        ) from error
    if end != len(data):
        raise SceneError(
            f"{where}: data are not those of an octree: it ends after {end} of {len(data)} bytes"
        )
    return cells


def _children(cell: Cell) -> list[Cell]:
    """Return the eight children of a cell: bits 0 to 2 of the index are the upper halves along x, y and z."""
    x, y, z, edge = cell
    if edge == 1:
        raise ValueError(f"it has more than {DEPTH} levels")
    half = edge // 2
    return [
        (x + half * (i & 1), y + half * (i >> 1 & 1), z + half * (i >> 2 & 1), half)
        for i in range(8)
    ]


def _read_binary(data: bytes, at: int, cell: Cell, cells: list[Cell]) -> int:
    """Read an inner node of a binary tree; return the position behind it."""
    if at + 2 > len(data):
        raise ValueError(f"it is cut off at byte {at}")
    # Two bytes in little-endian order: bits 2 i and 2 i + 1 are those of child i.
    bits = data[at] | data[at + 1] << 8
    kinds = [bits >> 2 * child & 3 for child in range(8)]
    children = _children(cell)
    at = at + 2
    cells += [
        each for each, kind in zip(children, kinds, strict=True) if kind == OCCUPIED
    ]
    # Depth first: children with children follow in the order of their indices.
    for each, kind in zip(children, kinds, strict=True):
        if kind == INNER:
            at = _read_binary(data, at, each, cells)
    return at


def _read_full(data: bytes, at: int, cell: Cell, cells: list[Cell]) -> int:
    """Read a node of a full tree: log-odds as float32 and the mask of its children."""
    if at + 5 > len(data):
        raise ValueError(f"it is cut off at byte {at}")
    log_odds = np.frombuffer(data, "<f4", 1, at)[0]
    mask = data[at + 4]
    at = at + 5
    if not np.isfinite(log_odds):
        raise ValueError("a node has a log-odds that is not finite")
    if not mask and log_odds >= 0:
        # Probability of at least one half.
        cells.append(cell)
    for child, each in enumerate(_children(cell) if mask else []):
        if mask >> child & 1:
            at = _read_full(data, at, each, cells)
    return at


def _boxes(
    cells: list[Cell], resolution: float, free: int, where: str
) -> tuple[Obstacle, ...]:
    """Return boxes that contain all cells, along the axes of the octree."""
    # Leaves are divided into cells of the smallest leaf, whose centers are points.
    edge = min(cell[3] for cell in cells)
    # Cells above the largest resolution of point clouds are divided further.
    while edge * resolution > MAX_RESOLUTION_M:
        edge //= 2
    # The root is around the origin.
    center = 1 << DEPTH - 1
    corners = [
        side for x, y, z, size in cells for at in (x, y, z) for side in (at, at + size)
    ]
    reach = max(abs(side - center) for side in corners) * resolution
    if reach > PLAUSIBLE_MAX["m"]:
        raise SceneError(
            f"{where} reaches {reach:.3g} m from its origin, expected at most {PLAUSIBLE_MAX['m']:g} m"
        )
    # The number of points is known before their memory is used.
    count = sum((cell[3] // edge) ** 3 for cell in cells)
    if count > MAX_POINTS:
        raise SceneError(
            f"{where} has {count:,} occupied cells, expected at most {MAX_POINTS:,}"
        )
    points = np.concatenate([_centers(cell, edge) for cell in cells])
    size = edge * resolution
    # Cells are counted from the lower corner of the root, meters from its center.
    centers = (points - center) * resolution
    try:
        return obstacles_of_points(
            centers,
            radius=size / 2,
            resolution=max(size * (1 - VOXEL_ROUNDING), MIN_VOXEL_M),
            max_obstacles=free,
            name="octomap",
        )
    except UsageError as error:
        raise SceneError(f"{where}: {error}") from error


def _centers(cell: Cell, edge: int) -> Array:
    """Return the centers of the parts of a cell with an edge length, shape (K, 3)."""
    # Midpoints of equal parts along each axis.
    steps = (np.arange(cell[3] // edge) + 0.5) * edge
    axes = [start + steps for start in cell[:3]]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
