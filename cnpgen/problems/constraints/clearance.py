"""Collision avoidance: the robot keeps clear of the obstacles, the held object does not enter them."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cnpgen.kernels.symbolic.state import SymbolicState
    from cnpgen.robots.obstacle import Obstacle
    from cnpgen.world.path import PathWorld
    from cnpgen.world.state import World


@dataclass(frozen=True, kw_only=True)
class RobotClearance(Constraint):
    """The robot is further than ``distance`` from every obstacle.

    With the paper's geometry the robot is capsules along the chain (Appendix B, robot collision); the paper's points,
    no further than 10 cm apart, have gaps between them, capsules have none. With its URDF's geometry it is the convex
    pieces of its links, on which ends and motions are judged; solvers keep the links' capsules clear, which is more
    than is asked for.
    """

    reason = "robot in collision"
    radius: float | None = field(
        'radius of the paper\'s capsules, with geometry = "paper-capsules" only', unit="m", low=1e-6, default=None
    )
    distance: float = field("how far the robot must be from obstacles", unit="m", low=0.0, default=0.0, late=True)
    tolerance: float = field("how deep a motion may enter and still be called valid", unit="m", low=0.0)

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the signed distance of every moving segment, or capsule's axis, from every obstacle [m]."""
        from cnpgen.kernels.symbolic.solids import symbolic_solids

        (segments, radii), solids = self._capsules(state), symbolic_solids(state)
        distances = [solid.separation(a, b, state.hold) for a, b in segments for solid in solids]
        return self._clear(distances, radii, sufficient=_is_cautious(state))

    def penalised(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State distances that are easier to descend: inside, the depth of the middle of what is inside [m]."""
        from cnpgen.kernels.symbolic.solids import symbolic_solids

        (segments, radii), solids = self._capsules(state), symbolic_solids(state)
        distances = [solid.descent(a, b, state.hold) for a, b in segments for solid in solids]
        return self._clear(distances, radii, sufficient=_is_cautious(state))

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Measure the signed distances with Coal [m]."""
        shape = world.robot.shape
        if shape is None:
            radius = self.radius or 0.0
            (found,) = self._clear(world.segment_distances(radius + self.distance), [radius])
            bodies = [f"segment {number}" for number, _ in enumerate(world.robot.skeleton, 1)]
        else:
            (found,) = self._clear(world.shape_distances(self.distance), [0.0])
            bodies = [piece.link for piece in shape.moving_pieces]
        return (replace(found, parts=tuple(f"{body}, {box.name}" for body in bodies for box in world.obstacles)),)

    def met(self, path: "PathWorld", slack: float) -> NDArray[np.bool_] | None:
        """Say at which states the links' pieces are far enough from the obstacles."""
        return path.clear_of_obstacles(self.distance - slack) if path.robot.shape else None

    def solved(self, world: "World") -> tuple[Condition, ...]:
        """Return the conditions of the capsules."""
        shape, skeleton = world.robot.shape, world.robot.skeleton
        if shape is None and not _has_poses(world.obstacles):
            return self.measured(world)
        capsules = [self.radius or 0.0] * len(skeleton) if shape is None else [c.radius for c in shape.moving_capsules]
        return self._clear([0.0] * (len(capsules) * len(world.obstacles)), capsules, sufficient=True)

    def _capsules(self, state: "SymbolicState") -> tuple[list[Any], list[float]]:
        """Both ends of the axes of all moving capsules, and their radii [m]."""
        shape = state.robot.shape
        if shape is None:
            return state.segments, [self.radius or 0.0] * len(state.segments)
        moving = [state.capsules[capsule.link] for capsule in shape.moving_capsules]
        return [(first, second) for first, second, _ in moving], [radius for *_, radius in moving]

    def _clear(self, distances: list[Any], radii: list[float], *, sufficient: bool = False) -> tuple[Condition, ...]:
        """State that distances, capsule by capsule, are no smaller than the radii and ``distance``."""
        m = len(distances)
        least = np.repeat(radii, m // max(len(radii), 1)) + self.distance
        return (
            Condition("robot clearance", "m", distances, least, np.full(m, np.inf), "position", sufficient=sufficient),
        )


@dataclass(frozen=True, kw_only=True)
class ObjectContact(Constraint):
    """The held object may touch an obstacle as deep as ``depth``, not deeper (paper, Appendix B, object collision)."""

    reason = "object in collision"
    depth: float = field("contact this deep is legal", unit="m", low=0.0)
    tolerance: float = field("how much deeper a motion may enter and still be called valid", unit="m", low=0.0)

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the separation of the object from every obstacle [m]."""
        from cnpgen.kernels.symbolic.solids import symbolic_solids

        kin, size, solids = state.kinematics, state.object_size or (0.0, 0.0, 0.0), symbolic_solids(state)
        distances = [solid.cuboid_separation(kin.tip, kin.rotation, size) for solid in solids]
        return self._shallow(distances, sufficient=_has_poses(state.obstacles))

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Measure the signed distances with Coal [m]."""
        return self._shallow(world.object_distances(-self.depth))

    def solved(self, world: "World") -> tuple[Condition, ...]:
        """Return the conditions of what solvers see of the obstacles."""
        return self._shallow([0.0] * len(world.obstacles), sufficient=_has_poses(world.obstacles))

    def _shallow(self, distances: list[Any], *, sufficient: bool = False) -> tuple[Condition, ...]:
        m = len(distances)
        least, most = np.full(m, -self.depth), np.full(m, np.inf)
        return (Condition("object contact", "m", distances, least, most, "position", sufficient=sufficient),)


def _is_cautious(state: "SymbolicState") -> bool:
    """Whether solvers may see the robot nearer to an obstacle than it is."""
    return state.robot.shape is not None or _has_poses(state.obstacles)


def _has_poses(obstacles: "Sequence[Obstacle]") -> bool:
    """Whether an obstacle is none of those that solvers and judges see alike."""
    return not all(each.upright for each in obstacles)
