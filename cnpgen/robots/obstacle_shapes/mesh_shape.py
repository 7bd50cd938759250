"""Meshes, of which the convex hull counts."""

from __future__ import annotations

from dataclasses import dataclass

from cnpgen.arrays import Array
from cnpgen.robots.obstacle_shapes.obstacle_shape import ObstacleShape
from cnpgen.robots.shape.inline import corners_of
from cnpgen.schema.keys import field


@dataclass(frozen=True, kw_only=True)
class MeshShape(ObstacleShape):
    """The convex hull of the corners of a mesh."""

    mesh: str = field("corners, in a data: address")

    placement = ("rotation", "scale")

    def polytope(self) -> tuple[Array, float]:
        """See ``ObstacleShape``."""
        return corners_of(self.mesh), 0.0
