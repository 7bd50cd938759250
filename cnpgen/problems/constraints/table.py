"""The table manifold: the tip stays over a rectangle at one height (paper, Appendix B, loss of the hitting task)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cnpgen.problems.constraints.tip_manifold import FUNNEL, Place, TipManifold
from cnpgen.schema.keys import Range, field


@dataclass(frozen=True, kw_only=True)
class Table(TipManifold):
    """The tip stays in a rectangle at the table's height; at the ends also ``dz/dt = 0`` and ``d2z/dt2 = 0``.

    It is a ``plane`` across z whose rectangle is along x and y.
    """

    reason = "off the table"
    kinks = FUNNEL
    inside_name, held_name = "table rectangle", "table height"
    velocity_name, acceleration_name = "vertical velocity", "vertical acceleration"
    parts = (("x", "y"), ())
    x: Range = field("where the tip may be along world x", unit="m")
    y: Range = field("where the tip may be along world y", unit="m")
    z: float = field("height of the tip when the mallet lies on the table", unit="m")
    start_band: float = field("how far above or below a motion may start", unit="m", default=0.0, low=0.0)
    tolerance: float = field("how far a motion may be off and still be called valid", unit="m", low=1e-9)

    @cached_property
    def place(self) -> Place:
        """The rectangle."""
        axes = np.eye(3).tolist()
        return Place(np.array([0.0, 0.0, self.z]), held=axes[2:], bounded=axes[:2], ranges=(self.x, self.y))

    @property
    def band(self) -> float:
        """How far above or below the table a motion may start [m]."""
        return self.start_band
