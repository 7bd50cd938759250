"""The table manifold: the tip stays over a rectangle at one height (paper, Appendix B, loss of the hitting task)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cnpgen.problems.constraints.tip_manifold import BOUND_KINKS, TipManifold, TipRegion
from cnpgen.schema.keys import Range, field


@dataclass(frozen=True, kw_only=True)
class Table(TipManifold):
    """Constraint: the tip stays in a rectangle at the table's height, with ``dz/dt = d2z/dt2 = 0`` at the ends.

    It equals a ``plane`` normal to z with a rectangle along x and y. Parameters of the problem may raise the table and
    turn it about the center of its rectangle; then all coordinates are those of the table.
    """

    reason = "off the table"
    training_inset = 1e-3  # m
    kinks = BOUND_KINKS
    moves_with_table = True
    inside_name, held_name = "table rectangle", "table height"
    velocity_name, acceleration_name = "vertical velocity", "vertical acceleration"
    parts = (("x", "y"), ())
    x: Range = field("range of the tip along world x", unit="m")
    y: Range = field("range of the tip along world y", unit="m")
    z: float = field("height of the tip with the mallet on the table", unit="m")
    start_band: float = field("height error that the start of a motion may have", unit="m", default=0.0, low=0.0)
    tolerance: float = field("violation that a valid motion may have", unit="m", low=1e-9)

    @cached_property
    def place(self) -> TipRegion:
        """Region of the tip: the rectangle."""
        axes = np.eye(3).tolist()
        return TipRegion(np.array([0.0, 0.0, self.z]), held=axes[2:], bounded=axes[:2], ranges=(self.x, self.y))

    @property
    def band(self) -> float:
        """Maximum vertical distance of a start from the table [m]."""
        return self.start_band
