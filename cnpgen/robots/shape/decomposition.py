"""Convex decomposition of a mesh by planes: each cut reduces the total volume of the convex hulls most.

A plane across an axis of the mesh cuts the triangles of a part in two, as in the search of CoACD (Wei et al. 2022, ACM
Transactions on Graphics 41(4)), which chooses by concavity. A part is the convex hull of its triangles, so the parts
together cover the mesh.
"""

import hashlib
import io
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import MachineError
from cnpgen.robots.shape.hull import hull_corners
from cnpgen.store.files.atomic import write_file

Array = NDArray[np.float64]

CUTS_PER_AXIS = 9  # planes that are tried between both ends of a part along each axis
MIN_VOLUME_REDUCTION = 0.005  # by a cut, as a fraction of the hull volume of the mesh; smaller cuts are not made
DECOMPOSITION_REVISION = 2  # of the decomposition; cached parts of another revision are ignored


@dataclass(frozen=True)
class _Part:
    """Triangles of a part, with its best cut.

    Attributes:
        triangles: Corners of the triangles [m], shape (T, 3, 3).
        reduction: Volume by which the best cut reduces the hulls [m^3]; 0 if no cut does.
        below: Triangles on one side of the best cut.
        above: Triangles on its other side.
    """

    triangles: Array
    reduction: float
    below: Array
    above: Array


def convex_parts(points: Array, triangles: NDArray[np.int64], most: int, keep: Path | None) -> list[Array]:
    """Decompose a mesh into convex parts that together cover its surface.

    Args:
        points: Points of the mesh [m], shape (N, 3).
        triangles: Triangles as indices of points, shape (T, 3).
        most: Maximum number of parts.
        keep: Cache folder, since a decomposition takes seconds; None for no cache.

    Returns:
        Corners of each part [m], shape (V, 3); those of the hull if no cut reduces its volume.
    """
    kept = None if keep is None else keep / f"parts-{_identity(points, triangles, most)}.npz"
    if kept is not None:
        with suppress(OSError, ValueError, KeyError):
            return _read(kept)
    parts = [hull_corners(part.reshape(-1, 3)) for part in cut_parts(points[triangles], most)]
    if kept is not None:
        with suppress(MachineError):
            write_file(kept, _written(parts))
    return parts


def _identity(points: Array, triangles: NDArray[np.int64], most: int) -> str:
    """Return a digest of the inputs of a decomposition."""
    numbers = b"".join(np.ascontiguousarray(each).tobytes() for each in (points, triangles.astype("<i8")))
    about = f"{DECOMPOSITION_REVISION} {most} {len(points)} "
    return hashlib.sha256(about.encode() + numbers).hexdigest()[:32]


def cut_parts(triangles: Array, most: int) -> list[Array]:
    """Cut triangles into parts whose convex hulls have a small total volume.

    Args:
        triangles: Corners of the triangles [m], shape (T, 3, 3).
        most: Maximum number of parts.

    Returns:
        Corners of the triangles of each part [m], shape (T, 3, 3); triangles across a cut are cut in two.
    """
    least = MIN_VOLUME_REDUCTION * _hull_volume(triangles)
    parts = [_with_best_cut(triangles)]
    while len(parts) < most:
        best = max(range(len(parts)), key=lambda index: parts[index].reduction)
        if parts[best].reduction <= least:
            break
        part = parts.pop(best)
        parts += [_with_best_cut(part.below), _with_best_cut(part.above)]
    return [part.triangles for part in parts]


def _with_best_cut(triangles: Array) -> _Part:
    best = _Part(triangles, 0.0, triangles[:0], triangles[:0])
    volume = _hull_volume(triangles)
    for axis in range(3):
        low, high = triangles[..., axis].min(), triangles[..., axis].max()
        for position in np.linspace(low, high, CUTS_PER_AXIS + 2)[1:-1]:
            below, above = cut_triangles(triangles, axis, float(position))
            reduction = volume - _hull_volume(below) - _hull_volume(above)
            if reduction > best.reduction:
                best = _Part(triangles, reduction, below, above)
    return best


def cut_triangles(triangles: Array, axis: int, position: float) -> tuple[Array, Array]:
    """Cut triangles by a plane across an axis.

    Args:
        triangles: Corners of the triangles [m], shape (T, 3, 3).
        axis: 0, 1 or 2 for x, y or z.
        position: Position of the plane along the axis [m].

    Returns:
        Triangles below and above the plane, which together cover the given ones.
    """
    height = triangles[..., axis] - position
    below, above = (height <= 0).all(axis=1), (height > 0).all(axis=1)
    crossing = ~below & ~above
    upper = height[crossing] > 0
    alone = np.where(upper.sum(axis=1) == 1, upper.argmax(axis=1), (~upper).argmax(axis=1))  # corner on its side
    order = (alone[:, None] + np.arange(3)) % 3
    a, b, c = (np.take_along_axis(triangles[crossing], order[:, k, None, None], axis=1)[:, 0] for k in range(3))
    of_a, of_b, of_c = (np.take_along_axis(height[crossing], order[:, k, None], axis=1) for k in range(3))
    on_ab, on_ac = a + of_a / (of_a - of_b) * (b - a), a + of_a / (of_a - of_c) * (c - a)
    tips = np.stack([a, on_ab, on_ac], axis=1)
    rests = np.concatenate([np.stack([on_ab, b, c], axis=1), np.stack([on_ab, c, on_ac], axis=1)])
    is_upper = of_a[:, 0] > 0
    rest_is_upper = np.tile(~is_upper, 2)
    return (
        np.concatenate([triangles[below], tips[~is_upper], rests[~rest_is_upper]]),
        np.concatenate([triangles[above], tips[is_upper], rests[rest_is_upper]]),
    )


def _hull_volume(triangles: Array) -> float:
    """Return the volume of the convex hull of triangles [m^3]; 0 for coplanar ones."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(triangles.reshape(-1, 3)).volume)
    except (QhullError, ValueError):
        return 0.0


def _written(parts: Sequence[Array]) -> bytes:
    """Return parts as the bytes of a file for ``_read``."""
    file = io.BytesIO()
    named: dict[str, Any] = {f"{number:04d}": part for number, part in enumerate(parts)}
    np.savez(file, **named)
    return file.getvalue()


def _read(file: Path) -> list[Array]:
    """Read parts; raise ValueError if there are none or if they are not finite."""
    with np.load(file, allow_pickle=False) as content:
        parts = [np.asarray(content[name], float).reshape(-1, 3) for name in sorted(content.files)]
    if not parts or not all(np.isfinite(part).all() for part in parts):
        raise ValueError("no parts")
    return parts
