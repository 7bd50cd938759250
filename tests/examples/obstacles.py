"""Obstacles of every kind, anywhere, and the same ones as Coal has them: primitives, not hulls."""

from typing import Any

import coal
import numpy as np
import scipy

from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.hull import hull_corners
from cnpgen.robots.shape.inline import address_of, corners_of
from cnpgen.schema.keys import Range
from tests.examples.capped_cone import coal_cone

KINDS = ("upright", "box", "turned box", "sphere", "cylinder", "capsule", "mesh")
ROUNDER = 1.3e-3  # of the radius: by how much a cylinder is thinner than the prism that stands for it


def draw_obstacle(
    kind: str, random: np.random.Generator, *, spread: float = 0.1
) -> Obstacle:
    """An obstacle of some 10 cm somewhere near the origin."""
    place, turn = tuple(random.normal(0, spread, 3)), tuple(random.uniform(-3, 3, 3))
    size = tuple(random.uniform(0.05, 0.3, 3))
    if kind == "upright":
        (x, y, z), (a, b, c) = place, size
        return Obstacle(
            name=kind, x=Range(x, x + a), y=Range(y, y + b), top=z, height=c
        )
    if kind == "mesh":
        points = random.normal(0, 0.1, (int(random.integers(5, 40)), 3))
        return Obstacle(
            name=kind,
            kind="mesh",
            mesh=address_of(hull_corners(points)),
            position=place,
            rotation=turn,
        )
    about: dict[str, Any] = {
        "box": {"size": size},
        "turned box": {"size": size, "rotation": turn},
        "sphere": {"radius": size[0]},
        "cylinder": {"radius": size[0], "length": size[1], "rotation": turn},
        "capsule": {"radius": size[0], "length": size[1], "rotation": turn},
    }[kind]
    return Obstacle(
        name=kind, kind=kind.rsplit(maxsplit=1)[-1], position=place, **about
    )


def coal_obstacle(obstacle: Obstacle) -> tuple[Any, Any]:
    """Shape and place of an obstacle as its keys say, with SciPy's rotations."""
    if obstacle.upright:
        x, y, top, height = obstacle.x, obstacle.y, obstacle.top, obstacle.height
        center = np.array(
            [(x.low + x.high) / 2, (y.low + y.high) / 2, top - height / 2]
        )
        return coal.Box(x.high - x.low, y.high - y.low, height), coal.Transform3s(
            np.eye(3), center
        )
    turn = scipy.spatial.transform.Rotation.from_euler(
        "xyz", obstacle.rotation
    ).as_matrix()  # about fixed axes
    return _shape(obstacle), coal.Transform3s(turn, np.array(obstacle.position))


def _shape(obstacle: Obstacle) -> Any:
    if obstacle.kind == "convex":
        return coal_cone(obstacle.shape)
    if obstacle.kind == "mesh":
        corners = corners_of(obstacle.mesh)
        points, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        for corner in corners:
            points.append(corner)
        for triangle in scipy.spatial.ConvexHull(corners).simplices:
            faces.append(coal.Triangle(*map(int, triangle)))
        return coal.Convex(points, faces)
    return {
        "box": lambda: coal.Box(*obstacle.size),
        "sphere": lambda: coal.Sphere(obstacle.radius),
        "cylinder": lambda: coal.Cylinder(obstacle.radius, obstacle.length),
        "capsule": lambda: coal.Capsule(obstacle.radius, obstacle.length),
    }[obstacle.kind]()


def coal_distance(shape: Any, place: Any, obstacle: Obstacle) -> float:
    """Signed distance of a Coal shape from an obstacle [m]."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance, request.epa_tolerance = 1e-9, 1e-6
    return float(coal.distance(shape, place, *coal_obstacle(obstacle), request, result))


def segment(first: np.ndarray, second: np.ndarray) -> tuple[Any, Any]:
    """A segment as Coal's capsule without thickness, and its place."""
    along = second - first
    turn = scipy.spatial.transform.Rotation.align_vectors([along], [[0, 0, 1]])[
        0
    ].as_matrix()
    return coal.Capsule(0.0, float(np.linalg.norm(along))), coal.Transform3s(
        turn, (first + second) / 2
    )
