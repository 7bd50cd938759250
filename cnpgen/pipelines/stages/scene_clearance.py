"""Clearance of states in the scenes of a batch, by compiled collision checks."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from cnpgen.arrays import Array, Integers, Mask
from cnpgen.kernels.collision.body_arrays import (
    LANES,
    PADDING_DISTANCE_M,
    obstacle_bodies,
)
from cnpgen.kernels.collision.collision_checker import (
    CollisionChecker,
    load_collision_library,
)
from cnpgen.kernels.compiled_kernel import address_of
from cnpgen.pipelines.stages.batch_scenes import BatchScenes
from cnpgen.pipelines.stages.stage import Context
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.link_clearance import SelfClearance
from cnpgen.problems.problem import Problem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.solid import place_obstacles


class _SceneChecker(CollisionChecker):
    """Compiled checks whose obstacles are replaced by arrays of ``BatchScenes.bodies``."""

    def place_fixed(self, obstacles: Sequence[Obstacle]) -> None:
        """Set the obstacles that all scenes have."""
        # Fixed obstacles come first in every scene, followed by those of the sample.
        numbers = place_obstacles(obstacles)
        self.place(obstacles, numbers)
        self._fixed, _, boxes = obstacle_bodies(obstacles, numbers, len(self.vertices))
        self._fixed_boxes = boxes[:, : len(obstacles)]

    def prepare_scenes(self, scenes: BatchScenes) -> None:
        """Build the arrays of all scenes of a batch, for ``place_scene``."""
        fixed = len(self._fixed)
        bodies, boxes = scenes.bodies
        together = np.zeros((len(scenes), fixed + bodies.shape[1]), bodies.dtype)
        together[:, :fixed] = self._fixed
        together[:, fixed:] = bodies
        self._counts = (fixed + scenes.table.obstacle_count).tolist()
        self._boxes = []
        for box, count in zip(boxes, self._counts, strict=True):
            padded = np.zeros((16, count + -count % LANES))
            padded[:, :fixed] = self._fixed_boxes
            padded[:, fixed:count] = box[:, : count - fixed]
            # Padding is too far away to be near any capsule.
            padded[:3, count:] = PADDING_DISTANCE_M
            self._boxes.append(padded)
        self._places = [
            (address_of(box) if box.size else None, box.shape[1]) for box in self._boxes
        ]
        self._set("obstacles", together)
        self._first = address_of(self._arrays["obstacles"])
        self._stride = together.strides[0]

    def clear_of_scenes(
        self, q: Array, runs: list[tuple[int, int, int]], limits: tuple[float, float]
    ) -> Mask:
        """Return a mask of the states q [rad], shape (n, K), with sufficient distances in their scene, shape (K,).

        Runs are scene, first state and end of states in one scene; limits are required
        distances from obstacles and of links from each other [m], -inf for no check.
        """
        states = np.ascontiguousarray(q.T)
        clear = np.empty(q.shape[1], np.uint8)
        native = self._scene
        check = self.library.clear_states
        address = self.address
        first_state = address_of(states)
        first_flag = address_of(clear)
        stride = states.strides[0]
        # Only pointers change from scene to scene; the arrays of all scenes were built
        # at once.
        for scene, first, end in runs:
            native.obstacles = self._first + scene * self._stride
            native.n_obstacles = self._counts[scene]
            native.boxes, native.lanes = self._places[scene]
            place = first_state + first * stride
            check(address, place, end - first, *limits, first_flag + first)
        return clear.astype(bool)


class SceneClearance:
    """Clearance of states from the obstacles of their scene and of links from each other, for robots with geometry."""

    def __init__(self, context: Context) -> None:
        problem = context.problem
        self._obstacle_distance = _required_distance(problem, RobotClearance)
        self._self_distance = _required_distance(problem, SelfClearance)
        self._prepared: BatchScenes | None = None
        library = load_collision_library(context.kernels)
        self._checker = _SceneChecker(library, context.robot)
        self._checker.place_fixed(problem.own_obstacles)

    def are_clear(
        self,
        q: Array,
        scene: Integers,
        scenes: BatchScenes,
        margin: float = 0.0,
        self_margin: float = 0.0,
    ) -> Mask:
        """Return a mask of the states q [rad], shape (n, K), with sufficient distances in their scene, shape (K,).

        The scenes of the states ascend. Margins [m] are added to the required distances
        from obstacles and of links.
        """
        if not len(scene):
            return np.zeros(0, bool)
        # Runs of states in one scene: the checker is told the obstacles once per run.
        bounds = [0, *(np.flatnonzero(np.diff(scene)) + 1).tolist(), len(scene)]
        runs = [(int(scene[first]), first, end) for first, end in pairwise(bounds)]
        # The arrays belong to a batch of scenes and are built once for it.
        if self._prepared is not scenes:
            self._checker.prepare_scenes(scenes)
            self._prepared = scenes
        # A missing constraint requires -inf, which every distance keeps.
        limits = self._obstacle_distance + margin, self._self_distance + self_margin
        return self._checker.clear_of_scenes(q, runs, limits)


def _required_distance(
    problem: Problem, kind: type[RobotClearance | SelfClearance]
) -> float:
    """Return the distance that the constraints of a kind require [m].

    -inf without such a constraint.
    """
    return max(
        (item.distance for item in problem.constraint if isinstance(item, kind)),
        default=-np.inf,
    )
