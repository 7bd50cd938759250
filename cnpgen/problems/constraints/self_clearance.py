"""Self-collision constraint: links that move relative to each other do not touch."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.clearance import LinkClearance, names_of_pairs
from cnpgen.problems.constraints.constraint import Condition, End
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.robots.robot import Robot
    from cnpgen.robots.shape.link_pairs import LinkPair
    from cnpgen.world.world import World


@dataclass(frozen=True, kw_only=True)
class SelfClearance(LinkClearance):
    """Constraint: the links of every pair that is not left out are further than ``distance`` from each other.

    It requires the geometry of the URDF. Judges measure the convex parts of the links. Solvers use the capsules of
    pairs whose capsules hardly ever overlap unless the links do; only judges check the other pairs.
    """

    reason, condition_name, bodies = "robot in collision with itself", "self clearance", "self"
    distance: float = field("minimum distance of links", unit="m", low=0.0, default=0.0, plausible=2.0)
    tolerance: float = field("violation that a valid motion may have", unit="m", low=0.0, plausible=0.5)

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the distances of the capsules' axes [m] of the pairs for solvers."""
        return self._capsule_distances(state, _for_solvers(state.robot))

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Measure the signed distances of the convex parts with Coal [m]."""
        distances, parts = world.self_distances(self.distance), names_of_pairs(world.robot.shape)
        return self._at_least(distances, self.distance, parts=parts)

    def solved(self, world: "World") -> tuple[Condition, ...]:
        """Return the conditions of the capsules."""
        radii = _radii(world.robot, _for_solvers(world.robot))
        return self._at_least([0.0] * len(radii), radii + self.distance, sufficient=True)

    def symbolic_at(self, state: "SymbolicState", end: End) -> tuple[Condition, ...]:  # noqa: ARG002
        """State the distances of all pairs."""
        return self._capsule_distances(state, _looked_at(state.robot))

    def _capsule_distances(self, state: "SymbolicState", pairs: "Sequence[LinkPair]") -> tuple[Condition, ...]:
        from cnpgen.kernels.symbolic.convex_distances import segment_distance

        ends = [(state.capsules[pair.first], state.capsules[pair.second]) for pair in pairs]
        distances = [segment_distance((a, b), (c, d), freeze=state.freeze) for (a, b, _), (c, d, _) in ends]
        return self._at_least(distances, _radii(state.robot, pairs) + self.distance, sufficient=True)


def _looked_at(robot: "Robot") -> "list[LinkPair]":
    """List the pairs of links that must not touch."""
    return [pair for pair in robot.shape.pairs if not pair.left_out] if robot.shape else []


def _for_solvers(robot: "Robot") -> "list[LinkPair]":
    """List the pairs whose capsules solvers use."""
    return [pair for pair in _looked_at(robot) if pair.for_solvers]


def _radii(robot: "Robot", pairs: "Sequence[LinkPair]") -> NDArray[np.float64]:
    """Return the sums of the capsule radii of pairs [m]."""
    radius = {capsule.link: capsule.radius for capsule in robot.shape.capsules} if robot.shape else {}
    return np.array([radius[pair.first] + radius[pair.second] for pair in pairs], float)
