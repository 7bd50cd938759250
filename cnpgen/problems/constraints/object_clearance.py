"""Clearance constraint between the held object and the robot's links."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.problems.constraints.clearance import LinkClearance, names_of_pairs
from cnpgen.problems.constraints.constraint import Condition
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.robots.robot import Robot
    from cnpgen.robots.shape.capsule import Capsule
    from cnpgen.world.world import World
MAX_HELD_CAPSULE_ERROR_FRACTION = 0.1  # of the free states, in which the capsule of a usable link overlaps the object


@dataclass(frozen=True, kw_only=True)
class ObjectClearance(LinkClearance):
    """Constraint: the held object is further than ``distance`` from the links that may not touch it.

    It requires the geometry of the URDF. ``touch_links`` in [object] may touch the object. Links that the joint of the
    tip moves do not move relative to the object and are not checked. Judges measure the convex parts of the links.
    Solvers use the capsules of links whose capsules hardly ever overlap the object unless the links do.
    """

    reason, condition_name, bodies = "object in collision with the robot", "object clearance", "held object"
    training_weight = 3000.0
    distance: float = field(
        "minimum distance of the object from the links", unit="m", low=0.0, default=0.0, plausible=2.0
    )
    tolerance: float = field("violation that a valid motion may have", unit="m", low=0.0, default=0.0, plausible=0.5)

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the distances of the capsules' axes from the object [m]."""
        from cnpgen.kernels.symbolic.obstacle_distances import held_cuboid

        cuboid, capsules = held_cuboid(state), _solver_capsules(state.robot)
        axes = [state.held_capsules[capsule.link] for capsule in capsules]
        distances = [cuboid.separation(first, second, state.freeze) for first, second, _ in axes]
        return self._clear(distances, capsules)

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Measure the signed distances of the convex parts with Coal [m]."""
        distances, parts = world.held_object_distances(self.distance), names_of_pairs(world.robot.held_shape)
        return self._at_least(distances, self.distance, parts=parts)

    def solved(self, world: "World") -> tuple[Condition, ...]:
        """Return the conditions of the capsules."""
        capsules = _solver_capsules(world.robot)
        return self._clear([0.0] * len(capsules), capsules, parts=tuple(capsule.link for capsule in capsules))

    def _clear(
        self, distances: list[Any], capsules: "list[Capsule]", parts: tuple[str, ...] = ()
    ) -> tuple[Condition, ...]:
        least = np.array([capsule.radius + self.distance for capsule in capsules])
        return self._at_least(distances, least, parts=parts, sufficient=True)


def _solver_capsules(robot: "Robot") -> "list[Capsule]":
    """List the capsules of the links that solvers keep away from the object."""
    shape = robot.held_shape
    near = [pair for pair in shape.pairs if pair.colliding > 0] if shape else []
    links = {pair.first for pair in near if pair.mistaken <= MAX_HELD_CAPSULE_ERROR_FRACTION}
    return [capsule for capsule in shape.capsules if capsule.link in links] if shape else []
