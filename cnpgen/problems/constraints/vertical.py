"""The vertical-orientation manifold: the tip's z axis is the world's (paper, Appendix B, heavy object)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.symbolic.state import SymbolicState
    from cnpgen.world.state import World


@dataclass(frozen=True, kw_only=True)
class Vertical(Constraint):
    """``R_02 = R_12 = 0`` and ``R_22 > 0``.

    The paper's ``1 - R_22`` has no gradient at the solution; the two off-diagonal entries are the tilt [rad] to first
    order.
    """

    reason = "not vertical"
    tolerance: float = field("how far a motion may tilt and still be called valid", unit="rad", low=1e-9)

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the tilt [rad]."""
        return self._tilt([row[2] for row in state.kinematics.rotation])

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Evaluate the tilt of Pinocchio's tip frame [rad]."""
        return self._tilt(list(world.tip_rotation[:, 2]))

    def _tilt(self, up: list[Any]) -> tuple[Condition, ...]:
        tilt = Condition("tilt", "rad", up[:2], np.zeros(2), np.zeros(2), "angle")
        return tilt, Condition("upright", "1", up[2:], np.zeros(1), np.full(1, np.inf), "angle")
