"""A plug-in constraint of the tip's speed, in both forms."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.plugins import Condition, Constraint, field
from cnpgen.world.world import World


@dataclass(frozen=True, kw_only=True)
class TipSpeed(Constraint):
    """A bound of the squared speed of the tip, not relative to a limit. Only Python can set ``highest``."""

    reason = "tip too fast"
    tolerance: float = field(
        "how much faster a motion may be", unit="m^2/s^2", default=1e-3, low=0.0
    )
    highest: float = 1.0

    def symbolic(self, state: SymbolicState) -> tuple[Condition, ...]:
        return self._slow(state.tip_velocity)

    def measured(self, world: World) -> tuple[Condition, ...]:
        return self._slow(world.tip_velocity)

    def _slow(self, velocity: Any) -> tuple[Condition, ...]:
        square = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
        bounds = np.array([-np.inf]), np.array([self.highest**2])
        return (Condition("tip speed", "m^2/s^2", [square], *bounds, "velocity"),)
