"""Self-contained URDFs: meshes are replaced by the corners of their convex hulls, in ``data:`` addresses.

A plan, a dataset or a planner contains its problem as text, so the geometry of the
robot must be in the text, too.
"""

import base64
import re
import warnings
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from cnpgen.arrays import Array, Integers
from cnpgen.errors import RecipeError, nearest
from cnpgen.robots.shape.decomposition import convex_parts
from cnpgen.robots.shape.hull import (
    MAX_COORDINATE_M,
    MAX_CORNERS,
    MIN_THICKNESS_M,
    enclosing_hull,
    hull_corners,
)
from cnpgen.robots.shape.mesh_files import find_named_file
from cnpgen.robots.urdf import urdf_tree

if TYPE_CHECKING:
    import coal


# Followed by corners x, y, z [m] as little-endian float64.
_INLINE = "data:application/octet-stream;base64,"
_MESHES = (".stl", ".dae", ".obj")
MAX_DAE_HEAD_BYTES = 1 << 16  # in which a DAE file states its unit
MAX_MESH_BYTES = 1 << 26  # of a mesh file
_CAPSULES = "1.2"  # first version of URDF with capsules


def with_inline_meshes(
    urdf: str,
    path: Path,
    packages: Sequence[Path] = (),
    *,
    most: int = 1,
    links: Sequence[str] = (),
    keep: Path | None = None,
) -> str:
    """Return a URDF with inline hulls of its collision meshes; a URDF without such meshes is returned unchanged.

    Relative mesh paths begin in the folder of the URDF's file, others in folders of
    packages. Meshes of all links, or of some, consist of at most so many convex parts,
    1 for the hull, which a cache folder keeps.
    """
    try:
        tree = urdf_tree(urdf)
    except ValueError:
        # The reader of the robot raises the error.
        return urdf
    meshes = [
        (link, element, mesh)
        for link in tree.iter("link")
        for element in link.findall("collision")
        if (mesh := _mesh_file(element)) is not None
    ]
    errors = _unknown_links(tree, links)
    for link, element, mesh in meshes:
        parts = most if not links or link.get("name") in links else 1
        try:
            file = find_named_file(mesh.get("filename", ""), path, packages)
            hulls = _parts_of_file(file, scale_of(mesh), parts, keep)
            addresses = [address_of(hull) for hull in hulls]
        except RecipeError as error:
            name = link.get("name", "")
            hint = f"a mesh of link {name!r}; without it: skipped_meshes = [{name!r}] in [robot]"
            errors += [f"{text} ({hint})" for text in error.errors]
        else:
            mesh.attrib.pop("scale", None)
            _replace(link, element, mesh, addresses)
    if errors:
        raise RecipeError(list(dict.fromkeys(errors)))
    is_changed = _allow_capsules(tree) or meshes
    return ElementTree.tostring(tree, encoding="unicode") if is_changed else urdf


def _allow_capsules(tree: ElementTree.Element) -> bool:
    """Set the version of a URDF with capsules, if it has an earlier one; return whether this was necessary."""
    has_capsules = tree.find(".//collision/geometry/capsule") is not None
    if not has_capsules or tree.get("version", "1.0") >= _CAPSULES:
        return False
    # The URDF parser would ignore capsules, with warnings on stderr.
    tree.set("version", _CAPSULES)
    return True


def _unknown_links(robot: ElementTree.Element, links: Sequence[str]) -> list[str]:
    names = [link.get("name", "") for link in robot.iter("link")]
    return [
        f"robot.decomposed: the URDF has no link {link!r}{nearest(link, names)}"
        for link in links
        if link not in names
    ]


def _mesh_file(collision: ElementTree.Element) -> ElementTree.Element | None:
    """Return the mesh of a <collision> element if it refers to a file, otherwise None."""
    mesh = collision.find("geometry/mesh")
    return None if mesh is None or is_inline(mesh.get("filename", "")) else mesh


def _replace(
    link: ElementTree.Element,
    collision: ElementTree.Element,
    mesh: ElementTree.Element,
    addresses: list[str],
) -> None:
    """Replace a mesh by convex parts, one element each."""
    place = list(link).index(collision)
    link.remove(collision)
    for address in reversed(addresses):
        mesh.set("filename", address)
        link.insert(place, deepcopy(collision))


def mesh_files(urdf: str) -> list[str]:
    """List the mesh files in the collision geometry of a URDF, without inline meshes."""
    meshes = urdf_tree(urdf).iterfind(".//collision/geometry/mesh")
    names = dict.fromkeys(mesh.get("filename", "") for mesh in meshes)
    return [name for name in names if not name.startswith(_INLINE)]


def mesh_links(urdf: str) -> frozenset[str]:
    """Return the links with mesh files in their collision geometry."""
    links = urdf_tree(urdf).iter("link")
    return frozenset(
        link.get("name", "")
        for link in links
        if any(_mesh_file(each) is not None for each in link.iter("collision"))
    )


def inline_mesh(path: Path, scale: Array) -> str:
    """Return the corners of the convex hull of a mesh file, scaled along x, y and z, as a ``data:`` address."""
    return address_of(*_parts_of_file(path, scale, 1, None))


def address_of(corners: Array) -> str:
    """Return corners [m], shape (V, 3), as a ``data:`` address."""
    return _INLINE + base64.b64encode(corners.astype("<f8").tobytes()).decode()


def is_inline(address: str) -> bool:
    """Return whether a mesh is given by its corners and not by a file name."""
    return address.startswith(_INLINE)


def corners_of(address: str) -> Array:
    """Return the corners of an inline mesh [m], shape (V, 3).

    ValueError if they are not triples of finite numbers.
    """
    corners = (
        np.frombuffer(base64.b64decode(address.removeprefix(_INLINE)), "<f8")
        .reshape(-1, 3)
        .astype(float)
    )
    if not len(corners) or not np.isfinite(corners).all():
        raise ValueError("a mesh has no corners, or some that are not finite")
    return corners


def scale_of(mesh: ElementTree.Element) -> Array:
    """Return the scale factors of x, y and z of a mesh, shape (3,)."""
    try:
        scale = np.array(
            [float(factor) for factor in mesh.get("scale", "1 1 1").split()]
        )
    except ValueError:
        scale = np.zeros(0)
    if scale.shape != (3,) or not (np.isfinite(scale).all() and (scale != 0).all()):
        raise RecipeError(
            [
                f"the scale of a mesh must be three numbers that are not 0, got {mesh.get('scale')!r}"
            ]
        )
    return scale


def _parts_of_file(
    path: Path, scale: Array, most: int, keep: Path | None
) -> list[Array]:
    """Return the corners of a mesh's convex hull, or of its convex parts [m]."""
    points, mesh = read_mesh(path, scale)
    if not len(points) or not (np.abs(points) <= MAX_COORDINATE_M).all():
        raise RecipeError(
            [
                f"{path}: the mesh has no points, or some further off than {MAX_COORDINATE_M:,.0f} m"
            ]
        )
    try:
        parts = (
            [hull_corners(points)]
            if most == 1
            else convex_parts(points, sides_of(mesh), most, keep)
        )
    except RecipeError as error:
        raise RecipeError([f"{path}: {text}" for text in error.errors]) from error
    _warn_about(path, points, scale)
    return [_simplified(path, part) for part in parts]


def _simplified(path: Path, corners: Array) -> Array:
    """Return the corners of a body with at most ``MAX_CORNERS`` corners that contains a hull."""
    if len(corners) <= MAX_CORNERS:
        return corners
    body, bound = enclosing_hull(corners)
    warnings.warn(
        f"{path}: a hull of the mesh has {len(corners):,} corners, more than {MAX_CORNERS:,}; a body with {len(body):,}"
        f" corners contains it and is larger by at most {1e3 * bound:.2g} mm",
        RuntimeWarning,
        stacklevel=2,
    )
    return body


def _warn_about(path: Path, points: Array, scale: Array) -> None:
    """Warn about a mesh that is flat, and about the unit of a DAE file, which Coal ignores."""
    offsets = points - points.mean(axis=0)
    thickness = min(
        float(np.ptp(offsets @ axis))
        for axis in np.linalg.eigh(offsets.T @ offsets)[1].T
    )
    if thickness < MIN_THICKNESS_M:
        text = f"the mesh is flat, and a body of {2e3 * MIN_THICKNESS_M:g} mm replaces it: is it a collision mesh?"
        warnings.warn(f"{path}: {text}", RuntimeWarning, stacklevel=2)
    unit = unit_of_mesh(path)
    if unit != 1.0 and (scale == 1.0).all():
        text = f"the file states a unit of {unit:g} m, which is ignored as by Pinocchio: its numbers are read in m"
        remedy = f'if they are not, write scale="{unit:g} {unit:g} {unit:g}" in its <mesh> element'
        warnings.warn(f"{path}: {text}; {remedy}", RuntimeWarning, stacklevel=2)


def unit_of_mesh(path: Path) -> float:
    """Return the unit that a mesh file states [m]; 1 if it states none, as all but DAE files."""
    if path.suffix.lower() != ".dae":
        return 1.0
    with path.open("rb") as file:
        found = re.search(
            rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([0-9.eE+-]{1,32})[\"']",
            file.read(MAX_DAE_HEAD_BYTES),
        )
    try:
        return float(found.group(1)) if found else 1.0
    except ValueError:
        return 1.0


def sides_of(mesh: "coal.BVHModelBase") -> Integers:
    """Return the triangles of a mesh as indices of its points, shape (T, 3)."""
    sides = [mesh.tri_indices(number) for number in range(mesh.num_tris)]
    return np.array([[side[0], side[1], side[2]] for side in sides], np.int64).reshape(
        -1, 3
    )


def read_mesh(path: Path, scale: Array) -> tuple[Array, "coal.BVHModelBase"]:
    """Read an STL, DAE or OBJ file, scaled along x, y and z: points [m], shape (N, 3), and mesh of Coal."""
    import coal

    if path.suffix.lower() not in _MESHES:
        raise RecipeError(
            [
                f"{path}: not a mesh that can be read: expected one of {', '.join(_MESHES)}"
            ]
        )
    if (size := path.stat().st_size) > MAX_MESH_BYTES:
        raise RecipeError(
            [
                f"{path}: has {size:,} bytes, expected a mesh of at most {MAX_MESH_BYTES:,}"
            ]
        )
    try:
        mesh = coal.MeshLoader().load(str(path), scale)
        return np.array(mesh.vertices(), float).reshape(-1, 3), mesh
    except (ValueError, RuntimeError, MemoryError) as error:
        lines = [
            line for line in str(error).splitlines() if not line.startswith("Hint:")
        ]
        raise RecipeError(
            [
                f"{path}: not a mesh that can be read: {lines[-1] if lines else 'too large'}"
            ]
        ) from error
