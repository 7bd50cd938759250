"""A URDF that needs no other file: its meshes as the corners of their convex hulls, in ``data:`` addresses.

A plan, a dataset or a planner carries its problem as text; so the shape of the robot must be in the text, too.
"""

import base64
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.robots.shape.files import find_named_file
from cnpgen.robots.shape.hull import FARTHEST, MOST_CORNERS, hull_corners
from cnpgen.robots.shape.parts import convex_parts
from cnpgen.robots.urdf import urdf_tree

if TYPE_CHECKING:
    import coal

Array = NDArray[np.float64]

_INLINE = "data:application/octet-stream;base64,"  # followed by corners x, y, z [m] as little-endian float64
_MESHES = (".stl", ".dae", ".obj")
MOST_MESH_BYTES = 1 << 26  # of a file
_CAPSULES = "1.2"  # the version of URDF that has capsules


def with_inline_meshes(
    urdf: str, path: Path, packages: Sequence[Path] = (), *, most: int = 1, keep: Path | None = None
) -> str:
    """Return a URDF with the hulls of its collision meshes in it; one that needs no change is returned as it is.

    Args:
        urdf: The text of the URDF.
        path: Its file, from which the meshes' places are told.
        packages: Folders in which packages are looked for.
        most: Into how many convex parts a mesh may be taken apart; 1 for its hull.
        keep: Folder in which parts are kept; None to keep nothing.

    Raises:
        RecipeError: A mesh is missing or cannot be read; with all of them.
        MachineError: Meshes are to be taken apart, and CoACD is not installed.
    """
    try:
        tree = urdf_tree(urdf)
    except ValueError:  # whoever reads the robot says so
        return urdf
    elements = [(link, element) for link in tree.iter("link") for element in link.findall("collision")]
    meshes = [(link, element, mesh) for link, element in elements if (mesh := _mesh_file(element)) is not None]
    mistakes: list[str] = []
    for link, element, mesh in meshes:
        try:
            file = find_named_file(mesh.get("filename", ""), path, packages)
            addresses = [address_of(each) for each in _parts_of_file(file, scale_of(mesh), most, keep)]
        except RecipeError as error:
            mistakes += error.mistakes
        else:
            mesh.attrib.pop("scale", None)
            _replace(link, element, mesh, addresses)
    if mistakes:
        raise RecipeError(list(dict.fromkeys(mistakes)))
    unversioned = tree.find(".//collision/geometry/capsule") is not None and tree.get("version", "1.0") < _CAPSULES
    if unversioned:  # URDF's parser would complain on stderr about what it then leaves out
        tree.set("version", _CAPSULES)
    return ElementTree.tostring(tree, encoding="unicode") if meshes or unversioned else urdf


def _mesh_file(collision: ElementTree.Element) -> ElementTree.Element | None:
    """Return the mesh of a <collision> element if it is one in a file."""
    mesh = collision.find("geometry/mesh")
    return None if mesh is None or is_inline(mesh.get("filename", "")) else mesh


def _replace(
    link: ElementTree.Element, collision: ElementTree.Element, mesh: ElementTree.Element, addresses: list[str]
) -> None:
    """Put convex parts, each in an element of its own, in the place of a mesh."""
    place = list(link).index(collision)
    link.remove(collision)
    for address in reversed(addresses):
        mesh.set("filename", address)
        link.insert(place, deepcopy(collision))


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
    return address_of(*_parts_of_file(path, scale, 1, None))


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


def _parts_of_file(path: Path, scale: Array, most: int, keep: Path | None) -> list[Array]:
    """Return the corners of a mesh's convex hull, or of its convex parts [m]."""
    points, mesh = read_mesh(path, scale)
    if not len(points) or not (np.abs(points) <= FARTHEST).all():
        raise RecipeError([f"{path}: the mesh has no points, or some further off than {FARTHEST:,.0f} m"])
    try:
        parts = [hull_corners(points)] if most == 1 else convex_parts(points, sides_of(mesh), most, keep)
    except RecipeError as error:
        raise RecipeError([f"{path}: {text}" for text in error.mistakes]) from error
    if (corners := max(map(len, parts))) > MOST_CORNERS:
        found = f"the mesh's hull has {corners:,} corners"
        raise RecipeError([f"{path}: {found}, expected at most {MOST_CORNERS:,}: simplify the mesh"])
    return parts


def sides_of(mesh: "coal.BVHModelBase") -> NDArray[np.int64]:
    """Return the triangles of a mesh as numbers of its points, shape (T, 3)."""
    sides = [mesh.tri_indices(number) for number in range(mesh.num_tris)]
    return np.array([[side[0], side[1], side[2]] for side in sides], np.int64).reshape(-1, 3)


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
