"""A truncated cone with round edges: the shape of a package, and the same one by formulas and by Coal."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pytest
import scipy

from cnpgen.schema.registry import SHAPES
from tests.examples.installed import installed_kind

NAME = "capped_cone"
SOURCE = '''
from dataclasses import dataclass
import numpy as np
from cnpgen.plugins import ObstacleShape, field

SIDES = 48

@dataclass(frozen=True, kw_only=True)
class CappedCone(ObstacleShape):
    """A truncated cone along z with round edges."""

    radius: float = field("radius of the lower end", unit="m", low=1e-6)
    top_radius: float = field("radius of the upper end", unit="m", low=1e-6)
    length: float = field("length along the z axis", unit="m", low=1e-6)
    rounding: float = field("radius of the edges, added to all sides", unit="m", default=0.0, low=0.0)

    def polytope(self):
        angles = np.arange(SIDES) * (2 * np.pi / SIDES)
        circle = np.column_stack([np.cos(angles), np.sin(angles)]) / np.cos(np.pi / SIDES)
        half = self.length / 2
        ends = [(self.radius, -half), (self.top_radius, half)]
        return np.concatenate([np.column_stack([r * circle, np.full(SIDES, z)]) for r, z in ends]), self.rounding
'''
TABLE = """
[[obstacle]]
name = "cone"
kind = "convex"
shape = {use = "capped_cone", radius = "12 cm", top_radius = 0.05, length = 0.3, rounding = 0.02}
position = [0.45, 0.1, 0.25]
rotation = "[0, 40, 20] deg"
"""
ROUNDER = 2.2e-3  # of the radius: by how much the cone is thinner than its polytope
_FINE = 240  # Coal allows 255 neighbours of a corner


@contextmanager
def installed_cone(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install the package of the shape for the duration of the block."""
    (folder / f"{NAME}.py").write_text(SOURCE, encoding="utf-8")
    # Another test has it from another folder.
    monkeypatch.delitem(sys.modules, NAME, raising=False)
    target = f"{NAME}:CappedCone"
    with installed_kind(folder, NAME, target, monkeypatch, group=SHAPES):
        yield


def cone_distance(obstacle: Any, points: np.ndarray) -> np.ndarray:
    """Signed distances of points, shape (..., 3), from the cone itself [m]: the formula of a trapezoid about z."""
    cone = obstacle.shape
    turn = scipy.spatial.transform.Rotation.from_euler("xyz", obstacle.rotation)
    local = (points - np.array(obstacle.position)) @ turn.as_matrix()
    r, z = np.hypot(local[..., 0], local[..., 1]), local[..., 2]
    half = cone.length / 2
    corners = [(0, -half), (cone.radius, -half), (cone.top_radius, half), (0, half)]
    distance, inside = np.full(r.shape, np.inf), np.ones(r.shape, bool)
    for (r0, z0), (r1, z1) in pairwise(corners):
        dr, dz = r1 - r0, z1 - z0
        share = np.clip(((r - r0) * dr + (z - z0) * dz) / (dr * dr + dz * dz), 0.0, 1.0)
        distance = np.minimum(
            distance, np.hypot(r - r0 - share * dr, z - z0 - share * dz)
        )
        inside &= dr * (z - z0) - dz * (r - r0) >= 0
    return np.where(inside, -distance, distance) - cone.rounding


def coal_cone(cone: Any) -> Any:
    """Return the cone without its rounding as a fine polyhedron of Coal."""
    angles = np.arange(_FINE) * (2 * np.pi / _FINE)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    half, points = cone.length / 2, coal.StdVec_Vec3s()
    corners = np.concatenate(
        [
            np.column_stack([radius * circle, np.full(_FINE, z)])
            for radius, z in ((cone.radius, -half), (cone.top_radius, half))
        ]
    )
    for corner in corners:
        points.append(corner)
    sides = coal.StdVec_Triangle()
    for triangle in scipy.spatial.ConvexHull(corners).simplices:
        sides.append(coal.Triangle(*map(int, triangle)))
    return coal.Convex(points, sides)
