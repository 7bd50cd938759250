"""Gap of convex parts: the free space of the triangle meshes that the convex parts of links reject.

A hull contains the free space of its mesh's hollows. The reference is the collision
geometry of the files: triangle meshes in bounding volume hierarchies of Coal, and the
other geometry as the judge checks it. Cylinders are prisms: Coal's check of two
cylinders missed overlaps of 37 mm.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Array, Integers
from cnpgen.errors import RecipeError
from cnpgen.robots.chain import frame_of
from cnpgen.robots.shape.convex_part import ConvexPart, convex_part_of, origin_of
from cnpgen.robots.shape.hull import ball_round, coal_vectors, frame_along
from cnpgen.robots.shape.inline import is_inline, read_mesh, scale_of, sides_of
from cnpgen.robots.shape.link_pairs import (
    ALWAYS_FRACTION,
    CollisionBody,
    LinkContact,
    body_of_part,
    sample_poses,
)
from cnpgen.robots.shape.mesh_files import find_named_file
from cnpgen.robots.shape.shape import Shape
from cnpgen.robots.urdf import urdf_tree

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    import pinocchio as pin


GAP_STATES = 3_000  # random states: a gap of 2 % has a standard error of 0.3 %


@dataclass(frozen=True)
class PairGap:
    """Overlap of two links in sampled states.

    Attributes:
        first: Link nearer to the base.
        second: Other link.
        parts: Fraction of the sampled states in which their convex parts overlap.
        meshes: Fraction in which their triangle meshes overlap.
        rejected: Fraction of the states that all meshes accept in which their convex
            parts overlap.
    """

    first: str
    second: str
    parts: float
    meshes: float
    rejected: float


@dataclass(frozen=True)
class HullGap:
    """Free space that convex parts reject, at sampled states.

    Attributes:
        free: Number of sampled states in which no checked pair of meshes overlaps.
        rejected: Number of these in which convex parts of a checked pair overlap.
        accepted: Number of sampled states in which no convex parts of a checked pair
            overlap.
        pairs: Checked pairs, the one with the largest gap first.
        hidden: Pairs that are left out, since their convex parts always overlap,
            although their meshes do not.
    """

    free: int
    rejected: int
    accepted: int
    pairs: tuple[PairGap, ...]
    hidden: tuple[PairGap, ...]

    @property
    def fraction(self) -> float:
        """Fraction of the states that the meshes accept which the convex parts reject."""
        return self.rejected / self.free if self.free else 0.0


def measure_hull_gap(
    urdf: str, path: Path, packages: Sequence[Path], *, model: "pin.Model", shape: Shape
) -> HullGap:
    """Compare the convex parts of link pairs with the collision geometry of a URDF that names its mesh files.

    Relative mesh paths begin in the folder of the URDF's file, others in folders of
    packages. The model has the planned joints; states are sampled within its position
    limits.
    """
    poses = sample_poses(model, GAP_STATES)
    parts = LinkContact(poses, map(body_of_part, shape.convex_parts), shape.joints)
    bodies = _reference_bodies(urdf, path, packages, model)
    meshes = LinkContact(poses, bodies, shape.joints)
    overlaps = {}
    # Pairs that always touch are left out by the judge; their meshes show whether they
    # should be.
    for pair in shape.pairs:
        if pair.left_out in ("", "always"):
            names = pair.first, pair.second
            of_parts = parts.of(*names)
            overlaps[pair] = of_parts, meshes.of(*names, among=of_parts)
    checked = [overlap for pair, overlap in overlaps.items() if not pair.left_out]
    free, accepted = np.ones(GAP_STATES, bool), np.ones(GAP_STATES, bool)
    # Over all pairs: free by the meshes, accepted by the convex parts.
    for of_parts, of_meshes in checked:
        free, accepted = free & ~of_meshes, accepted & ~of_parts
    rejected = {
        pair: float(part[free].mean()) if free.any() else 0.0
        for pair, (part, _) in overlaps.items()
    }
    gaps = [
        (pair, PairGap(pair.first, pair.second, float(part.mean()), float(mesh.mean()), rejected[pair]))
        for pair, (part, mesh) in overlaps.items()
    ]  # fmt: skip
    judged = [gap for pair, gap in gaps if not pair.left_out]
    left_out = (gap for pair, gap in gaps if pair.left_out)
    return HullGap(
        free=int(free.sum()),
        rejected=int((free & ~accepted).sum()),
        accepted=int(accepted.sum()),
        pairs=tuple(sorted(judged, key=lambda gap: -gap.rejected)),
        hidden=tuple(gap for gap in left_out if gap.meshes <= ALWAYS_FRACTION),
    )


def _reference_bodies(
    urdf: str, path: Path, packages: Sequence[Path], model: "pin.Model"
) -> list[tuple[str, CollisionBody]]:
    """Return (link, body) of all collision elements, in the frames of the joints that move the links."""
    bodies = []
    errors = list[str]()
    for link in urdf_tree(urdf).iter("link"):
        name = link.get("name", "")
        for element in link.iter("collision"):
            frame = model.frames[frame_of(model, name)].placement
            placement = np.array(frame.rotation), np.array(frame.translation)
            try:
                bodies.append((name, _body(name, element, path, packages, placement)))
            except RecipeError as error:
                errors += error.errors
    if errors:
        raise RecipeError(list(dict.fromkeys(errors)))
    return bodies


def _body(
    link: str,
    element: "Element",
    path: Path,
    packages: Sequence[Path],
    placement: tuple[Array, Array],
) -> CollisionBody:
    mesh = element.find("geometry/mesh")
    if mesh is None or is_inline(mesh.get("filename", "")):
        return _exact_body(convex_part_of(link, element).moved(*placement))
    points, loaded = read_mesh(
        find_named_file(mesh.get("filename", ""), path, packages), scale_of(mesh)
    )
    for rotation, translation in (origin_of(element.find("origin")), placement):
        points = points @ rotation.T + translation
    return CollisionBody(*ball_round(points, 0.0), _triangles(points, sides_of(loaded)))


def _exact_body(part: ConvexPart) -> CollisionBody:
    """Return the body of a part.

    Coal checks spheres and capsules against triangles, but no hulls with a radius.
    """
    import coal

    if not part.radius:
        return body_of_part(part)[1]
    first = part.vertices[0]
    last = part.vertices[-1]
    length = float(np.linalg.norm(last - first))
    geometry = coal.Capsule(part.radius, length) if length else coal.Sphere(part.radius)
    placement = coal.Transform3s(
        frame_along((last - first).tolist(), length), (first + last) / 2
    )
    return CollisionBody(*ball_round(part.vertices, part.radius), geometry, placement)


def _triangles(points: Array, sides: Integers) -> Any:
    """Return a triangle mesh as an object of Coal."""
    import coal

    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(sides), len(points))
    mesh.addSubModel(*coal_vectors(points, sides))
    mesh.endModel()
    return mesh
