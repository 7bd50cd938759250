"""The table manifold: the tip stays over a rectangle at one height (paper, Appendix B, loss of the hitting task)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import Condition, Constraint, End
from cnpgen.schema.keys import Range, field

if TYPE_CHECKING:
    from cnpgen.symbolic.state import SymbolicState
    from cnpgen.world.state import World

FUNNEL = (0.1, 0.3)  # phases between which a motion that starts off the table must come down to it


@dataclass(frozen=True, kw_only=True)
class Table(Constraint):
    """The tip in a rectangle at the table's height; at the ends also ``dz/dt = 0`` and ``d2z/dt2 = 0``."""

    reason = "off the table"
    kinks = FUNNEL
    x: Range = field("where the tip may be along world x", unit="m")
    y: Range = field("where the tip may be along world y", unit="m")
    z: float = field("height of the tip when the mallet lies on the table", unit="m")
    start_band: float = field("how far above or below a motion may start", unit="m", default=0.0, low=0.0)
    tolerance: float = field("how far a motion may be off and still be called valid", unit="m", low=1e-9)

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the rectangle and the height [m]."""
        return self._position(state.kinematics.tip, 0.0)

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Evaluate Pinocchio's tip position [m]."""
        return self._position(list(world.tip_position), 0.0)

    def symbolic_at(self, state: "SymbolicState", end: End) -> tuple[Condition, ...]:
        """State position, vertical velocity and vertical acceleration of a boundary state."""
        return self._boundary(state.kinematics.tip, state.tip_velocity[2], state.tip_acceleration[2], end)

    def measured_at(self, world: "World", end: End) -> tuple[Condition, ...]:
        """Evaluate position, vertical velocity and vertical acceleration with Pinocchio."""
        return self._boundary(list(world.tip_position), world.tip_velocity[2], world.tip_acceleration[2], end)

    def funnel(
        self, condition: Condition, s: NDArray[np.float64], start_tip: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Let a motion that starts off the table reach it: ``start_off`` until s = 0.1, nothing from s = 0.3 on."""
        if condition.name != "table height":
            return np.zeros((*start_tip.shape[:-1], len(s)))
        open_: NDArray[np.float64] = np.clip((FUNNEL[1] - s) / (FUNNEL[1] - FUNNEL[0]), 0.0, 1.0)
        return self.start_off(start_tip)[..., None] * open_

    def start_off(self, start_tip: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far off the table motions may begin [m]: as far as they do, up to ``start_band``.

        Args:
            start_tip: Positions of the tip at the start [m], shape (..., 3).
        """
        return np.minimum(np.abs(start_tip[..., 2] - self.z), self.start_band)

    def _position(self, tip: list[Any], band: float) -> tuple[Condition, ...]:
        low, high = np.array([self.x.low, self.y.low]), np.array([self.x.high, self.y.high])
        inside = Condition("table rectangle", "m", tip[:2], low, high, "position")
        height = Condition(
            "table height", "m", tip[2:], np.array([self.z - band]), np.array([self.z + band]), "position"
        )
        return inside, height

    def _boundary(self, tip: list[Any], velocity: Any, acceleration: Any, end: End) -> tuple[Condition, ...]:
        zero = np.zeros(1)
        return (
            *self._position(tip, self.start_band if end == "start" else 0.0),
            Condition("vertical velocity", "m/s", [velocity], zero, zero, "velocity"),
            Condition("vertical acceleration", "m/s^2", [acceleration], zero, zero, "acceleration"),
        )
