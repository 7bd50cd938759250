"""Clearances of the links' convex hulls, which some grid levels use in place of capsules.

A capsule is some centimetres larger than its link. For parts that are close to each other compiled code
(``cnpgen.kernels.collision``), or Coal without a compiler, returns the distance, the closest points and the direction.
The derivative of the distance treats the closest points and the direction as constant (envelope theorem): it is the
velocity of the points along the direction.
"""

from ctypes import CDLL
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.collision.collision_checker import MAX_JOINTS, CollisionChecker
from cnpgen.kernels.collision.row_kernels import DistanceColumns, RowKernels
from cnpgen.kernels.kernel import Kernel
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.self_clearance import SelfClearance
from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.grid import Grid
from cnpgen.refine.solver.residuals import DISTANCE_SCALE_M
from cnpgen.refine.solver.transcription import Linearization, ResidualKernels, Transcription, cache_last
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import solids_of
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.forward_kinematics import ForwardKinematics
from cnpgen.world.rigid_bodies import Contacts, RigidBodies

Array = NDArray[np.float64]
MEASURED_RANGE_M = 0.04  # above the required distance; larger distances are not measured


def has_clearance_constraints(problem: Problem, robot: Robot) -> bool:
    """Return whether a problem constrains clearances of a robot with link geometry."""
    constraints = any(isinstance(item, RobotClearance | SelfClearance) for item in problem.constraint)
    return constraints and robot.shape is not None


class Hulls:
    """Clearances of a robot's convex parts at many states. Not thread-safe: memory is reused.

    Args:
        problem: The problem.
        robot: Its robot; ``has_clearance_constraints`` must hold.
        library: Library of compiled collision checks, or None to measure with Coal.

    Attributes:
        checker: Compiled collision checks, or None.
        obstacle_distance: Required distance from obstacles [m], None without such a constraint.
        self_distance: Required distance of links from each other [m], None without such a constraint.
        min_distances: Required distances [m], shape (m,), of pairs of links or of a link and an obstacle.
        tolerance: Accepted violation of them in a valid motion [m].
    """

    def __init__(self, problem: Problem, robot: Robot, library: CDLL | None = None) -> None:
        assert robot.shape is not None
        usable = library is not None and robot.n <= MAX_JOINTS
        self.checker = CollisionChecker(library, robot) if library is not None and usable else None
        self._poses_of_checker: Array | None = None
        self._row_kernels: tuple[Kernel, RowKernels] | None = None
        self._obstacles, self._n, self._kinematics = problem.obstacle, robot.n, ForwardKinematics(robot.model)
        self._bodies = RigidBodies(robot.shape, len(problem.obstacle), robot.n)
        constraints = [item for item in problem.constraint if isinstance(item, RobotClearance | SelfClearance)]
        links = [part.link for part in robot.shape.convex_parts]
        names = [*links, *range(len(problem.obstacle))]
        columns: dict[Any, int] = {}
        self._groups, self._uncovered, min_distances = [], [], dict[int, float]()
        covered = {frozenset((pair.first, pair.second)) for pair in robot.shape.pairs if pair.for_solvers}
        for constraint in constraints:
            of_obstacles = isinstance(constraint, RobotClearance)
            pairs = self._bodies.obstacle_pairs if of_obstacles else self._bodies.link_pairs
            indices = [columns.setdefault((names[a], names[b]), len(columns)) for a, b in pairs.tolist()]
            min_distances |= {column: max(min_distances.get(column, 0.0), constraint.distance) for column in indices}
            self._groups.append((pairs, np.array(indices, np.intp), constraint.distance))
            if not of_obstacles:
                uncovered = [frozenset((names[a], names[b])) not in covered for a, b in pairs.tolist()]
                self._uncovered.append((pairs[np.array(uncovered, bool)], indices, constraint.distance))
        self.min_distances = np.array([min_distances[column] for column in range(len(columns))])
        self.tolerance = max(constraint.effective_tolerance for constraint in constraints)
        self.obstacle_distance = _largest_distance(constraints, RobotClearance)
        self.self_distance = _largest_distance(constraints, SelfClearance)
        self._axes = np.array([joint.axis for joint in robot.chain.joints])
        self._sliding = np.array(robot.sliding)
        supports = [list(joints) for joints in robot.model.supports]
        self._moves = np.array([[joint in above for joint in range(1, robot.n + 1)] for above in supports])

    def measure(self, q: Array, obstacle_poses: Array) -> tuple[Array, list[Contacts]]:
        """Measure the distances of close parts.

        Args:
            q: Joint positions [rad], shape (n, K).
            obstacle_poses: Poses and sizes of the obstacles, shape (width,).

        Returns:
            Distances [m], shape (K, m), at most ``MEASURED_RANGE_M`` above the required ones, nan if q is not finite;
            and the contacts of every constraint.
        """
        if not np.isfinite(q).all():
            return np.full((q.shape[1], len(self.min_distances)), np.nan), []
        distances = np.repeat((self.min_distances + MEASURED_RANGE_M)[None], q.shape[1], axis=0)
        groups = self._contacts(q, obstacle_poses)
        for contacts, (_, columns, _) in zip(groups, self._groups, strict=True):
            np.minimum.at(distances, (contacts.k, columns[contacts.pair]), contacts.distance)
        return distances, groups

    def clear_states(self, q: Array, obstacle_poses: Array, *, uncovered_only: bool = False) -> NDArray[np.bool_]:
        """Return a mask of the states with the required distances, shape (K,).

        Args:
            q: Joint positions [rad], shape (n, K).
            obstacle_poses: Poses and sizes of the obstacles, shape (width,).
            uncovered_only: Whether to check only pairs of links that the solver's capsules do not cover.
        """
        if self.checker is not None:
            limit = None if uncovered_only else self.obstacle_distance
            checker = self.placed_checker(obstacle_poses)
            return checker.clear_states(q, obstacle_distance=limit, self_distance=self.self_distance)
        self._place(q, obstacle_poses)
        clear = np.ones(q.shape[1], bool)
        for pairs, _, required in self._uncovered if uncovered_only else self._groups:
            clear &= self._bodies.pair_distances(pairs).clear_states(required)
        return clear

    def max_penetration(self, q: Array, obstacle_poses: Array) -> float:
        """Return the largest violation of the required distances at states q (n, K) [m]."""
        return float((self.min_distances - self.measure(q, obstacle_poses)[0]).max(initial=-MEASURED_RANGE_M))

    def violation(self, q: Array, obstacle_poses: Array) -> float:
        """Return the largest violation of the required distances at states q (n, K) [m], at least 0."""
        if self.checker is None or not np.isfinite(q).all():
            return max(self.max_penetration(q, obstacle_poses), 0.0) if np.isfinite(q).all() else np.inf
        checker, violation = self.placed_checker(obstacle_poses), 0.0
        for required, of_obstacles in ((self.obstacle_distance, True), (self.self_distance, False)):
            if required is not None:
                close = checker.close_bodies(q, required, of_obstacles=of_obstacles)
                violation = max(violation, float((required - close.distance).max(initial=0.0)))
        return violation

    def missing(self, q: Array, margins: Array, obstacle_poses: Array) -> Array:
        """Return by how much the distances at states q (n, K) are below the required ones plus margins [m], at least 0.

        Args:
            q: Joint positions [rad], shape (n, K).
            margins: Additional distance at every state [m], shape (K,).
            obstacle_poses: Poses and sizes of the obstacles, shape (width,).

        Returns:
            Shape (K, m).
        """
        missing = np.zeros((q.shape[1], len(self.min_distances)))
        if not np.isfinite(q).all():
            return missing + np.inf
        contacts_of = self._contacts(q, obstacle_poses, float(margins.max()))
        for contacts, (_, columns, _) in zip(contacts_of, self._groups, strict=True):
            column = columns[contacts.pair]
            below = self.min_distances[column] + margins[contacts.k] - contacts.distance
            np.maximum.at(missing, (contacts.k, column), below)
        return missing

    def gradients(self, q: Array, distances: Array, groups: list[Contacts]) -> Array:
        """Differentiate the result of ``measure`` in q: shape (n, m, K), 0 for parts out of range."""
        gradients = np.zeros((q.shape[1], len(self.min_distances), self._n))
        axes, origins = self._joint_axes(q)
        for contacts, (_, columns, _) in zip(groups, self._groups, strict=True):
            k, column = contacts.k, columns[contacts.pair]
            normals = np.repeat(contacts.normal[:, None], 2, axis=1)
            levers = np.cross(contacts.points, normals)  # of a unit force at the points, about the world's origin
            turning = np.einsum("cjx,cbx->cbj", axes[k], levers)
            turning += np.einsum("cjx,cbx->cbj", np.cross(origins, axes)[k], normals)
            speeds = np.where(self._sliding, np.einsum("cjx,cbx->cbj", axes[k], normals), turning)
            speeds *= self._moves[contacts.joints]
            nearest = contacts.distance <= distances[k, column]
            gradients[k[nearest], column[nearest]] = (speeds[:, 1] - speeds[:, 0])[nearest]
        return gradients.transpose(2, 1, 0)

    def row_kernels(self, kernels: ResidualKernels, obstacle_poses: Array) -> RowKernels:
        """Return kernels whose rows end with the distances of ``measure``; compiled kernels and checks are required."""
        checker, columns = self.placed_checker(obstacle_poses), self._columns
        if self._row_kernels is None or self._row_kernels[0] is not kernels.values:
            self._row_kernels = kernels.values, RowKernels(kernels.values, kernels.jacobian, checker, columns)
        return self._row_kernels[1]

    @cached_property
    def _columns(self) -> DistanceColumns:
        rows = {True: np.zeros(0, np.int64), False: np.zeros(0, np.int64)}
        for pairs, indices, _ in self._groups:
            rows[pairs is self._bodies.obstacle_pairs] = np.ascontiguousarray(indices, np.int64)
        distances = self.obstacle_distance, self.self_distance
        return DistanceColumns(
            self.min_distances, rows[True], rows[False], *distances, MEASURED_RANGE_M, DISTANCE_SCALE_M
        )

    def placed_checker(self, obstacle_poses: Array) -> CollisionChecker:
        """Return the compiled collision checks among obstacles with these poses and sizes, shape (width,)."""
        assert self.checker is not None
        if self._poses_of_checker is None or not np.array_equal(self._poses_of_checker, obstacle_poses):
            self.checker.place(self._obstacles, obstacle_poses)
            self._poses_of_checker = obstacle_poses.copy()
        return self.checker

    def _contacts(self, q: Array, obstacle_poses: Array, within: float = MEASURED_RANGE_M) -> list[Contacts]:
        """Measure the contacts of every constraint closer than the required distance plus ``within`` [m]."""
        if self.checker is None:
            self._place(q, obstacle_poses)
            return [self._bodies.contacts(pairs, required + within) for pairs, _, required in self._groups]
        checker, groups = self.placed_checker(obstacle_poses), []
        for pairs, _, required in self._groups:
            of_obstacles = pairs is self._bodies.obstacle_pairs
            close = checker.close_bodies(q, required + within, of_obstacles=of_obstacles)
            groups.append(Contacts(*close, joints=self._bodies.joints_of(pairs[close.pair])))
        return groups

    def _joint_axes(self, q: Array) -> tuple[Array, Array]:
        """Return axes and origins [m] of the joints in the world frame, shape (K, n, 3) each."""
        rotations, positions = self._kinematics.poses(q)
        axes = np.einsum("jxyk,jy->kjx", rotations[1:], self._axes)
        return axes, positions[1:].transpose(2, 0, 1)

    def _place(self, q: Array, obstacle_poses: Array) -> None:
        self._bodies.place(*self._kinematics.poses(q), solids_of(self._obstacles, obstacle_poses))


def _largest_distance(constraints: list[Any], kind: type) -> float | None:
    chosen: list[Any] = [constraint for constraint in constraints if isinstance(constraint, kind)]
    return max((float(constraint.distance) for constraint in chosen), default=None)


class CompiledHullTranscription(Transcription):
    """One motion on one grid with the clearances of the links' hulls as further residuals, evaluated in compiled code.

    Args:
        kernels: Residual kernels with compiled code.
        grid: The grid.
        hulls: Clearances of the hulls with compiled checks.
        boundary: Boundary conditions of one motion.
        kernel_poses: Scene values that the residual kernels take, shape (width,).
        obstacle_poses: Poses and sizes of the obstacles, shape (width,).
    """

    def __init__(
        self,
        kernels: ResidualKernels,
        grid: Grid,
        hulls: Hulls,
        *,
        boundary: Boundary,
        kernel_poses: Array,
        obstacle_poses: Array,
    ) -> None:
        self._rows = hulls.row_kernels(kernels, obstacle_poses)
        with_rows = replace(kernels, values=self._rows.values, jacobian=self._rows.jacobian)
        super().__init__(with_rows, grid, boundary=boundary, obstacle_poses=kernel_poses)

    def activate(self) -> None:
        """Make the kernels those of this thread, see ``RowKernels``."""
        self._rows.activate()


class HullTranscription(Transcription):
    """One motion on one grid with the clearances of the links' hulls as further residuals, evaluated in NumPy.

    Args:
        kernels: Residual kernels.
        grid: The grid.
        hulls: Clearances of the hulls.
        boundary: Boundary conditions of one motion.
        obstacle_poses: Poses and sizes of its obstacles, shape (width,).
    """

    def __init__(
        self, kernels: ResidualKernels, grid: Grid, hulls: Hulls, *, boundary: Boundary, obstacle_poses: Array
    ) -> None:
        super().__init__(replace(kernels, step_library=None), grid, boundary=boundary, obstacle_poses=obstacle_poses)
        self._hulls = hulls
        self._measure = cache_last(lambda w: hulls.measure(w[: self.n], obstacle_poses))

    def measured(self, x: Array) -> tuple[float, Array]:
        """Evaluate the objective and residuals (K, m + columns)."""
        cost, g = super().measured(x)
        return cost, np.hstack([g, self._measure(self._at(x)[0])[0] / DISTANCE_SCALE_M])

    def evaluate(self, x: Array) -> Linearization:
        """Evaluate objective and residuals with their derivatives."""
        at, (w, _, _) = super().evaluate(x), self._at(x)
        distances, groups = self._measure(w)
        gradients = np.zeros((len(w), len(self._hulls.min_distances), w.shape[1]))
        gradients[: self.n] = self._hulls.gradients(w[: self.n], distances, groups) / DISTANCE_SCALE_M
        jacobian = np.concatenate([at.jacobian, gradients], axis=1)
        return replace(at, g=np.hstack([at.g, distances / DISTANCE_SCALE_M]), jacobian=jacobian)
