"""Collision constraints: clearance of the robot and contact depth of the held object."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from cnpgen.arrays import Mask
from cnpgen.problems.constraints.constraint import Condition, Conditions, Constraint
from cnpgen.robots.parameter_ranges import optional_key
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.robots.obstacle import Obstacle
    from cnpgen.world.path import PathWorld
    from cnpgen.world.world import World

# Of links in a valid motion: the accuracy of distances, no tolerance for collisions.
MAX_LINK_PENETRATION_M = 1e-4
# Keys of the geometry of the links.
LINK_KEYS = (
    "robot.convex_parts",
    "robot.decomposed",
    "robot.visual_links",
    "robot.skipped_meshes",
)
# Those of the shape of the robot, with its payload.
ROBOT_KEYS = ("robot.geometry", *LINK_KEYS, "payload.touch_links")


@dataclass(frozen=True, kw_only=True)
class DistanceConstraint(Constraint):
    """Base class: the distances of bodies are at least a bound; judges also check them between samples.

    Attributes:
        condition_name: Name of the condition.
        bodies: The bodies, see ``cnpgen.world.path.PathWorld.pairs``.
    """

    condition_name: ClassVar[str]
    bodies: ClassVar[str]

    def _at_least(
        self,
        distances: list[Any],
        least: Any,
        *,
        parts: tuple[str, ...] = (),
        sufficient: bool = False,
    ) -> Conditions:
        """State that m distances are at least one bound, or m [m]."""
        m = len(distances)
        lower = np.full(m, least, float)
        upper = np.full(m, np.inf)
        return (
            Condition(
                self.condition_name,
                "m",
                distances,
                lower,
                upper,
                "position",
                parts,
                sufficient,
            ),
        )


@dataclass(frozen=True, kw_only=True)
class RobotClearance(DistanceConstraint):
    """Constraint: the robot is further than ``distance`` from every obstacle.

    With the paper's geometry the robot consists of capsules along the chain (Appendix
    B, robot collision). Unlike the paper's points every 10 cm, capsules have no gaps.
    With the URDF's geometry, judges use the convex parts of the links. Solvers use the
    links' capsules, which is conservative.
    """

    reason = "robot in collision"
    condition_name = "robot clearance"
    reads = ROBOT_KEYS
    bodies = "robot"
    training_weight = 3000.0
    radius: float | None = field(
        'radius of the paper\'s capsules, with geometry = "paper-capsules" only',
        unit="m",
        low=1e-6,
        default=None,
        plausible=2.0,
    )
    distance: float = optional_key(
        "minimum distance of the robot from obstacles",
        unit="m",
        low=0.0,
        default=0.0,
        plausible=2.0,
    )
    tolerance: float = field(
        "violation that a valid motion may have; links may enter obstacles by 0.1 mm, the paper's capsules by all"
        " of it",
        unit="m",
        low=0.0,
        plausible=0.5,
    )

    @property
    def effective_tolerance(self) -> float:
        """Tolerance up to a penetration of ``MAX_LINK_PENETRATION_M``.

        With the paper's capsules all of it.
        """
        # A distance may be missed by all of the tolerance, as long as the bodies
        # overlap by at most 0.1 mm.
        limit = (
            np.inf
            if self.radius is not None
            else self.distance + MAX_LINK_PENETRATION_M
        )
        return min(self.tolerance, limit)

    def symbolic(self, state: "SymbolicState") -> Conditions:
        """State the signed distance of every moving segment, or capsule's axis, from every obstacle [m]."""
        from cnpgen.kernels.symbolic.obstacle_distances import symbolic_solids

        # Axes of capsules: the radius is in the bound.
        segments, radii = self._capsules(state)
        solids = symbolic_solids(state)
        distances = [
            solid.separation(a, b, state.freeze)
            for a, b in segments
            for solid in solids
        ]
        return self._clear(distances, radii, sufficient=_is_cautious(state))

    def penalized(self, state: "SymbolicState") -> Conditions:
        """State distances with better gradients: inside an obstacle, the depth of the center [m]."""
        from cnpgen.kernels.symbolic.obstacle_distances import symbolic_solids

        segments, radii = self._capsules(state)
        solids = symbolic_solids(state)
        distances = [
            solid.smooth_separation(a, b, state.freeze)
            for a, b in segments
            for solid in solids
        ]
        return self._clear(distances, radii, sufficient=_is_cautious(state))

    def measured(self, world: "World") -> Conditions:
        """Measure the signed distances with Coal [m]."""
        shape = world.robot.shape
        if shape is None:
            # Capsules of the paper: Coal measures the axes, and the bound contains the
            # radius.
            radius = self.radius or 0.0
            (found,) = self._clear(
                world.segment_distances(radius + self.distance), [radius]
            )
            bodies = [
                f"segment {number}"
                for number, _ in enumerate(world.robot.capsule_axes, 1)
            ]
        else:
            # Judges stop at the required distance: exact values matter only where it is
            # not met.
            (found,) = self._clear(world.shape_distances(self.distance), [0.0])
            bodies = [piece.link for piece in shape.moving_convex_parts]
        return (
            replace(
                found,
                parts=tuple(
                    f"{body}, {box.name}" for body in bodies for box in world.obstacles
                ),
            ),
        )

    def met(self, path: "PathWorld", tolerance: float) -> Mask | None:
        """Return a mask of the states with sufficient distance of the convex parts from the obstacles."""
        return (
            path.pairs(self.bodies).clear_states(self.distance - tolerance)
            if path.robot.shape
            else None
        )

    def solved(self, world: "World") -> Conditions:
        """Return the conditions of the capsules."""
        shape = world.robot.shape
        capsule_axes = world.robot.capsule_axes
        # Solvers and judges use the same shapes here: capsules and upright obstacles.
        if shape is None and not _has_poses(world.obstacles):
            return self.measured(world)
        capsules = (
            [self.radius or 0.0] * len(capsule_axes)
            if shape is None
            else [c.radius for c in shape.moving_capsules]
        )
        # Solvers read the bounds only: the zeros are placeholders.
        return self._clear(
            [0.0] * (len(capsules) * len(world.obstacles)), capsules, sufficient=True
        )

    def _capsules(self, state: "SymbolicState") -> tuple[list[Any], list[float]]:
        """Return both ends of the axes of all moving capsules, and their radii [m]."""
        shape = state.robot.shape
        if shape is None:
            return state.segments, [self.radius or 0.0] * len(state.segments)
        moving = [state.capsules[capsule.link] for capsule in shape.moving_capsules]
        return [(first, second) for first, second, _ in moving], [
            radius for *_, radius in moving
        ]

    def _clear(
        self, distances: list[Any], radii: list[float], *, sufficient: bool = False
    ) -> Conditions:
        """State that the distance of every capsule axis is at least its radius plus ``distance``."""
        # Distances are ordered capsule by capsule: each radius is repeated for all
        # obstacles.
        least = np.repeat(radii, len(distances) // max(len(radii), 1)) + self.distance
        return self._at_least(distances, least, sufficient=sufficient)


@dataclass(frozen=True, kw_only=True)
class ObjectContact(DistanceConstraint):
    """Constraint: the held object penetrates obstacles by at most ``depth`` (paper, Appendix B, object collision)."""

    reason = "object in collision"
    condition_name = "object contact"
    reads = ("object",)
    bodies = "object"
    training_weight, training_inset = 3e4, 5e-4  # the inset in m
    depth: float = field("depth of legal contact", unit="m", low=0.0, plausible=0.5)
    tolerance: float = field(
        "additional depth that a valid motion may have",
        unit="m",
        low=0.0,
        plausible=0.5,
    )

    def symbolic(self, state: "SymbolicState") -> Conditions:
        """State the separation of the object from every obstacle [m]."""
        from cnpgen.kernels.symbolic.obstacle_distances import symbolic_solids

        kin = state.kinematics
        size = state.object_size or (0.0, 0.0, 0.0)
        solids = symbolic_solids(state)
        distances = [
            solid.cuboid_separation(kin.tip, kin.rotation, size) for solid in solids
        ]
        return self._at_least(
            distances, -self.depth, sufficient=_has_poses(state.obstacles)
        )

    def measured(self, world: "World") -> Conditions:
        """Measure the signed distances with Coal [m]."""
        # Legal contacts have distances down to -depth, so the search for the distance
        # stops there.
        return self._at_least(world.object_distances(-self.depth), -self.depth)

    def solved(self, world: "World") -> Conditions:
        """Return the conditions on the solver's shapes of the obstacles."""
        return self._at_least(
            [0.0] * len(world.obstacles),
            -self.depth,
            sufficient=_has_poses(world.obstacles),
        )


def _is_cautious(state: "SymbolicState") -> bool:
    """Return whether the solver's distance to an obstacle may be smaller than the true one."""
    return state.robot.shape is not None or _has_poses(state.obstacles)


def _has_poses(obstacles: "Sequence[Obstacle]") -> bool:
    """Return whether solvers and judges use different shapes of an obstacle."""
    return not all(each.upright for each in obstacles)
