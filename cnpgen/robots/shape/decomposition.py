"""Convex decomposition of a mesh: its triangles are assigned to the parts that CoACD finds.

CoACD (Wei et al. 2022, ACM Transactions on Graphics 41(4)) remeshes its input, so its parts miss points of the original
mesh. Its parts therefore only group the triangles: each part is the convex hull of its triangles and contains them.
"""

import hashlib
import io
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import MachineError, RecipeError, requires_extra
from cnpgen.robots.shape.hull import hull_corners
from cnpgen.store.files.atomic import write_file

Array = NDArray[np.float64]

MAX_CONVEX_VOLUME_RATIO = 1.05  # hull volume / mesh volume up to which the hull is used without decomposition
MIN_VOLUME_REDUCTION = 0.95  # total volume of the parts / hull volume below which the decomposition is used
MAX_TRIANGLE_OVERHANG_M = 5e-3  # a triangle that extends further out of every part is cut in two
MAX_CUTS = 12  # per triangle
COACD_TIMEOUT_S = 900.0  # CoACD takes about ten seconds for a link
SEED = 1
DECOMPOSITION_REVISION = 1  # of the assignment of triangles; cached parts of another revision are ignored


def convex_parts(points: Array, triangles: NDArray[np.int64], most: int, keep: Path | None) -> list[Array]:
    """Decompose a mesh into convex parts that together cover its surface.

    Args:
        points: Points of the mesh [m], shape (N, 3).
        triangles: Triangles as indices of points, shape (T, 3).
        most: Maximum number of parts.
        keep: Cache folder, since a decomposition takes up to a minute; None for no cache.

    Returns:
        Corners of each part [m], shape (V, 3); those of the hull if the parts are hardly smaller.

    Raises:
        MissingExtraError: CoACD is not installed.
        RecipeError: CoACD cannot decompose the mesh.
    """
    whole = hull_corners(points)
    if _volume_of_hull(whole) <= MAX_CONVEX_VOLUME_RATIO * abs(np.linalg.det(points[triangles]).sum()) / 6:
        return [whole]
    points, same = np.unique(points, axis=0, return_inverse=True)  # STL repeats the points of every triangle
    triangles = same.reshape(-1)[triangles]
    name = f"parts-{_identity(points, triangles, most)}.npz"
    kept = None if keep is None else keep / name
    if kept is not None:
        with suppress(OSError, ValueError, KeyError):
            return _read(kept)
    parts = assign_triangles(points[triangles], [hull_corners(part) for part in _run_coacd(points, triangles, most)])
    if sum(map(_volume_of_hull, parts)) >= MIN_VOLUME_REDUCTION * _volume_of_hull(whole):
        parts = [whole]
    if kept is not None:
        with suppress(MachineError):
            write_file(kept, _written(parts))
    return parts


def _identity(points: Array, triangles: NDArray[np.int64], most: int) -> str:
    """Return a digest of the inputs of a decomposition."""
    with requires_extra("decompose", "CoACD (for robot.convex_parts)"):
        version = metadata.version("coacd")
    numbers = b"".join(np.ascontiguousarray(each).tobytes() for each in (points, triangles.astype("<i8")))
    about = f"{DECOMPOSITION_REVISION} {version} {most} {SEED} {len(points)} "
    return hashlib.sha256(about.encode() + numbers).hexdigest()[:32]


def assign_triangles(triangles: Array, parts: list[Array]) -> list[Array]:
    """Assign triangles to the nearest parts and return the convex hulls, which together cover all triangles.

    Args:
        triangles: Corners of the triangles [m], shape (T, 3, 3).
        parts: Corners of the convex parts [m], shapes (V, 3).

    Returns:
        Corners of the hulls [m] of parts with triangles.
    """
    from scipy.spatial import ConvexHull

    planes = [ConvexHull(part).equations for part in parts]
    dealt: list[list[Array]] = [[] for _ in parts]
    for cut in range(MAX_CUTS + 1):
        if not len(triangles):
            break
        outside = np.array([(triangles @ each[:, :3].T + each[:, 3]).max(axis=(1, 2)) for each in planes])
        done = (outside.min(axis=0) <= MAX_TRIANGLE_OVERHANG_M) | (cut == MAX_CUTS)
        for part, mine in enumerate(outside.argmin(axis=0)[done] == np.arange(len(parts))[:, None]):
            dealt[part].append(triangles[done][mine].reshape(-1, 3))
        triangles = _cut_in_two(triangles[~done])
    points = [np.concatenate(each) for each in dealt]
    return [hull_corners(each) for each in points if len(each)]


def _cut_in_two(triangles: Array) -> Array:
    """Bisect triangles, shape (T, 3, 3), at the midpoint of their maximum side, shape (2 T, 3, 3)."""
    side = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2).argmax(axis=1)
    order = (side[:, None] + np.arange(3)) % 3
    a, b, c = (np.take_along_axis(triangles, order[:, k, None, None], axis=1)[:, 0] for k in range(3))
    midpoint = (a + b) / 2
    return np.concatenate([np.stack([a, midpoint, c], axis=1), np.stack([midpoint, b, c], axis=1)])


def _volume_of_hull(corners: Array) -> float:
    from scipy.spatial import ConvexHull

    return float(ConvexHull(corners).volume)


def _run_coacd(points: Array, triangles: NDArray[np.int64], most: int) -> list[Array]:
    """Return the points of CoACD's parts [m]; CoACD runs in a separate process, since it conflicts with Pinocchio."""
    with tempfile.TemporaryDirectory(prefix="cnpgen-") as folder:
        mesh, answer = Path(folder) / "mesh.npz", Path(folder) / "parts.npz"
        np.savez(mesh, points=points, triangles=triangles, most=most)
        command = [sys.executable, "-m", "cnpgen.robots.shape.decomposition", str(mesh), str(answer)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=COACD_TIMEOUT_S, check=False)
            return _read(answer)
        except subprocess.TimeoutExpired as error:
            raise RecipeError([f"CoACD did not decompose a mesh in {COACD_TIMEOUT_S:g} s"]) from error
        except (OSError, ValueError, KeyError) as error:
            said = (done.stderr or done.stdout).strip().splitlines()[-1:]
            raise RecipeError([f"CoACD cannot decompose a mesh: {' '.join(said)}"]) from error


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


def _main(mesh: str, answer: str) -> None:
    """Decompose the mesh of a file, in a process that imports only CoACD."""
    import coacd

    coacd.set_log_level("off")
    with np.load(mesh) as content:
        given = coacd.Mesh(content["points"], content["triangles"])
        parts = coacd.run_coacd(given, max_convex_hull=int(content["most"]), seed=SEED)
    Path(answer).write_bytes(_written([points for points, _ in parts]))


if __name__ == "__main__":
    _main(*sys.argv[1:])
