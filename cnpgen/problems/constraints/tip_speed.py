"""A bound on how fast the tip moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.state import SymbolicState
    from cnpgen.world.state import World


@dataclass(frozen=True, kw_only=True)
class TipSpeed(Constraint):
    """The tip is no faster than a limit, ``|v| <= limit``; stated of the square, which has a gradient at rest, too."""

    reason = "tip too fast"
    limit: float = field("highest speed of the tip", unit="m/s", low=1e-6)
    tolerance: float = field("how much faster a motion may be and still be called valid", unit="m/s", low=0.0)

    def allowed(self, condition: Condition) -> NDArray[np.float64]:
        """Return by how much the square may exceed that of the limit [m^2/s^2]."""
        return np.full(len(condition.g), (self.limit + self.tolerance) ** 2 - self.limit**2)

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the square of the tip's speed [m^2/s^2]."""
        return self._slow(state.tip_velocity)

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Evaluate Pinocchio's velocity of the tip."""
        return self._slow(list(world.tip_velocity))

    def _slow(self, velocity: Sequence[Any]) -> tuple[Condition, ...]:
        square = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
        return (
            Condition("tip speed", "m^2/s^2", [square], np.array([-np.inf]), np.array([self.limit**2]), "velocity"),
        )
