"""Convex parts of a mesh that is far from convex: its triangles, dealt out to the parts that CoACD finds.

CoACD (Wei et al. 2022, ACM Transactions on Graphics 41(4)) cuts a mesh that it has made anew, and misses points of the
given one. So it only says which triangles belong together: a part is the convex hull of those that are dealt to it,
and what has its three corners in a convex body is in it.
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

from cnpgen.errors import MachineError, RecipeError
from cnpgen.robots.shape.hull import hull_corners
from cnpgen.store.files.atomic import write_file

Array = NDArray[np.float64]

CONVEX = 1.05  # volume of the hull over that of the mesh, up to which the hull is as good as its parts
SMALLER = 0.95  # volume of all parts over that of the hull, below which they are worth it
ACROSS = 5e-3  # m: a triangle that reaches further out of every part is cut in two
CUTS = 12  # at most
PATIENCE = 900.0  # s: CoACD takes some ten seconds for a link
SEED = 1
REVISION = 1  # of how triangles are dealt out: what was kept of another one is not read


def convex_parts(points: Array, triangles: NDArray[np.int64], most: int, keep: Path | None) -> list[Array]:
    """Take a mesh apart into convex parts that together cover its surface.

    Args:
        points: Its points [m], shape (N, 3).
        triangles: Its triangles as numbers of points, shape (T, 3).
        most: How many parts there may be.
        keep: Folder in which parts are kept, since they take up to a minute to find; None to keep nothing.

    Returns:
        The corners of each part [m], shape (V, 3); those of the hull where parts are hardly smaller.

    Raises:
        MachineError: CoACD is not installed.
        RecipeError: CoACD cannot take the mesh apart.
    """
    whole = hull_corners(points)
    if _volume_of_hull(whole) <= CONVEX * abs(np.linalg.det(points[triangles]).sum()) / 6:
        return [whole]
    points, same = np.unique(points, axis=0, return_inverse=True)  # STL has the points of every triangle anew
    triangles = same.reshape(-1)[triangles]
    name = f"parts-{_identity(points, triangles, most)}.npz"
    kept = None if keep is None else keep / name
    if kept is not None:
        with suppress(OSError, ValueError, KeyError):
            return _read(kept)
    parts = dealt_out(points[triangles], [hull_corners(part) for part in _taken_apart(points, triangles, most)])
    if sum(map(_volume_of_hull, parts)) >= SMALLER * _volume_of_hull(whole):
        parts = [whole]
    if kept is not None:
        with suppress(MachineError):
            write_file(kept, _written(parts))
    return parts


def _identity(points: Array, triangles: NDArray[np.int64], most: int) -> str:
    """Return a digest of all that the parts depend on."""
    try:
        version = metadata.version("coacd")
    except metadata.PackageNotFoundError as error:
        raise MachineError("robot.convex_parts needs CoACD: pip install 'cnpgen[decompose]'") from error
    numbers = b"".join(np.ascontiguousarray(each).tobytes() for each in (points, triangles.astype("<i8")))
    about = f"{REVISION} {version} {most} {SEED} {len(points)} "
    return hashlib.sha256(about.encode() + numbers).hexdigest()[:32]


def dealt_out(triangles: Array, parts: list[Array]) -> list[Array]:
    """Return the convex hulls of the triangles that lie in each part or nearest to it; together they cover all of them.

    Args:
        triangles: Corners of the triangles [m], shape (T, 3, 3).
        parts: Corners of the convex parts [m], shapes (V, 3).

    Returns:
        Corners of the hulls, of parts that have a triangle.
    """
    from scipy.spatial import ConvexHull

    planes = [ConvexHull(part).equations for part in parts]
    dealt: list[list[Array]] = [[] for _ in parts]
    for cut in range(CUTS + 1):
        if not len(triangles):
            break
        outside = np.array([(triangles @ each[:, :3].T + each[:, 3]).max(axis=(1, 2)) for each in planes])
        done = (outside.min(axis=0) <= ACROSS) | (cut == CUTS)
        for part, mine in enumerate(outside.argmin(axis=0)[done] == np.arange(len(parts))[:, None]):
            dealt[part].append(triangles[done][mine].reshape(-1, 3))
        triangles = _cut_in_two(triangles[~done])
    points = [np.concatenate(each) for each in dealt]
    return [hull_corners(each) for each in points if len(each)]


def _cut_in_two(triangles: Array) -> Array:
    """Cut triangles, shape (T, 3, 3), through the middle of their longest sides, shape (2 T, 3, 3)."""
    longest = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2).argmax(axis=1)
    order = (longest[:, None] + np.arange(3)) % 3
    a, b, c = (np.take_along_axis(triangles, order[:, k, None, None], axis=1)[:, 0] for k in range(3))
    middle = (a + b) / 2
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def _volume_of_hull(corners: Array) -> float:
    from scipy.spatial import ConvexHull

    return float(ConvexHull(corners).volume)


def _taken_apart(points: Array, triangles: NDArray[np.int64], most: int) -> list[Array]:
    """Return the points of CoACD's parts [m]; it runs in a process of its own, as Pinocchio cannot bear it in one."""
    with tempfile.TemporaryDirectory(prefix="cnpgen-") as folder:
        mesh, answer = Path(folder) / "mesh.npz", Path(folder) / "parts.npz"
        np.savez(mesh, points=points, triangles=triangles, most=most)
        command = [sys.executable, "-m", "cnpgen.robots.shape.parts", str(mesh), str(answer)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
            return _read(answer)
        except subprocess.TimeoutExpired as error:
            raise RecipeError([f"CoACD did not take a mesh apart in {PATIENCE:g} s"]) from error
        except (OSError, ValueError, KeyError) as error:
            said = (done.stderr or done.stdout).strip().splitlines()[-1:]
            raise RecipeError([f"CoACD cannot take a mesh apart: {' '.join(said)}"]) from error


def _written(parts: Sequence[Array]) -> bytes:
    """Return parts as the bytes of a file that ``_read`` reads."""
    file = io.BytesIO()
    named: dict[str, Any] = {f"{number:04d}": part for number, part in enumerate(parts)}
    np.savez(file, **named)
    return file.getvalue()


def _read(file: Path) -> list[Array]:
    """Read parts; a ValueError says that there is none, or one that is not finite."""
    with np.load(file, allow_pickle=False) as content:
        parts = [np.asarray(content[name], float).reshape(-1, 3) for name in sorted(content.files)]
    if not parts or not all(np.isfinite(part).all() for part in parts):
        raise ValueError("no parts")
    return parts


def _main(mesh: str, answer: str) -> None:
    """Take the mesh of a file apart, in a process that has imported nothing but CoACD."""
    import coacd

    coacd.set_log_level("off")
    with np.load(mesh) as content:
        given = coacd.Mesh(content["points"], content["triangles"])
        parts = coacd.run_coacd(given, max_convex_hull=int(content["most"]), seed=SEED)
    Path(answer).write_bytes(_written([points for points, _ in parts]))


if __name__ == "__main__":
    _main(*sys.argv[1:])
