"""Constraint: the tip on a line of any direction, or on a segment of it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cnpgen.problems.constraints.tip_manifold import BOUND_KINKS, TipManifold, TipRegion, Vector, beside, unit
from cnpgen.schema.keys import Range, field


@dataclass(frozen=True, kw_only=True)
class Line(TipManifold):
    """Constraint: the tip is on a line through ``point`` along ``direction``; its end derivatives are along it."""

    reason = "off the line"
    kinks = BOUND_KINKS
    inside_name, held_name = "line piece", "line distance"
    velocity_name, acceleration_name = "velocity across the line", "acceleration across the line"
    point: Vector = field("point of the line", unit="m")
    direction: Vector = field("direction of the line, of any length")
    piece: Range | None = field("range of the tip along the line, from the point", unit="m", default=None)
    start_band: float = field(
        "violation that the start of a motion may have", unit="m", default=0.0, low=0.0, plausible=0.5
    )
    tolerance: float = field("violation that a valid motion may have", unit="m", low=1e-9, plausible=0.5)

    def __post_init__(self) -> None:
        """Check the direction.

        Raises:
            ValueError: It is zero or not finite.
        """
        unit(self.direction, "direction")

    @cached_property
    def place(self) -> TipRegion:
        """Region of the tip: the line."""
        direction = unit(self.direction, "direction")
        bounded, ranges = ([direction.tolist()], (self.piece,)) if self.piece else ((), ())
        return TipRegion(np.array(self.point), beside(direction).tolist(), bounded, ranges)
