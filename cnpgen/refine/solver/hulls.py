"""Clearances of the links' convex hulls, which some grid levels use in place of capsules.

A capsule is some centimetres larger than its link. For parts that are close to each
other compiled code (``cnpgen.kernels.collision``) returns the distance d, the closest
points x1 and x2, and the unit vector n from the first to the second. The derivative of
the distance, in ``hull_rows.c``, treats points and direction as constant (envelope
theorem): it is the velocity of the points along the direction,

    dd/dq_j = n . (dx2/dq_j - dx1/dq_j),
    n . dx/dq_j = a_j . ((x - o_j) x n)  for a revolute joint that moves x,
                  a_j . n                for a prismatic one, and 0 for other joints,

with the axis a_j of joint j through its origin o_j, in the world frame.
"""

from collections.abc import Iterator
from ctypes import CDLL
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.kernels.collision.collision_checker import MAX_JOINTS, CollisionChecker
from cnpgen.kernels.collision.row_kernels import DistanceColumns, RowKernels
from cnpgen.kernels.kernel import Kernel
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.link_clearance import ObjectClearance, SelfClearance
from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.residuals import DISTANCE_SCALE_M
from cnpgen.refine.solver.transcription import ResidualKernels
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.convex_part import Contacts
from cnpgen.robots.shape.shape import HELD_OBJECT, Shape, with_held_object
from cnpgen.world.rigid_bodies import RigidBodies

Pairs = NDArray[np.intp]
LINK_CONSTRAINTS = RobotClearance | SelfClearance
OBJECT_CONSTRAINTS = ObjectContact | ObjectClearance
# Above the required distance; larger distances are not measured.
MEASURED_RANGE_M = 0.04


def has_clearance_constraints(problem: Problem, robot: Robot) -> bool:
    """Return whether a problem constrains clearances of a robot whose hulls compiled code can measure."""
    constraints = any(isinstance(item, LINK_CONSTRAINTS) for item in problem.constraint)
    return constraints and robot.shape is not None and robot.n <= MAX_JOINTS


@dataclass(frozen=True)
class _Group:
    """Pairs of bodies of one constraint."""

    columns: Pairs  # of the distances of its P pairs, shape (P,)
    required: float  # distance [m]
    of_obstacles: bool  # whether they are obstacles and moving parts, else two links
    # Among all pairs of obstacles and moving parts, or of links, shape (P,).
    numbers: Pairs


class Hulls:
    """Clearances of a robot's convex parts at many states. Not thread-safe: memory is reused.

    ``has_clearance_constraints`` must hold, and the library is that of
    ``load_collision_library``. The held object is a part of the robot only
    ``with_object``.
    """

    def __init__(
        self,
        problem: Problem,
        robot: Robot,
        library: CDLL,
        *,
        with_object: bool = False,
    ) -> None:
        assert robot.shape is not None
        shape = robot.shape
        kinds = LINK_CONSTRAINTS
        if with_object and problem.object_size is not None:
            shape = with_held_object(
                robot.shape, robot.held_shape, robot.chain, problem.object_size
            )
            # The held object becomes a further body of the shape.
            kinds |= OBJECT_CONSTRAINTS
        constraints = [item for item in problem.constraint if isinstance(item, kinds)]
        self._poses_of_checker: Array | None = None
        self._row_kernels: tuple[Kernel, RowKernels] | None = None
        self._obstacles = problem.obstacle
        bodies = RigidBodies(shape, len(problem.obstacle), robot.n)
        self._link_pairs = bodies.link_pairs
        self._obstacle_pairs = bodies.obstacle_pairs
        self._groups = list[_Group]()
        self._set_distances(constraints, self._make_groups(constraints, shape))
        # Largest required distances from obstacles and of links from each other [m];
        # None without such a constraint.
        self.obstacle_distance, added_to_parts = _largest(
            constraints, RobotClearance, ObjectContact
        )
        self.self_distance, added_to_pairs = _largest(
            constraints, SelfClearance, ObjectClearance
        )
        self.checker = _make_checker(
            library, robot, shape, added_to_parts, added_to_pairs
        )

    def _make_groups(self, constraints: list[Any], shape: Shape) -> int:
        """Set the pairs of every constraint, and return the number of distances."""
        links = [part.link for part in shape.convex_parts]
        names = [*links, *range(len(self._obstacles))]
        columns: dict[Any, int] = {}
        for constraint in constraints:
            of_links = isinstance(constraint, SelfClearance | ObjectClearance)
            required = _required(constraint)
            pairs, numbers = self._pairs_of(constraint, names, of_links=of_links)
            # Parts of the same link share a column: its distance is the least of theirs.
            indices = [
                columns.setdefault((names[a], names[b]), len(columns))
                for a, b in pairs.tolist()
            ]
            self._groups.append(
                _Group(np.array(indices, np.intp), required, not of_links, numbers)
            )
        return len(columns)

    def _set_distances(self, constraints: list[Any], count: int) -> None:
        """Set required distances [m], shape (m,), and how far they may be violated, of links with links or obstacles."""
        self.min_distances, accepted = np.full((2, count), -np.inf)
        # Of several constraints of one pair the largest values hold.
        for constraint, group in zip(constraints, self._groups, strict=True):
            np.maximum.at(self.min_distances, group.columns, group.required)
            np.maximum.at(
                accepted, group.columns, group.required - _tolerance(constraint)
            )
        # Distance that is accepted below the required one.
        self.tolerances = self.min_distances - accepted

    def _pairs_of(
        self, constraint: Any, names: list[Any], *, of_links: bool
    ) -> tuple[Pairs, Pairs]:
        """Return the pairs of bodies of a constraint, shape (P, 2), and their numbers among all of their kind."""
        pairs = self._link_pairs if of_links else self._obstacle_pairs
        of_object = np.array(
            [HELD_OBJECT in (names[a], names[b]) for a, b in pairs.tolist()], bool
        )
        numbers = np.flatnonzero(
            of_object == isinstance(constraint, OBJECT_CONSTRAINTS)
        )
        return pairs[numbers], numbers

    def measure(self, q: Array, obstacle_poses: Array) -> Array:
        """Measure the distances of close parts at joint positions q [rad], shape (n, K).

        The result are distances [m], shape (K, m), at most ``MEASURED_RANGE_M`` above
        the required ones, nan if q is not finite.
        """
        # The compiled code needs finite numbers.
        if not np.isfinite(q).all():
            return np.full((q.shape[1], len(self.min_distances)), np.nan)
        distances = np.repeat(
            (self.min_distances + MEASURED_RANGE_M)[None], q.shape[1], axis=0
        )
        for k, column, distance in self._close(q, obstacle_poses):
            np.minimum.at(distances, (k, column), distance)
        return distances

    def violation(
        self, q: Array, obstacle_poses: Array, *, above_tolerance: bool = False
    ) -> float:
        """Return the largest violation of the required distances, or its part above the tolerance [m].

        It is at least 0, and inf if the states q (n, K) are not finite.
        """
        if not np.isfinite(q).all():
            return np.inf
        least = self.min_distances - (self.tolerances if above_tolerance else 0.0)
        violation = 0.0
        for _, column, distance in self._close(q, obstacle_poses, 0.0):
            below = least[column] - distance
            violation = max(violation, float(below.max(initial=0.0)))
        return violation

    def accepted_at(self, q: Array, obstacle_poses: Array) -> Array:
        """Return the accepted part of the violations at states q (n, K): up to the tolerances [m], shape (K, m)."""
        distances = self.measure(q, obstacle_poses)
        return np.asarray(np.clip(self.min_distances - distances, 0.0, self.tolerances))

    def missing(self, q: Array, margins: Array, obstacle_poses: Array) -> Array:
        """Return by how much the distances at states q (n, K) are below the required ones plus margins (K,) [m].

        The result has shape (K, m) and is at least 0.
        """
        missing = np.zeros((q.shape[1], len(self.min_distances)))
        if not np.isfinite(q).all():
            return missing + np.inf
        for k, column, distance in self._close(q, obstacle_poses, float(margins.max())):
            below = self.min_distances[column] + margins[k] - distance
            np.maximum.at(missing, (k, column), below)
        return missing

    def row_kernels(
        self, kernels: ResidualKernels, obstacle_poses: Array
    ) -> RowKernels:
        """Return kernels whose rows end with the distances of ``measure``."""
        checker = self.placed_checker(obstacle_poses)
        columns = self._columns
        if self._row_kernels is None or self._row_kernels[0] is not kernels.values:
            self._row_kernels = (
                kernels.values,
                RowKernels(kernels.values, kernels.jacobian, checker, columns),
            )
        return self._row_kernels[1]

    @cached_property
    def _columns(self) -> DistanceColumns:
        pairs = self._link_pairs, self._obstacle_pairs
        of_links, of_obstacles = rows = [
            np.zeros(len(each), np.int64) for each in pairs
        ]
        for group in self._groups:
            rows[group.of_obstacles][group.numbers] = group.columns
        distances = self.obstacle_distance, self.self_distance
        return DistanceColumns(
            self.min_distances,
            of_obstacles,
            of_links,
            *distances,
            MEASURED_RANGE_M,
            DISTANCE_SCALE_M,
        )

    def placed_checker(self, obstacle_poses: Array) -> CollisionChecker:
        """Return the compiled collision checks among obstacles with these poses and sizes, shape (width,)."""
        if self._poses_of_checker is None or not np.array_equal(
            self._poses_of_checker, obstacle_poses
        ):
            self.checker.place(self._obstacles, obstacle_poses)
            self._poses_of_checker = obstacle_poses.copy()
        return self.checker

    def _close(
        self, q: Array, obstacle_poses: Array, within: float = MEASURED_RANGE_M
    ) -> Iterator[tuple[Pairs, Pairs, Array]]:
        """Yield states, columns and distances [m] of each constraint's pairs, closer than required plus ``within``."""
        checker = self.placed_checker(obstacle_poses)
        found = dict[bool, Contacts]()
        for kind, required in (
            (True, self.obstacle_distance),
            (False, self.self_distance),
        ):
            if required is not None:
                # One search for each kind of pairs, with the largest distance of all
                # constraints.
                found[kind] = checker.close_bodies(
                    q, required + within, of_obstacles=kind
                )
        for group in self._groups:
            close = found[group.of_obstacles]
            # Pairs of other constraints are among them: numbers ascend.
            pair = np.searchsorted(group.numbers, close.pair)
            pair[pair == len(group.numbers)] = 0
            kept = (close.distance < group.required + within) & (
                group.numbers[pair] == close.pair
            )
            yield close.k[kept], group.columns[pair[kept]], close.distance[kept]


def _make_checker(
    library: CDLL,
    robot: Robot,
    shape: Shape,
    added_to_parts: list[float],
    added_to_pairs: list[float],
) -> CollisionChecker:
    """Return the compiled checker, with required distances [m] added to (links, held object), of parts and pairs."""
    added_to_links, added_to_object = added_to_parts
    of_parts = dict.fromkeys(shape.joints, added_to_links) | {
        HELD_OBJECT: added_to_object
    }
    names = (frozenset((pair.first, pair.second)) for pair in shape.pairs)
    of_pairs = {pair: added_to_pairs[HELD_OBJECT in pair] for pair in names}
    return CollisionChecker(library, robot, shape, of_parts, of_pairs)


def _required(constraint: Any) -> float:
    """Return the distance that a constraint requires [m].

    Contacts of the held object have a depth.
    """
    return (
        -float(constraint.depth)
        if isinstance(constraint, ObjectContact)
        else float(constraint.distance)
    )


def _tolerance(constraint: Any) -> float:
    """Return the violation of a constraint that a valid motion may have [m]."""
    return float(
        constraint.tolerance
        if isinstance(constraint, ObjectContact)
        else constraint.effective_tolerance
    )


def _largest(constraints: list[Any], *kinds: type) -> tuple[float | None, list[float]]:
    """Return the largest distance that constraints of some kinds require [m], and what each kind adds to it."""
    largest = [
        max(
            (_required(item) for item in constraints if isinstance(item, kind)),
            default=-np.inf,
        )
        for kind in kinds
    ]
    required = max(largest)
    return (
        (None, largest)
        if required == -np.inf
        else (required, [distance - required for distance in largest])
    )
