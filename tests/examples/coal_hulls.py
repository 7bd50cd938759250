"""Clearances of hulls by Coal: the reference of compiled collision checks."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.kernels.collision.collision_checker import load_collision_library
from cnpgen.kernels.library import KernelLibrary, choose_backend
from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.hulls import MEASURED_RANGE_M, Hulls, Pairs
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.shape import with_held_object
from cnpgen.robots.solid import solids_of
from cnpgen.world.forward_kinematics import ForwardKinematics
from cnpgen.world.rigid_bodies import RigidBodies


def compiled_hulls(
    problem: Problem, robot: Robot, *, with_object: bool = False
) -> Hulls:
    """Return clearances of hulls by compiled code."""
    library = load_collision_library(KernelLibrary(*choose_backend("compiled"), "", {}))
    return Hulls(problem, robot, library, with_object=with_object)


class CoalHulls(Hulls):
    """``Hulls`` whose distances Coal measures, pair by pair."""

    def __init__(
        self, problem: Problem, robot: Robot, *, with_object: bool = False
    ) -> None:
        library = load_collision_library(
            KernelLibrary(*choose_backend("compiled"), "", {})
        )
        super().__init__(problem, robot, library, with_object=with_object)
        shape = robot.shape
        assert shape is not None
        if with_object and problem.object_size is not None:
            shape = with_held_object(
                shape, robot.held_shape, robot.chain, problem.object_size
            )
        self._bodies = RigidBodies(shape, len(problem.obstacle), robot.n)
        self._kinematics = ForwardKinematics(robot.model)

    def clear_states(
        self, q: Array, obstacle_poses: Array, *, links_only: bool = False
    ) -> NDArray[np.bool_]:
        """See ``Hulls``."""
        self._place(q, obstacle_poses)
        clear = np.ones(q.shape[1], bool)
        for group in self._groups:
            if group.of_obstacles and links_only:
                continue
            pairs = self._pairs(group.of_obstacles)[group.numbers]
            clear &= self._bodies.pair_distances(pairs).clear_states(group.required)
        return clear

    def _close(
        self, q: Array, obstacle_poses: Array, within: float = MEASURED_RANGE_M
    ) -> Iterator[tuple[Pairs, Pairs, Array]]:
        self._place(q, obstacle_poses)
        for group in self._groups:
            pairs = self._pairs(group.of_obstacles)[group.numbers]
            near = np.argwhere(
                ~(self._bodies._bounds(pairs) >= group.required + within)
            )
            distances = np.array(
                [self._bodies._measure(*pairs[pair], k)[0] for pair, k in near.tolist()]
            )
            kept = np.flatnonzero(distances < group.required + within)
            pair, k = near[kept].T if len(kept) else np.zeros((2, 0), np.intp)
            yield k, group.columns[pair], distances[kept]

    def _pairs(self, of_obstacles: bool) -> Pairs:
        return self._obstacle_pairs if of_obstacles else self._link_pairs

    def _place(self, q: Array, obstacle_poses: Array) -> None:
        self._bodies.place(
            *self._kinematics.poses(q), solids_of(self._obstacles, obstacle_poses)
        )
