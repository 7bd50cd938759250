"""Clearances of the links' convex hulls, which some grid levels use in place of capsules.

A capsule is some centimetres larger than its link. For parts that are close to each
other compiled code (``cnpgen.kernels.collision``), or Coal without a compiler, returns
the distance d, the closest points x1 and x2, and the unit vector n from the first to
the second. The derivative of the distance treats points and direction as constant
(envelope theorem): it is the velocity of the points along the direction,

    dd/dq_j = n . (dx2/dq_j - dx1/dq_j),
    n . dx/dq_j = a_j . ((x - o_j) x n)  for a revolute joint that moves x,
                  a_j . n                for a prismatic one, and 0 for other joints,

with the axis a_j of joint j through its origin o_j, in the world frame.
"""

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
from cnpgen.robots.solid import solids_of
from cnpgen.world.forward_kinematics import ForwardKinematics
from cnpgen.world.rigid_bodies import RigidBodies

Pairs = NDArray[np.intp]
LINK_CONSTRAINTS, OBJECT_CONSTRAINTS = (
    RobotClearance | SelfClearance,
    ObjectContact | ObjectClearance,
)
# Above the required distance; larger distances are not measured.
MEASURED_RANGE_M = 0.04


def has_clearance_constraints(problem: Problem, robot: Robot) -> bool:
    """Return whether a problem constrains clearances of a robot with link geometry."""
    constraints = any(isinstance(item, LINK_CONSTRAINTS) for item in problem.constraint)
    return constraints and robot.shape is not None


@dataclass(frozen=True)
class _Group:
    """Pairs of bodies of one constraint."""

    pairs: Pairs  # shape (P, 2)
    columns: Pairs  # of their distances, shape (P,)
    required: float  # distance [m]
    of_obstacles: bool  # whether they are obstacles and moving parts, else two links
    # Among all pairs of obstacles and moving parts, or of links, shape (P,).
    numbers: Pairs


class Hulls:
    """Clearances of a robot's convex parts at many states. Not thread-safe: memory is reused.

    ``has_clearance_constraints`` must hold. Without a library of compiled collision
    checks Coal measures. The held object is a part of the robot only ``with_object``.
    """

    def __init__(
        self,
        problem: Problem,
        robot: Robot,
        library: CDLL | None = None,
        *,
        with_object: bool = False,
    ) -> None:
        assert robot.shape is not None
        shape, kinds = robot.shape, LINK_CONSTRAINTS
        if with_object and problem.object_size is not None:
            shape = with_held_object(
                robot.shape, robot.held_shape, robot.chain, problem.object_size
            )
            kinds |= OBJECT_CONSTRAINTS
        constraints = [item for item in problem.constraint if isinstance(item, kinds)]
        self._poses_of_checker: Array | None = None
        self._row_kernels: tuple[Kernel, RowKernels] | None = None
        self._obstacles, self._n, self._kinematics = (
            problem.obstacle,
            robot.n,
            ForwardKinematics(robot.model),
        )
        self._bodies = RigidBodies(shape, len(problem.obstacle), robot.n)
        self._groups, self._uncovered = list[_Group](), list[tuple[Pairs, float]]()
        self._set_distances(constraints, self._make_groups(constraints, shape))
        # Largest required distances from obstacles and of links from each other [m];
        # None without such a constraint.
        self.obstacle_distance, added_to_parts = _largest(
            constraints, RobotClearance, ObjectContact
        )
        self.self_distance, added_to_pairs = _largest(
            constraints, SelfClearance, ObjectClearance
        )
        self.checker = (
            None
            if library is None or robot.n > MAX_JOINTS
            else _make_checker(library, robot, shape, added_to_parts, added_to_pairs)
        )
        self._axes = np.array([joint.axis for joint in robot.chain.joints])
        self._sliding = np.array(robot.prismatic)
        supports = [list(joints) for joints in robot.model.supports]
        # Joint j moves body b if it is among the joints between the base and b.
        self._moves = np.array(
            [[joint in above for joint in range(1, robot.n + 1)] for above in supports]
        )

    def _make_groups(self, constraints: list[Any], shape: Shape) -> int:
        """Set the pairs of every constraint, and return the number of distances."""
        links = [part.link for part in shape.convex_parts]
        names = [*links, *range(len(self._obstacles))]
        columns: dict[Any, int] = {}
        covered = {
            frozenset((pair.first, pair.second))
            for pair in shape.pairs
            if pair.for_solvers
        }
        for constraint in constraints:
            of_links, required = (
                isinstance(constraint, SelfClearance | ObjectClearance),
                _required(constraint),
            )
            pairs, numbers = self._pairs_of(constraint, names, of_links=of_links)
            # Parts of the same link share a column: its distance is the least of theirs.
            indices = [
                columns.setdefault((names[a], names[b]), len(columns))
                for a, b in pairs.tolist()
            ]
            self._groups.append(
                _Group(
                    pairs, np.array(indices, np.intp), required, not of_links, numbers
                )
            )
            if of_links:
                uncovered = [
                    frozenset((names[a], names[b])) not in covered
                    for a, b in pairs.tolist()
                ]
                self._uncovered.append((pairs[np.array(uncovered, bool)], required))
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
        self.tolerances = self.min_distances - accepted

    def _pairs_of(
        self, constraint: Any, names: list[Any], *, of_links: bool
    ) -> tuple[Pairs, Pairs]:
        """Return the pairs of bodies of a constraint, shape (P, 2), and their numbers among all of their kind."""
        pairs = self._bodies.link_pairs if of_links else self._bodies.obstacle_pairs
        of_object = np.array(
            [HELD_OBJECT in (names[a], names[b]) for a, b in pairs.tolist()], bool
        )
        numbers = np.flatnonzero(
            of_object == isinstance(constraint, OBJECT_CONSTRAINTS)
        )
        return pairs[numbers], numbers

    def measure(self, q: Array, obstacle_poses: Array) -> tuple[Array, list[Contacts]]:
        """Measure the distances of close parts at joint positions q [rad], shape (n, K).

        The result are distances [m], shape (K, m), at most ``MEASURED_RANGE_M`` above
        the required ones, nan if q is not finite; and the contacts of every constraint.
        """
        if not np.isfinite(q).all():
            return np.full((q.shape[1], len(self.min_distances)), np.nan), []
        distances = np.repeat(
            (self.min_distances + MEASURED_RANGE_M)[None], q.shape[1], axis=0
        )
        groups = self._contacts(q, obstacle_poses)
        for contacts, group in zip(groups, self._groups, strict=True):
            np.minimum.at(
                distances, (contacts.k, group.columns[contacts.pair]), contacts.distance
            )
        return distances, groups

    def clear_states(
        self, q: Array, obstacle_poses: Array, *, uncovered_only: bool = False
    ) -> NDArray[np.bool_]:
        """Return a mask of the states q (n, K) with the required distances, shape (K,).

        With ``uncovered_only`` only pairs of links that the solver's capsules do not
        cover are checked.
        """
        if self.checker is not None:
            limit = None if uncovered_only else self.obstacle_distance
            checker = self.placed_checker(obstacle_poses)
            return checker.clear_states(
                q, obstacle_distance=limit, self_distance=self.self_distance
            )
        self._place(q, obstacle_poses)
        clear = np.ones(q.shape[1], bool)
        checked = (
            self._uncovered
            if uncovered_only
            else [(group.pairs, group.required) for group in self._groups]
        )
        for pairs, required in checked:
            clear &= self._bodies.pair_distances(pairs).clear_states(required)
        return clear

    def violation(
        self, q: Array, obstacle_poses: Array, *, above_tolerance: bool = False
    ) -> float:
        """Return the largest violation of the required distances, or its part above the tolerance [m].

        It is at least 0, and inf if the states q (n, K) are not finite.
        """
        if not np.isfinite(q).all():
            return np.inf
        least, violation = (
            self.min_distances - (self.tolerances if above_tolerance else 0.0),
            0.0,
        )
        for contacts, group in zip(
            self._contacts(q, obstacle_poses, 0.0), self._groups, strict=True
        ):
            below = least[group.columns[contacts.pair]] - contacts.distance
            violation = max(violation, float(below.max(initial=0.0)))
        return violation

    def accepted_at(self, q: Array, obstacle_poses: Array) -> Array:
        """Return the accepted part of the violations at states q (n, K): up to the tolerances [m], shape (K, m)."""
        distances, _ = self.measure(q, obstacle_poses)
        return np.asarray(np.clip(self.min_distances - distances, 0.0, self.tolerances))

    def missing(self, q: Array, margins: Array, obstacle_poses: Array) -> Array:
        """Return by how much the distances at states q (n, K) are below the required ones plus margins (K,) [m].

        The result has shape (K, m) and is at least 0.
        """
        missing = np.zeros((q.shape[1], len(self.min_distances)))
        if not np.isfinite(q).all():
            return missing + np.inf
        contacts_of = self._contacts(q, obstacle_poses, float(margins.max()))
        for contacts, group in zip(contacts_of, self._groups, strict=True):
            column = group.columns[contacts.pair]
            below = self.min_distances[column] + margins[contacts.k] - contacts.distance
            np.maximum.at(missing, (contacts.k, column), below)
        return missing

    def gradients(self, q: Array, distances: Array, groups: list[Contacts]) -> Array:
        """Differentiate the result of ``measure`` in q: shape (n, m, K), 0 for parts out of range."""
        gradients = np.zeros((q.shape[1], len(self.min_distances), self._n))
        # Of the joints in the world frame.
        rotations, positions = self._kinematics.poses(q)
        axes, origins = (
            np.einsum("jxyk,jy->kjx", rotations[1:], self._axes),
            positions[1:].transpose(2, 0, 1),
        )
        for contacts, group in zip(groups, self._groups, strict=True):
            k, column = contacts.k, group.columns[contacts.pair]
            normals = np.repeat(contacts.normal[:, None], 2, axis=1)
            # a . ((x - o) x n) = a . (x x n) + (o x a) . n: the first term needs one
            # product for both points, the second is that of the joint alone.
            levers = np.cross(contacts.points, normals)
            turning = np.einsum("cjx,cbx->cbj", axes[k], levers)
            turning += np.einsum("cjx,cbx->cbj", np.cross(origins, axes)[k], normals)
            speeds = np.where(
                self._sliding, np.einsum("cjx,cbx->cbj", axes[k], normals), turning
            )
            speeds *= self._moves[self._bodies.joints_of(group.pairs[contacts.pair])]
            # Several parts of a pair of links share a column: the closest one decides.
            nearest = contacts.distance <= distances[k, column]
            gradients[k[nearest], column[nearest]] = (speeds[:, 1] - speeds[:, 0])[
                nearest
            ]
        return gradients.transpose(2, 1, 0)

    def row_kernels(
        self, kernels: ResidualKernels, obstacle_poses: Array
    ) -> RowKernels:
        """Return kernels whose rows end with the distances of ``measure``.

        Compiled kernels and checks are required.
        """
        checker, columns = self.placed_checker(obstacle_poses), self._columns
        if self._row_kernels is None or self._row_kernels[0] is not kernels.values:
            self._row_kernels = (
                kernels.values,
                RowKernels(kernels.values, kernels.jacobian, checker, columns),
            )
        return self._row_kernels[1]

    @cached_property
    def _columns(self) -> DistanceColumns:
        pairs = self._bodies.link_pairs, self._bodies.obstacle_pairs
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
        assert self.checker is not None
        if self._poses_of_checker is None or not np.array_equal(
            self._poses_of_checker, obstacle_poses
        ):
            self.checker.place(self._obstacles, obstacle_poses)
            self._poses_of_checker = obstacle_poses.copy()
        return self.checker

    def _contacts(
        self, q: Array, obstacle_poses: Array, within: float = MEASURED_RANGE_M
    ) -> list[Contacts]:
        """Measure the contacts of every constraint closer than the required distance plus ``within`` [m]."""
        if self.checker is None:
            self._place(q, obstacle_poses)
            return [
                self._bodies.contacts(group.pairs, group.required + within)
                for group in self._groups
            ]
        checker, found = self.placed_checker(obstacle_poses), dict[bool, Contacts]()
        for kind, required in (
            (True, self.obstacle_distance),
            (False, self.self_distance),
        ):
            if required is not None:
                found[kind] = checker.close_bodies(
                    q, required + within, of_obstacles=kind
                )
        return [
            self._contacts_of(group, found[group.of_obstacles], group.required + within)
            for group in self._groups
        ]

    def _contacts_of(self, group: _Group, close: Contacts, within: float) -> Contacts:
        """Return the pairs of a group that are closer than ``within`` [m]."""
        pair = np.searchsorted(group.numbers, close.pair)
        pair[pair == len(group.numbers)] = 0
        kept = np.flatnonzero(
            (close.distance < within) & (group.numbers[pair] == close.pair)
        )
        pair = pair[kept].astype(np.intp)
        k, distance, normal, points = (
            close.k[kept],
            close.distance[kept],
            close.normal[kept],
            close.points[kept],
        )
        return Contacts(pair, k, distance, normal, points)

    def _place(self, q: Array, obstacle_poses: Array) -> None:
        self._bodies.place(
            *self._kinematics.poses(q), solids_of(self._obstacles, obstacle_poses)
        )


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
