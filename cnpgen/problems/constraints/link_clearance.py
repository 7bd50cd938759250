"""Clearance of links from each other and from the held object."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.problems.constraints.clearance import (
    LINK_KEYS,
    MAX_LINK_PENETRATION_M,
    ROBOT_KEYS,
    DistanceConstraint,
)
from cnpgen.problems.constraints.constraint import Conditions, End
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.robots.robot import Robot
    from cnpgen.robots.shape.capsule import Capsule
    from cnpgen.robots.shape.link_pairs import LinkPair
    from cnpgen.robots.shape.shape import Shape
    from cnpgen.world.path import PathWorld
    from cnpgen.world.world import World

# Of the free states, in which the capsule of a usable link overlaps the object.

MAX_HELD_CAPSULE_ERROR_FRACTION = 0.1


@dataclass(frozen=True, kw_only=True)
class LinkClearance(DistanceConstraint):
    """Base class: bodies that the robot moves are further than ``distance`` from each other."""

    uses_obstacles = False
    distance: float

    @property
    def effective_tolerance(self) -> float:
        """Tolerance up to a penetration of ``MAX_LINK_PENETRATION_M``."""
        return min(self.tolerance, self.distance + MAX_LINK_PENETRATION_M)

    def met(self, path: "PathWorld", tolerance: float) -> Mask:
        """Return a mask of the states with sufficient distances between the bodies."""
        return path.pairs(self.bodies).clear_states(self.distance - tolerance)


@dataclass(frozen=True, kw_only=True)
class SelfClearance(LinkClearance):
    """Constraint: the links of every pair that is not left out are further than ``distance`` from each other.

    It requires the geometry of the URDF. Judges measure the convex parts of the links.
    Solvers use the capsules of pairs whose capsules hardly ever overlap unless the
    links do; only judges check the other pairs.
    """

    reason = "robot in collision with itself"
    condition_name = "self clearance"
    reads = (*ROBOT_KEYS, "robot.srdf", "robot.ignored_pairs")
    bodies = "self"
    distance: float = field(
        "minimum distance of links", unit="m", low=0.0, default=0.0, plausible=2.0
    )
    tolerance: float = field(
        "violation that a valid motion may have", unit="m", low=0.0, plausible=0.5
    )

    def symbolic(self, state: "SymbolicState") -> Conditions:
        """State the distances of the capsules' axes [m] of the pairs for solvers."""
        return self._capsule_distances(state, _for_solvers(state.robot))

    def measured(self, world: "World") -> Conditions:
        """Measure the signed distances of the convex parts with Coal [m]."""
        distances = world.self_distances(self.distance)
        parts = names_of_pairs(world.robot.shape)
        return self._at_least(distances, self.distance, parts=parts)

    def solved(self, world: "World") -> Conditions:
        """Return the conditions of the capsules."""
        # Solvers read the bounds only: the distances are placeholders.
        radii = _radii(world.robot, _for_solvers(world.robot))
        return self._at_least(
            [0.0] * len(radii), radii + self.distance, sufficient=True
        )

    def symbolic_at(self, state: "SymbolicState", end: End) -> Conditions:  # noqa: ARG002
        """State the distances of all pairs."""
        # Boundary states are checked for all pairs, since a conservative condition
        # rejects none by itself.
        return self._capsule_distances(state, _looked_at(state.robot))

    def _capsule_distances(
        self, state: "SymbolicState", pairs: "Sequence[LinkPair]"
    ) -> Conditions:
        from cnpgen.kernels.symbolic.convex_distances import segment_distance

        ends = [
            (state.capsules[pair.first], state.capsules[pair.second]) for pair in pairs
        ]
        distances = [
            segment_distance((a, b), (c, d), freeze=state.freeze)
            for (a, b, _), (c, d, _) in ends
        ]
        return self._at_least(
            distances, _radii(state.robot, pairs) + self.distance, sufficient=True
        )


def _looked_at(robot: "Robot") -> "list[LinkPair]":
    """List the pairs of links that must not touch."""
    return (
        [pair for pair in robot.shape.pairs if not pair.left_out] if robot.shape else []
    )


def _for_solvers(robot: "Robot") -> "list[LinkPair]":
    """List the pairs whose capsules solvers use."""
    return [pair for pair in _looked_at(robot) if pair.for_solvers]


def _radii(robot: "Robot", pairs: "Sequence[LinkPair]") -> Array:
    """Return the sums of the capsule radii of pairs [m]."""
    radius = (
        {capsule.link: capsule.radius for capsule in robot.shape.capsules}
        if robot.shape
        else {}
    )
    # Two capsules touch where their axes are the sum of the radii apart.
    return np.array([radius[pair.first] + radius[pair.second] for pair in pairs], float)


@dataclass(frozen=True, kw_only=True)
class ObjectClearance(LinkClearance):
    """Constraint: the held object is further than ``distance`` from the links that may not touch it.

    It requires the geometry of the URDF. ``touch_links`` in [object] may touch the
    object. Links that the joint of the tip moves do not move relative to the object and
    are not checked. Judges measure the convex parts of the links. Solvers use the
    capsules of links whose capsules hardly ever overlap the object unless the links do.
    """

    reason = "object in collision with the robot"
    condition_name = "object clearance"
    reads = (*LINK_KEYS, "object", "object.touch_links")
    bodies = "held object"
    training_weight = 3000.0
    distance: float = field(
        "minimum distance of the object from the links",
        unit="m",
        low=0.0,
        default=0.0,
        plausible=2.0,
    )
    tolerance: float = field(
        "violation that a valid motion may have",
        unit="m",
        low=0.0,
        default=0.0,
        plausible=0.5,
    )

    def symbolic(self, state: "SymbolicState") -> Conditions:
        """State the distances of the capsules' axes from the object [m]."""
        from cnpgen.kernels.symbolic.obstacle_distances import held_cuboid

        cuboid = held_cuboid(state)
        capsules = _solver_capsules(state.robot)
        axes = [state.held_capsules[capsule.link] for capsule in capsules]
        distances = [
            cuboid.separation(first, second, state.freeze) for first, second, _ in axes
        ]
        return self._clear(distances, capsules)

    def measured(self, world: "World") -> Conditions:
        """Measure the signed distances of the convex parts with Coal [m]."""
        distances = world.held_object_distances(self.distance)
        parts = names_of_pairs(world.robot.held_shape)
        return self._at_least(distances, self.distance, parts=parts)

    def solved(self, world: "World") -> Conditions:
        """Return the conditions of the capsules."""
        capsules = _solver_capsules(world.robot)
        return self._clear(
            [0.0] * len(capsules),
            capsules,
            parts=tuple(capsule.link for capsule in capsules),
        )

    def _clear(
        self,
        distances: list[Any],
        capsules: "list[Capsule]",
        parts: tuple[str, ...] = (),
    ) -> Conditions:
        least = np.array([capsule.radius + self.distance for capsule in capsules])
        return self._at_least(distances, least, parts=parts, sufficient=True)


def _solver_capsules(robot: "Robot") -> "list[Capsule]":
    """List the capsules of the links that solvers keep away from the object."""
    shape = robot.held_shape
    # Links that never meet the object need no capsule.
    near = [pair for pair in shape.pairs if pair.colliding > 0] if shape else []
    links = {
        pair.first for pair in near if pair.mistaken <= MAX_HELD_CAPSULE_ERROR_FRACTION
    }
    return (
        [capsule for capsule in shape.capsules if capsule.link in links]
        if shape
        else []
    )


def names_of_pairs(shape: "Shape | None") -> tuple[str, ...]:
    """Return the names of the checked pairs of convex parts."""
    links = [part.link for part in shape.convex_parts] if shape else []
    return tuple(
        f"{links[first]}, {links[second]}"
        for first, second in (shape.checked_pairs if shape else ())
    )
