"""Convex parts of links: convex hulls of points with a radius, read from the geometry elements of a URDF."""

import math
from dataclasses import dataclass
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from cnpgen.arrays import Array, Integers
from cnpgen.errors import RecipeError
from cnpgen.robots.obstacle_shapes.obstacle_shape import shape_class
from cnpgen.robots.shape.hull import MAX_COORDINATE_M, check_solid
from cnpgen.robots.shape.inline import corners_of, is_inline
from cnpgen.robots.urdf import urdf_tree
from cnpgen.schema import registry


@dataclass(frozen=True)
class ConvexPart:
    """A convex part of a link: all points within ``radius`` of the convex hull of ``vertices``.

    Attributes:
        link: Name of the link.
        vertices: Corners of the hull [m], shape (V, 3); one for a sphere, two for a
            capsule.
        radius: Radius around the hull [m]; 0 for boxes, cylinders and meshes.
    """

    link: str
    vertices: Array
    radius: float = 0.0

    def moved(self, rotation: Array, translation: Array) -> "ConvexPart":
        """Return the part in another frame, given rotation and translation [m] of the present frame in it."""
        return ConvexPart(
            self.link, self.vertices @ rotation.T + translation, self.radius
        )


class Contacts(NamedTuple):
    """C pairs of bodies that are close to each other at a state.

    Attributes:
        pair: Indices of the pairs, shape (C,).
        k: Indices of the states, shape (C,).
        distance: Signed distances [m], shape (C,).
        normal: Unit vectors from the first body to the second in the world frame, shape
            (C, 3).
        points: Closest points of both bodies without their radii, in the world frame
            [m], shape (C, 2, 3).
    """

    pair: Integers
    k: Integers
    distance: Array
    normal: Array
    points: Array


def link_convex_parts(urdf: str) -> list[ConvexPart]:
    """Read the collision geometry of a URDF whose meshes are inline, in the frames of its links and in its order.

    A cylinder becomes a prism of 64 sides that contains it; all other
    geometry is exact.
    """
    found = list[ConvexPart]()
    errors = list[str]()
    for link in urdf_tree(urdf).iter("link"):
        for element in link.iter("collision"):
            name = link.get("name", "")
            try:
                found.append(convex_part_of(name, element))
            except (ValueError, TypeError) as error:
                errors.append(
                    f"the collision geometry of link {name!r} cannot be read: {error}"
                )
    if errors:
        raise RecipeError(errors)
    return found


def convex_part_of(link: str, element: ElementTree.Element) -> ConvexPart:
    """Read the geometry of an element of a link, in the frame of the link.

    ValueError if invalid or not inline.
    """
    shape = element.find("geometry/*")
    if shape is None:
        raise ValueError("it has no <geometry>")
    part = ConvexPart(link, *_core(shape)).moved(*origin_of(element.find("origin")))
    if not np.isfinite(part.vertices).all():
        raise ValueError("it has numbers that are not finite")
    if max(np.abs(part.vertices).max(initial=0.0), part.radius) > MAX_COORDINATE_M:
        raise ValueError(
            f"it reaches further than {MAX_COORDINATE_M:,.0f} m: are its numbers in m?"
        )
    if shape.tag == "mesh":
        check_solid(part.vertices)
    return part


def _core(shape: ElementTree.Element) -> tuple[Array, float]:
    """Return the corners [m] and the thickness [m] of a geometry, in its own frame."""
    kinds = registry.BUILT_IN[registry.SHAPES]
    if shape.tag not in kinds:
        raise ValueError(
            f"<{shape.tag}> is not a {', '.join(list(kinds)[:-1])} or {[*kinds][-1]}"
        )
    if shape.tag == "mesh":
        address = shape.get("filename", "")
        if not is_inline(address):
            raise ValueError(f"the mesh {address!r} is not in the text of the URDF")
        return corners_of(address), 0.0
    kind = shape_class(shape.tag)
    lengths = [
        _positive(length)
        for name, count in kind.sizes().items()
        for length in _numbers(shape, name, count)
    ]
    return kind(**kind.with_sizes(lengths)).polytope()


def origin_of(element: ElementTree.Element | None) -> tuple[Array, Array]:
    """Return rotation and translation [m] of a geometry in its link: roll, pitch and yaw about fixed axes."""
    if element is None:
        return np.eye(3), np.zeros(3)
    place = np.array(_numbers(element, "xyz", 3) if element.get("xyz") else np.zeros(3))
    return turned(
        *(_numbers(element, "rpy", 3) if element.get("rpy") else (0.0, 0.0, 0.0))
    ), place


def turned(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation by roll about x, then pitch about y, then yaw about z, fixed axes [rad], shape (3, 3)."""
    cr, cp, cy = np.cos([roll, pitch, yaw])
    sr, sp, sy = np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _numbers(element: ElementTree.Element, key: str, count: int) -> list[float]:
    text = element.get(key, "")
    values = [float(each) for each in text.split()]
    if len(values) != count:
        raise ValueError(
            f"<{element.tag}> needs {count} numbers as {key!r}, got {text!r}"
        )
    return values


def _positive(value: float) -> float:
    if not 0 < value < math.inf:
        raise ValueError(f"lengths must be positive and finite, got {value:g} m")
    return value
