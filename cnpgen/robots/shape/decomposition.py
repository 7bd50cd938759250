"""Convex decomposition of a mesh by planes: each cut reduces the total volume of the convex hulls most.

A plane across an axis of the mesh cuts the triangles of a part in two, as in the search
of CoACD (Wei et al. 2022, ACM Transactions on Graphics 41(4)), which chooses by
concavity. A part is the convex hull of its triangles, so the parts together cover the
mesh.
"""

import hashlib
import io
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.arrays import Array, Integers
from cnpgen.robots.shape.hull import hull_corners
from cnpgen.store.files.archives import read_arrays
from cnpgen.store.files.cache_entry import MAX_ENTRY_BYTES, read_entry, write_entry

# Planes between both ends of a part along each axis that are tried, and as many at
# faces.
CUTS_PER_AXIS = 9
FACE_TOLERANCE_M = 1e-4  # of the coordinates of points on a face
# By a cut, as a fraction of the hull volume of the mesh; smaller cuts are not made.
MIN_VOLUME_REDUCTION = 0.005
# Of the decomposition; cached parts of another revision are ignored.
DECOMPOSITION_REVISION = 2


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles of a mesh or of a part of it: points [m], shape (N, 3), and indices of points, shape (T, 3)."""

    points: Array
    triangles: Integers

    @property
    def used_points(self) -> Array:
        """The points of the triangles [m], shape (M, 3)."""
        used = np.zeros(len(self.points), bool)
        used[self.triangles] = True
        return self.points[used]

    @property
    def hull_volume(self) -> float:
        """Volume of the convex hull [m^3]; 0 for coplanar triangles."""
        from scipy.spatial import ConvexHull, QhullError

        try:
            return float(ConvexHull(self.used_points).volume)
        except (QhullError, ValueError):
            return 0.0


@dataclass(frozen=True)
class _Cut:
    """Best cut of a part with the volume by which it reduces the hulls [m^3], 0 for none, and both halves."""

    part: TriangleMesh
    reduction: float = 0.0
    halves: tuple[TriangleMesh, ...] = ()


def convex_parts(
    points: Array, triangles: Integers, most: int, keep: Path | None
) -> list[Array]:
    """Return the corners [m], shape (V, 3), of at most so many convex parts that together cover the surface of a mesh.

    Points [m] have shape (N, 3), triangles are indices of points, shape (T, 3). A cache
    folder keeps the result, which takes seconds; None for no cache.
    """
    kept = (
        None
        if keep is None
        else keep / f"parts-{_identity(points, triangles, most)}.npz"
    )
    if kept is not None:
        # A damaged entry is computed again.
        with suppress(ValueError):
            return _read(read_entry(kept))
    parts = [
        hull_corners(part.used_points)
        for part in cut_parts(TriangleMesh(points, triangles), most)
    ]
    if kept is not None:
        write_entry(kept, _written(parts))
    return parts


def _identity(points: Array, triangles: Integers, most: int) -> str:
    """Return a digest of the inputs of a decomposition."""
    numbers = b"".join(
        np.ascontiguousarray(each).tobytes()
        for each in (points, triangles.astype("<i8"))
    )
    about = f"{DECOMPOSITION_REVISION} {most} {len(points)} "
    return hashlib.sha256(about.encode() + numbers).hexdigest()[:32]


def cut_parts(mesh: TriangleMesh, most: int) -> list[TriangleMesh]:
    """Cut a mesh into at most so many parts whose convex hulls have a small total volume; triangles are cut, too."""
    # Splits stop where the hulls get hardly smaller.
    least = MIN_VOLUME_REDUCTION * mesh.hull_volume
    cuts = [_best_cut(mesh)]
    while len(cuts) < most:
        # Greedy: the part whose best cut removes most volume.
        best = max(range(len(cuts)), key=lambda index: cuts[index].reduction)
        if cuts[best].reduction <= least:
            break
        cuts += map(_best_cut, cuts.pop(best).halves)
    return [cut.part for cut in cuts]


def _best_cut(part: TriangleMesh) -> _Cut:
    best = _Cut(part)
    volume = part.hull_volume
    points = part.used_points
    for axis in range(3):
        for position in _cut_positions(points[:, axis]):
            halves = cut_mesh(part, axis, float(position))
            reduction = volume - sum(half.hull_volume for half in halves)
            if reduction > best.reduction:
                best = _Cut(part, reduction, halves)
    return best


def _cut_positions(coordinates: Array) -> list[float]:
    """Return positions of planes: evenly between both ends, and those of most points, such as faces across the axis."""
    low = float(coordinates.min())
    high = float(coordinates.max())
    # Faces across the axis are natural cuts; evenly spaced planes find the others.
    even = np.linspace(low, high, CUTS_PER_AXIS + 2)[1:-1]
    faces, counts = np.unique(
        np.round(coordinates / FACE_TOLERANCE_M), return_counts=True
    )
    common = (
        faces[np.argsort(-counts, kind="stable")[:CUTS_PER_AXIS]] * FACE_TOLERANCE_M
    )
    return sorted(
        {float(position) for position in [*even, *common] if low < position < high}
    )


def cut_mesh(
    mesh: TriangleMesh, axis: int, position: float
) -> tuple[TriangleMesh, TriangleMesh]:
    """Cut a mesh by a plane across axis 0, 1 or 2 at a position [m] into the triangles below and above it."""
    height = mesh.points[:, axis] - position
    upper = height[mesh.triangles] > 0
    # Triangles on both sides of the plane are cut into one tip and a quadrilateral.
    crossing = upper.any(axis=1) & ~upper.all(axis=1)
    is_tip_upper = upper[crossing].sum(axis=1) == 1
    # Alone on its side.
    tip = np.where(
        is_tip_upper, upper[crossing].argmax(axis=1), upper[crossing].argmin(axis=1)
    )
    order = (tip[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(mesh.triangles[crossing], order, axis=1).T
    # Linear interpolation of the height: the point where an edge meets the plane.
    on_ab, on_ac = (
        mesh.points[a]
        + (height[a] / (height[a] - height[end]))[:, None]
        * (mesh.points[end] - mesh.points[a])
        for end in (b, c)
    )
    points = np.concatenate([mesh.points, on_ab, on_ac])
    count = len(mesh.points)
    ab = count + np.arange(len(a))
    ac = count + len(a) + np.arange(len(a))
    tips = np.stack([a, ab, ac], axis=1)
    # The quadrilateral becomes two triangles.
    rests = np.concatenate(
        [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
    )
    is_rest_upper = np.tile(~is_tip_upper, 2)
    below = np.concatenate(
        [mesh.triangles[~upper.any(axis=1)], tips[~is_tip_upper], rests[~is_rest_upper]]
    )
    above = np.concatenate(
        [mesh.triangles[upper.all(axis=1)], tips[is_tip_upper], rests[is_rest_upper]]
    )
    return TriangleMesh(points, below), TriangleMesh(points, above)


def _written(parts: Sequence[Array]) -> bytes:
    """Return parts as the bytes of a file for ``_read``."""
    file = io.BytesIO()
    named: dict[str, Any] = {f"{number:04d}": part for number, part in enumerate(parts)}
    np.savez(file, **named)
    return file.getvalue()


def _read(entry: bytes | None) -> list[Array]:
    """Read parts; raise ValueError if there are none or if they are not finite."""
    if entry is None:
        raise ValueError("no entry, or a damaged one")
    arrays = read_arrays(entry, max_bytes=MAX_ENTRY_BYTES)
    parts = [np.asarray(arrays[name], float).reshape(-1, 3) for name in sorted(arrays)]
    if not parts or not all(np.isfinite(part).all() for part in parts):
        raise ValueError("no parts")
    return parts
