"""Constraint on the speed of the tip."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.problems.constraints.constraint import Array, Condition, Constraint
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.world.world import World


@dataclass(frozen=True, kw_only=True)
class TipSpeed(Constraint):
    """Constraint: tip speed within a limit, ``|v| <= limit``, stated for the square, a smooth function."""

    reason = "tip too fast"
    limit: float = field("maximum speed of the tip", unit="m/s", low=1e-6)
    tolerance: float = field("additional speed that a valid motion may have", unit="m/s", low=0.0, plausible=1.0)

    def allowed(self, condition: Condition) -> Array:
        """Return the tolerance of the square of the speed [m^2/s^2]."""
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
