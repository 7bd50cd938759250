"""A URDF that needs no other file: its meshes as the corners of their convex hulls, in ``data:`` addresses.

A plan, a dataset or a planner carries its problem as text; so the shape of the robot must be in the text, too.
"""

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.robots.shape.files import find_named_file
from cnpgen.robots.shape.hull import FARTHEST, MOST_CORNERS, hull_corners
from cnpgen.robots.urdf import urdf_tree

if TYPE_CHECKING:
    import coal

Array = NDArray[np.float64]

_INLINE = "data:application/octet-stream;base64,"  # followed by corners x, y, z [m] as little-endian float64
_MESHES = (".stl", ".dae", ".obj")
MOST_MESH_BYTES = 1 << 26  # of a file
_CAPSULES = "1.2"  # the version of URDF that has capsules


def with_inline_meshes(urdf: str, path: Path, packages: Sequence[Path] = ()) -> str:
    """Return a URDF with the hulls of its collision meshes in it; one that needs no change is returned as it is.

    Args:
        urdf: The text of the URDF.
        path: Its file, from which the meshes' places are told.
        packages: Folders in which packages are looked for.

    Raises:
        RecipeError: A mesh is missing or cannot be read; with all of them.
    """
    try:
        tree = urdf_tree(urdf)
    except ValueError:  # whoever reads the robot says so
        return urdf
    meshes = [mesh for mesh in tree.iterfind(".//collision/geometry/mesh") if not is_inline(mesh.get("filename", ""))]
    mistakes: list[str] = []
    for mesh in meshes:
        try:
            address = inline_mesh(find_named_file(mesh.get("filename", ""), path, packages), scale_of(mesh))
        except RecipeError as error:
            mistakes += error.mistakes
        else:
            mesh.set("filename", address)
            mesh.attrib.pop("scale", None)
    if mistakes:
        raise RecipeError(list(dict.fromkeys(mistakes)))
    unversioned = tree.find(".//collision/geometry/capsule") is not None and tree.get("version", "1.0") < _CAPSULES
    if unversioned:  # URDF's parser would complain on stderr about what it then leaves out
        tree.set("version", _CAPSULES)
    return ElementTree.tostring(tree, encoding="unicode") if meshes or unversioned else urdf


def mesh_files(urdf: str) -> list[str]:
    """List the mesh files that the collision geometry of a URDF names; inline meshes are none.

    Raises:
        ValueError: The text is no URDF.
    """
    meshes = urdf_tree(urdf).iterfind(".//collision/geometry/mesh")
    names = dict.fromkeys(mesh.get("filename", "") for mesh in meshes)
    return [name for name in names if not name.startswith(_INLINE)]


def points_of(mesh: ElementTree.Element) -> Array:
    """Return the corners of an inline mesh [m], shape (V, 3).

    Raises:
        ValueError: It is not inline.
    """
    name = mesh.get("filename", "")
    if not is_inline(name):
        raise ValueError(f"the mesh {name!r} is not in the text of the URDF")
    return corners_of(name)


def inline_mesh(path: Path, scale: Array) -> str:
    """Return the corners of the convex hull of a mesh file as a ``data:`` address.

    Args:
        path: The file.
        scale: Factors of x, y, z, shape (3,).

    Raises:
        RecipeError: It cannot be read.
    """
    return address_of(_hull_of_file(path, scale))


def address_of(corners: Array) -> str:
    """Return corners [m], shape (V, 3), as a ``data:`` address."""
    return _INLINE + base64.b64encode(corners.astype("<f8").tobytes()).decode()


def is_inline(address: str) -> bool:
    """Whether a mesh is given by its corners, not by the name of a file."""
    return address.startswith(_INLINE)


def corners_of(address: str) -> Array:
    """Return the corners of an inline mesh [m], shape (V, 3).

    Raises:
        ValueError: They are no finite numbers, three per corner.
    """
    corners = np.frombuffer(base64.b64decode(address.removeprefix(_INLINE)), "<f8").reshape(-1, 3).astype(float)
    if not len(corners) or not np.isfinite(corners).all():
        raise ValueError("a mesh has no corners, or some that are not finite")
    return corners


def scale_of(mesh: ElementTree.Element) -> Array:
    """Return the factors of a mesh's x, y and z, shape (3,).

    Raises:
        RecipeError: They are none.
    """
    try:
        scale = np.array([float(each) for each in mesh.get("scale", "1 1 1").split()])
    except ValueError:
        scale = np.zeros(0)
    if scale.shape != (3,) or not (np.isfinite(scale).all() and (scale != 0).all()):
        raise RecipeError([f"the scale of a mesh must be three numbers that are not 0, got {mesh.get('scale')!r}"])
    return scale


def _hull_of_file(path: Path, scale: Array) -> Array:
    """Return the corners of the convex hull of a mesh [m]."""
    points = read_mesh(path, scale)[0]
    if not len(points) or not (np.abs(points) <= FARTHEST).all():
        raise RecipeError([f"{path}: the mesh has no points, or some further off than {FARTHEST:,.0f} m"])
    corners = hull_corners(points)
    if len(corners) > MOST_CORNERS:
        found = f"the mesh's hull has {len(corners):,} corners"
        raise RecipeError([f"{path}: {found}, expected at most {MOST_CORNERS:,}: simplify the mesh"])
    return corners


def read_mesh(path: Path, scale: Array) -> tuple[Array, "coal.BVHModelBase"]:
    """Read a mesh: STL, DAE or OBJ.

    Args:
        path: The file.
        scale: Factors of its x, y and z, shape (3,).

    Returns:
        Its points [m], shape (N, 3), and the mesh as Coal has it.

    Raises:
        RecipeError: It cannot be read.
    """
    import coal

    if path.suffix.lower() not in _MESHES:
        raise RecipeError([f"{path}: not a mesh that can be read: expected one of {', '.join(_MESHES)}"])
    if (size := path.stat().st_size) > MOST_MESH_BYTES:
        raise RecipeError([f"{path}: has {size:,} bytes, expected a mesh of at most {MOST_MESH_BYTES:,}"])
    try:
        mesh = coal.MeshLoader().load(str(path), scale)
        return np.array(mesh.vertices(), float).reshape(-1, 3), mesh
    except (ValueError, RuntimeError, MemoryError) as error:
        said = [line for line in str(error).splitlines() if not line.startswith("Hint:")]
        raise RecipeError([f"{path}: not a mesh that can be read: {said[-1] if said else 'too large'}"]) from error
