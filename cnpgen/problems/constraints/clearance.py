"""Collision avoidance: the robot's capsules keep clear of the obstacles, the held object does not enter them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.symbolic.state import SymbolicState
    from cnpgen.world.state import World


@dataclass(frozen=True, kw_only=True)
class RobotClearance(Constraint):
    """Capsules along the chain (paper, Appendix B, robot collision) are further than their radius from every obstacle.

    The paper's points, no further than 10 cm apart, have gaps between them; capsules have none.
    """

    reason = "robot in collision"
    radius: float = field("radius of the capsules", unit="m", low=1e-6)
    tolerance: float = field("how deep a motion may enter and still be called valid", unit="m", low=0.0)

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the signed distance of every moving segment from every obstacle [m]."""
        from cnpgen.symbolic.boxes import segment_box_separation

        return self._clear([segment_box_separation(a, b, box) for a, b in state.segments for box in state.boxes])

    def penalised(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State distances that are easier to descend: inside, the depth of the middle of what is inside [m]."""
        from cnpgen.symbolic.boxes import signed_segment_box_distance as distance

        return self._clear([distance(a, b, box, hold=state.hold) for a, b in state.segments for box in state.boxes])

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Measure the signed distances with Coal [m]."""
        return self._clear(world.segment_distances())

    def _clear(self, distances: list[Any]) -> tuple[Condition, ...]:
        m = len(distances)
        return (Condition("robot clearance", "m", distances, np.full(m, self.radius), np.full(m, np.inf), "position"),)


@dataclass(frozen=True, kw_only=True)
class ObjectContact(Constraint):
    """The held object may touch an obstacle as deep as ``depth``, not deeper (paper, Appendix B, object collision)."""

    reason = "object in collision"
    depth: float = field("contact this deep is legal", unit="m", low=0.0)
    tolerance: float = field("how much deeper a motion may enter and still be called valid", unit="m", low=0.0)

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the separation of the object from every obstacle [m]."""
        from cnpgen.symbolic.boxes import upright_box_separation

        kin, size = state.kinematics, state.object_size or (0.0, 0.0, 0.0)
        return self._shallow([upright_box_separation(kin.tip, kin.rotation, size, box) for box in state.boxes])

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Measure the signed distances with Coal [m]."""
        return self._shallow(world.object_distances())

    def _shallow(self, distances: list[Any]) -> tuple[Condition, ...]:
        m = len(distances)
        return (Condition("object contact", "m", distances, np.full(m, -self.depth), np.full(m, np.inf), "position"),)
