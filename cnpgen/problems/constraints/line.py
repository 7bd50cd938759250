"""The tip on a line of any direction, or on a piece of it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cnpgen.problems.constraints.tip_manifold import FUNNEL, Place, TipManifold, Vector, beside, unit
from cnpgen.schema.keys import Range, field


@dataclass(frozen=True, kw_only=True)
class Line(TipManifold):
    """The tip is on a line through ``point``, along ``direction``; at the ends it moves and accelerates along it."""

    reason = "off the line"
    kinks = FUNNEL
    inside_name, held_name = "line piece", "line distance"
    velocity_name, acceleration_name = "velocity across the line", "acceleration across the line"
    point: Vector = field("a point of the line", unit="m")
    direction: Vector = field("its direction, of any length")
    piece: Range | None = field("how far along it the tip may be from the point", unit="m", default=None)
    start_band: float = field("how far off a motion may start", unit="m", default=0.0, low=0.0)
    tolerance: float = field("how far a motion may be off and still be called valid", unit="m", low=1e-9)

    def __post_init__(self) -> None:
        """Check that the direction is one.

        Raises:
            ValueError: It is not.
        """
        unit(self.direction, "direction")

    @cached_property
    def place(self) -> Place:
        """The line."""
        direction = unit(self.direction, "direction")
        bounded, ranges = ([direction.tolist()], (self.piece,)) if self.piece else ((), ())
        return Place(np.array(self.point), beside(direction).tolist(), bounded, ranges)

    @property
    def band(self) -> float:
        """How far off the line a motion may start [m]."""
        return self.start_band
