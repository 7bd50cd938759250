"""Contract of shapes of obstacles: a convex polytope with a radius, from which everything else follows.

The numbers of an obstacle, its pose and sizes in samples, kernels and plans, are its
position [m] and what the shape appends: by default the rows of its rotation matrix.
A shape whose sizes differ from sample to sample overrides the methods of these numbers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, get_args
from xml.etree.ElementTree import Element

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.obstacle_shapes.convex_solid import Solid, solid_around
from cnpgen.robots.shape.hull import coal_hull, hull_corners, inflated
from cnpgen.robots.shape.inline import address_of
from cnpgen.robots.urdf import numbers_text
from cnpgen.schema import registry
from cnpgen.schema.keys import keys


@dataclass(frozen=True, kw_only=True)
class ObstacleShape(ABC):
    """Shape of an obstacle: a frozen dataclass whose fields are its dimensions, keys of recipes.

    A package's shape defines ``polytope`` and is registered with the entry point group
    ``cnpgen.shapes``.
    """

    # Keys of an obstacle beside its position and the dimensions.
    placement: ClassVar[tuple[str, ...]] = ("rotation",)
    height_place: ClassVar[int] = 2  # of the number that moves it along z
    # Count of numbers of an obstacle, without and with a rotation.
    widths: ClassVar[tuple[int, int]] = (12, 12)

    @abstractmethod
    def polytope(self) -> tuple[Array, float]:
        """Return the corners of a convex hull in the frame of the shape [m], shape (V, 3), and a radius around it [m].

        They contain the shape; the order of the corners must not change. The corners of
        a package's shape are not coplanar.
        """

    @classmethod
    def sizes(cls) -> dict[str, int]:
        """Return the number of lengths of each dimension."""
        return {key.name: len(get_args(key.hint)) or 1 for key in keys(cls)}

    @classmethod
    def with_sizes(cls, sizes: list[float]) -> dict[str, Any]:
        """Return dimensions by name from lengths: three of one dimension, or one of each."""
        counts = cls.sizes()
        if 3 in counts.values():
            return dict.fromkeys(counts, tuple(sizes))
        return dict(zip(counts, sizes, strict=False))

    def lengths(self) -> list[float]:
        """Return the lengths of all dimensions in turn [m], such as files of scenes have."""
        values = [np.ravel(getattr(self, name)) for name in self.sizes()]
        return [float(length) for length in np.concatenate(values)]

    @classmethod
    def numbers(cls, position: Array, size: Array, rotation: Array) -> Array:  # noqa: ARG003
        """Return the numbers of M rotated obstacles, shape (M, width).

        Positions and sizes (edge lengths, or radius and length) [m] have shape (M, 3),
        rotations (M, 3, 3).
        """
        return np.concatenate([position, rotation.reshape(-1, 9)], axis=1)

    def solid(self, numbers: Array) -> Solid:
        """Return the convex body that judges measure, from numbers of shape (width,)."""
        corners, radius = self.polytope()
        return solid_around(numbers[:3], corners @ numbers[3:].reshape(3, 3).T, radius)

    def symbolic(self, values: Any, makers: Any) -> Any:
        """Return the body that solvers differentiate, from numbers as SX, a list of length width.

        ``makers`` are ``SOLIDS`` of ``cnpgen.kernels``. Shapes do not import them:
        judges use shapes, and share no code with solvers.
        """
        return makers.hull(*self.polytope(), values[:3], values[3:])

    def surface(self) -> Array:
        """Return points whose hull is drawn and observed [m], shape (V, 3)."""
        corners, radius = self.polytope()
        return hull_corners(inflated(corners, radius)) if radius else corners

    def coal(self) -> Any:
        """Return its geometry in Coal."""
        return coal_hull(self.surface())

    def urdf(self) -> Element:
        """Return its geometry as an element of a URDF."""
        return Element("mesh", filename=address_of(self.surface()))


def _is_same(first: Any, second: Any) -> bool:
    return np.array_equal(first, second, equal_nan=True)


def stated_polytope(shape: ObstacleShape) -> tuple[Array, float]:
    """Return the polytope of a shape of a package.

    Raises:
        ValueError: It is not an array of corners and a radius, or changes from call to
            call.
    """
    found: Any = shape.polytope()
    again: Any = shape.polytope()
    match found:
        case (np.ndarray() as corners, float() | int() | np.floating() as radius) if (
            corners.ndim == 2 and corners.shape[1] == 3 and corners.dtype.kind in "fi"
        ):
            if all(map(_is_same, found, again)):
                return corners, float(radius)
            text = "a polytope that differs from call to call"
        case _:
            text = " ".join(f"{found!r:.80}".split())
    kind = type(shape)
    package = registry.package_of(registry.SHAPES, kind) or kind.__module__
    expected = "expected the same array of corners of shape (V, 3) [m] and the same radius [m] from every call"
    raise ValueError(
        f"polytope() of {kind.__name__} of the package {package!r} returns {text}: {expected}"
    )


class SizedShape(ObstacleShape):
    """A shape whose sizes may differ from sample to sample, known to the compiled observations by a code."""

    @abstractmethod
    def place(
        self, numbers: Array, center: Array, rotation: Array, size: Array
    ) -> None:
        """Fill in centers (N, 3), rotations (N, 3, 3), which are units, and sizes (N, 3), which are 0 [m].

        Sizes are those of ``Primitives``, but a radius is that among the numbers, which
        have shape (N, width).
        """

    @staticmethod
    @abstractmethod
    def depths(local: Array, size: Array) -> Array:
        """Return the depths of points in bodies [m], not above 0 outside, from absolute coordinates in their frames."""

    def urdf(self) -> Element:
        """See ``ObstacleShape``."""
        lengths = {
            name: numbers_text(np.ravel(getattr(self, name))) for name in self.sizes()
        }
        return Element(registry.name_of(registry.SHAPES, type(self)), lengths)


@cache
def shape_class(kind: str) -> type[ObstacleShape]:
    """Return the class of a kind of obstacle of the core."""
    return registry.load(registry.SHAPES, kind)
