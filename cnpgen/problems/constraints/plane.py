"""The tip in a plane of any direction, or in a rectangle of it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.tip_manifold import FUNNEL, Place, TipManifold, Vector, beside, unit
from cnpgen.schema.keys import Range, field


@dataclass(frozen=True, kw_only=True)
class Plane(TipManifold):
    """The tip p stays in a plane: ``normal . (p - point) = 0``; at the ends it moves and accelerates along it only."""

    reason = "off the plane"
    kinks = FUNNEL
    inside_name, held_name = "plane rectangle", "plane distance"
    velocity_name, acceleration_name = "velocity across the plane", "acceleration across the plane"
    point: Vector = field("a point of the plane", unit="m")
    normal: Vector = field("a direction across it, of any length")
    along: Vector | None = field("the direction in the plane that u is measured along", default=None)
    u: Range | None = field("how far the tip may be from the point in the direction of along", unit="m", default=None)
    v: Range | None = field("likewise across along and normal (normal x along)", unit="m", default=None)
    start_band: float = field("how far off a motion may start", unit="m", default=0.0, low=0.0)
    tolerance: float = field("how far a motion may be off and still be called valid", unit="m", low=1e-9)

    def __post_init__(self) -> None:
        """Check that the directions are some.

        Raises:
            ValueError: They are not, or u and v have no direction to be measured along.
        """
        if self.along is None and (self.u or self.v):
            raise ValueError("u and v need a direction in the plane that u is measured along: along = [1, 0, 0]")
        self._axes()

    @cached_property
    def place(self) -> Place:
        """The plane."""
        normal, axes = self._axes()
        given = [(axis, each) for axis, each in zip(axes, (self.u, self.v), strict=True) if each]
        bounded = [axis.tolist() for axis, _ in given]
        return Place(np.array(self.point), [normal.tolist()], bounded, tuple(each for _, each in given))

    @property
    def band(self) -> float:
        """How far off the plane a motion may start [m]."""
        return self.start_band

    def _axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the normal and both directions in the plane, unit vectors."""
        normal = unit(self.normal, "normal")
        if self.along is None:
            return normal, beside(normal)
        given = unit(self.along, "along")
        first = unit(given - normal * (normal @ given), "along, seen in the plane,")
        return normal, np.stack([first, np.cross(normal, first)])
