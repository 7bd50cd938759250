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
from cnpgen.robots.shape.hull import hull_corners
from cnpgen.robots.urdf import urdf_tree

if TYPE_CHECKING:
    import coal

Array = NDArray[np.float64]

_INLINE = "data:application/octet-stream;base64,"  # followed by corners x, y, z [m] as little-endian float64
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
    meshes = [mesh for mesh in tree.iterfind(".//collision/geometry/mesh") if not _is_inline(mesh)]
    mistakes: list[str] = []
    for mesh in meshes:
        try:
            corners = _hull_of_file(find_named_file(mesh.get("filename", ""), path, packages), scale_of(mesh))
        except RecipeError as error:
            mistakes += error.mistakes
        else:
            mesh.set("filename", _INLINE + base64.b64encode(corners.astype("<f8").tobytes()).decode())
            mesh.attrib.pop("scale", None)
    if mistakes:
        raise RecipeError(list(dict.fromkeys(mistakes)))
    unversioned = tree.find(".//collision/geometry/capsule") is not None and tree.get("version", "1.0") < _CAPSULES
    if unversioned:  # URDF's parser would complain on stderr about what it then leaves out
        tree.set("version", _CAPSULES)
    return ElementTree.tostring(tree, encoding="unicode") if meshes or unversioned else urdf


def points_of(mesh: ElementTree.Element) -> Array:
    """Return the corners of an inline mesh [m], shape (V, 3).

    Raises:
        ValueError: It is not inline.
    """
    if not _is_inline(mesh):
        raise ValueError(f"the mesh {mesh.get('filename', '')!r} is not in the text of the URDF")
    content = base64.b64decode(mesh.get("filename", "").removeprefix(_INLINE))
    return np.frombuffer(content, "<f8").reshape(-1, 3).astype(float)


def _is_inline(mesh: ElementTree.Element) -> bool:
    return mesh.get("filename", "").startswith(_INLINE)


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
    if not len(points) or not np.isfinite(points).all():
        raise RecipeError([f"{path}: the mesh has no points, or some that are not finite"])
    return hull_corners(points)


def read_mesh(path: Path, scale: Array) -> tuple[Array, "coal.BVHModelBase"]:
    """Read a mesh (STL, DAE, OBJ and what else Coal's loader knows).

    Args:
        path: The file.
        scale: Factors of its x, y and z, shape (3,).

    Returns:
        Its points [m], shape (N, 3), and the mesh as Coal has it.

    Raises:
        RecipeError: It cannot be read.
    """
    import coal

    try:
        mesh = coal.MeshLoader().load(str(path), scale)
        return np.array(mesh.vertices(), float).reshape(-1, 3), mesh
    except (ValueError, RuntimeError) as error:
        raise RecipeError([f"{path}: not a mesh that can be read: {error}"]) from error
