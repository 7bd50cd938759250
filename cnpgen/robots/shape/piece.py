"""Convex pieces of links: the hull of a few points, thickened by a radius, as the elements of a URDF describe them."""

import math
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.robots.shape.hull import CUBE, FARTHEST, check_solid
from cnpgen.robots.shape.inline import points_of
from cnpgen.robots.urdf import urdf_tree

Array = NDArray[np.float64]

SIDES = 64  # of the prism round a cylinder, which it exceeds by 0.12 % of the radius


@dataclass(frozen=True)
class Piece:
    """A convex piece of a link: all points within ``radius`` of the convex hull of ``vertices``.

    Attributes:
        link: The link.
        vertices: Corners of the hull [m], shape (V, 3); one of a sphere, two of a capsule.
        radius: How thick the hull is wrapped [m]; 0 for boxes, cylinders and meshes.
    """

    link: str
    vertices: Array
    radius: float = 0.0

    def moved(self, rotation: Array, translation: Array) -> "Piece":
        """Return the piece in another frame.

        Args:
            rotation: Rotation of the present frame in the other one, shape (3, 3).
            translation: Its origin there [m], shape (3,).
        """
        return Piece(self.link, self.vertices @ rotation.T + translation, self.radius)


def link_pieces(urdf: str) -> list[Piece]:
    """Read the collision geometry of a URDF whose meshes are inline (``cnpgen.robots.shape.inline``).

    A cylinder becomes the prism of ``SIDES`` sides round it; all else is exact.

    Args:
        urdf: The text of the URDF.

    Returns:
        The pieces in the frames of their links, in the order of the URDF.

    Raises:
        RecipeError: An element says nothing that could be read.
    """
    found, mistakes = list[Piece](), list[str]()
    for link in urdf_tree(urdf).iter("link"):
        for element in link.iter("collision"):
            name = link.get("name", "")
            try:
                found.append(piece_of(name, element))
            except (ValueError, TypeError) as error:
                mistakes.append(f"the collision geometry of link {name!r} cannot be read: {error}")
    if mistakes:
        raise RecipeError(mistakes)
    return found


def piece_of(link: str, element: ElementTree.Element) -> Piece:
    """Read the geometry of an element of a link, with its place there.

    Raises:
        ValueError: It has none, or numbers that are none; or its mesh is not inline.
    """
    shape = element.find("geometry/*")
    if shape is None:
        raise ValueError("it has no <geometry>")
    piece = Piece(link, *_core(shape)).moved(*origin_of(element.find("origin")))
    if not np.isfinite(piece.vertices).all():
        raise ValueError("it has numbers that are not finite")
    if max(np.abs(piece.vertices).max(initial=0.0), piece.radius) > FARTHEST:
        raise ValueError(f"it reaches further than {FARTHEST:,.0f} m: are its numbers in m?")
    if shape.tag == "mesh":
        check_solid(piece.vertices)
    return piece


def _core(shape: ElementTree.Element) -> tuple[Array, float]:
    """Return the corners [m] and the thickness [m] of a geometry, in its own frame."""
    if shape.tag == "mesh":
        return points_of(shape), 0.0
    if shape.tag == "box":
        return CUBE * [_positive(each) for each in _numbers(shape, "size", 3)], 0.0
    if shape.tag not in ("sphere", "cylinder", "capsule"):
        raise ValueError(f"<{shape.tag}> is none of box, sphere, cylinder, capsule and mesh")
    radius = _positive(_numbers(shape, "radius", 1)[0])
    if shape.tag == "sphere":
        return np.zeros((1, 3)), radius
    half = _positive(_numbers(shape, "length", 1)[0]) / 2
    if shape.tag == "capsule":
        return np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), radius
    return prism(radius / math.cos(math.pi / SIDES), half), 0.0


def prism(outer: float, half: float) -> Array:
    """Return the corners of a prism of ``SIDES`` sides along z [m], shape (2 SIDES, 3).

    Args:
        outer: How far they are from its axis [m].
        half: Half its length [m].
    """
    circle = [(outer * math.cos(a), outer * math.sin(a)) for a in np.arange(SIDES) * (2 * math.pi / SIDES)]
    return np.array([[x, y, z] for z in (-half, half) for x, y in circle])


def origin_of(element: ElementTree.Element | None) -> tuple[Array, Array]:
    """Return rotation and translation [m] of a geometry in its link: roll, pitch and yaw about fixed axes."""
    if element is None:
        return np.eye(3), np.zeros(3)
    place = np.array(_numbers(element, "xyz", 3) if element.get("xyz") else np.zeros(3))
    return turned(*(_numbers(element, "rpy", 3) if element.get("rpy") else (0.0, 0.0, 0.0))), place


def turned(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation by roll about x, then pitch about y, then yaw about z, fixed axes [rad], shape (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
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
        raise ValueError(f"<{element.tag}> needs {count} numbers as {key!r}, got {text!r}")
    return values


def _positive(value: float) -> float:
    if not 0 < value < math.inf:
        raise ValueError(f"lengths must be positive and finite, got {value:g} m")
    return value
