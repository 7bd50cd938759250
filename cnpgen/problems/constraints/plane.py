"""Constraints: the tip in a plane or on a line of any direction, or in a part of it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cnpgen.arrays import Array, Vector3
from cnpgen.problems.constraints.tip_manifold import (
    BOUND_KINKS,
    TipManifold,
    TipRegion,
    beside,
    unit,
)
from cnpgen.schema.keys import Range, field


@dataclass(frozen=True, kw_only=True)
class Plane(TipManifold):
    """Constraint: the tip p stays in a plane, ``normal . (p - point) = 0``.

    Its end derivatives are in the plane.
    """

    reason = "off the plane"
    kinks = BOUND_KINKS
    inside_name = "plane rectangle"
    held_name = "plane distance"
    velocity_name = "velocity across the plane"
    acceleration_name = "acceleration across the plane"
    point: Vector3 = field("point of the plane", unit="m")
    normal: Vector3 = field("normal of the plane, of any length")
    along: Vector3 | None = field(
        "direction in the plane along which u is measured", default=None
    )
    u: Range | None = field(
        'range of the tip along "along", from the point', unit="m", default=None
    )
    v: Range | None = field(
        "range of the tip along normal x along, from the point", unit="m", default=None
    )
    start_band: float = field(
        "violation that the start of a motion may have",
        unit="m",
        default=0.0,
        low=0.0,
        plausible=0.5,
    )
    tolerance: float = field(
        "violation that a valid motion may have", unit="m", low=1e-9, plausible=0.5
    )

    def __post_init__(self) -> None:
        """Check the directions; ValueError if one is zero or not finite, or a range of u or v has none."""
        if self.along is None and (self.u or self.v):
            raise ValueError(
                "u and v need a direction in the plane that u is measured along: along = [1, 0, 0]"
            )
        self._axes()

    @cached_property
    def place(self) -> TipRegion:
        """Region of the tip: the plane."""
        normal, axes = self._axes()
        given = [
            (axis, each)
            for axis, each in zip(axes, (self.u, self.v), strict=True)
            if each
        ]
        bounded = [axis.tolist() for axis, _ in given]
        return TipRegion(
            np.array(self.point),
            [normal.tolist()],
            bounded,
            tuple(each for _, each in given),
        )

    def _axes(self) -> tuple[Array, Array]:
        """Return the normal and both directions in the plane, unit vectors."""
        normal = unit(self.normal, "normal")
        if self.along is None:
            # Without ranges any two directions in the plane serve.
            return normal, beside(normal)
        given = unit(self.along, "along")
        # The direction is projected into the plane, so that both axes are orthogonal.
        first = unit(given - normal * (normal @ given), "along, seen in the plane,")
        return normal, np.stack([first, np.cross(normal, first)])


@dataclass(frozen=True, kw_only=True)
class Line(TipManifold):
    """Constraint: the tip is on a line through ``point`` along ``direction``.

    Its end derivatives are along it.
    """

    reason = "off the line"
    kinks = BOUND_KINKS
    inside_name = "line piece"
    held_name = "line distance"
    velocity_name = "velocity across the line"
    acceleration_name = "acceleration across the line"
    point: Vector3 = field("point of the line", unit="m")
    direction: Vector3 = field("direction of the line, of any length")
    piece: Range | None = field(
        "range of the tip along the line, from the point", unit="m", default=None
    )
    start_band: float = field(
        "violation that the start of a motion may have",
        unit="m",
        default=0.0,
        low=0.0,
        plausible=0.5,
    )
    tolerance: float = field(
        "violation that a valid motion may have", unit="m", low=1e-9, plausible=0.5
    )

    def __post_init__(self) -> None:
        """Check the direction; ValueError if it is zero or not finite."""
        unit(self.direction, "direction")

    @cached_property
    def place(self) -> TipRegion:
        """Region of the tip: the line."""
        direction = unit(self.direction, "direction")
        # A line without a piece is unbounded.
        bounded, ranges = (
            ([direction.tolist()], (self.piece,)) if self.piece else ((), ())
        )
        return TipRegion(
            np.array(self.point), beside(direction).tolist(), bounded, ranges
        )
