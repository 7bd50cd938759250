"""Features of the obstacles of a task that do not depend on their order: signed distances at points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.observation.compiled_observations import observation_backend
from cnpgen.robots.observation.observations import BasisPoints, ObservationBackend
from cnpgen.robots.observation.primitives import Primitives, scene_primitives
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.robots.shape.capsule import Capsule
from cnpgen.trajectory.spline import basis
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

Array = NDArray[Any]

PATH_PHASES = 12  # states of the path
STEP_RAD = 0.15  # rad or m: of every joint to both sides of the path
RANGE_M = 0.12  # clearance below which points count
MIN_DISTANCE_M, MAX_DISTANCE_M = -0.15, 0.3  # to which distances are clipped
POINT_SPACING_M = 0.12  # of the points on the axis of a link's capsule
BASIS = BasisPoints(points=64, low=(-0.75, -0.75, -0.05), high=(0.85, 0.75, 0.75))
TASKS_PER_BLOCK = 256


def count_scene_features(joints: int) -> int:
    """Return the number of features of a scene for a number of planned joints."""
    return PATH_PHASES * (joints + 2) + BASIS.points


def link_points(robot: Robot) -> Any:
    """Build ``q -> points``: points on the axes of the moving links' capsules, coordinates in turn [m]."""
    import casadi as ca

    from cnpgen.kernels.symbolic.linalg import symbols
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState

    assert robot.shape is not None
    (q_sx, q), zero = symbols("q", robot.n), [0.0] * robot.n
    capsules = SymbolicState(robot, q, zero, zero, [], (), None).capsules
    points = []
    for capsule in robot.shape.moving_capsules:
        first, second, _ = capsules[capsule.link]
        for share in _shares(capsule):
            points += [(1 - share) * a + share * b for a, b in zip(first, second, strict=True)]
    return ca.Function("link_points", [q_sx], [ca.vertcat(*points)])


def _shares(capsule: Capsule) -> list[float]:
    """Return the places of the points on a capsule's axis, as shares of its length."""
    length = float(np.linalg.norm(np.subtract(capsule.second, capsule.first)))
    return np.linspace(0, 1, int(np.ceil(length / POINT_SPACING_M)) + 1).tolist() if length > 0 else [0.5]


@dataclass(frozen=True)
class SceneFeatures:
    """Features of the obstacles of tasks, made by ``make_scene_features``.

    At some phases of a path they are the smallest clearance of points of the links, the sum of what their clearances
    lack of ``RANGE_M``, and its differences if each joint moves by ``STEP_RAD`` to both sides. The others are signed
    distances at the points of ``BASIS``.

    Attributes:
        points: Kernel of ``link_points``.
        radii: Radii of the capsules at these points [m], shape (P,).
        backend: Signed distances.
        path: Basis of the path at its phases, shape (PATH_PHASES, C).
    """

    points: Kernel
    radii: Array
    backend: ObservationBackend
    path: Array

    def __call__(self, path: Array, scene: Scene) -> Array:
        """Compute the features of N paths.

        Args:
            path: Control points [rad], shape (N, C, n).
            scene: Obstacles of each path.

        Returns:
            Shape (N, ``count_scene_features``).
        """
        features = np.empty((len(path), count_scene_features(path.shape[2])))
        for first in range(0, len(path), TASKS_PER_BLOCK):
            rows = slice(first, first + TASKS_PER_BLOCK)
            bodies = scene_primitives(scene[rows])
            along = self._along(path[rows], bodies)
            around = self.backend.distances(bodies, BASIS.positions)
            features[rows] = np.concatenate([along, np.clip(around, MIN_DISTANCE_M, MAX_DISTANCE_M)], axis=1)
        return features

    def _along(self, path: Array, bodies: Primitives) -> Array:
        """Return the features along paths, shape (N, PATH_PHASES * (n + 2))."""
        count, _, n = path.shape
        steps = STEP_RAD * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
        states = ((self.path @ path)[:, :, None] + steps).reshape(-1, n)
        (columns,) = self.points(np.ascontiguousarray(states.T))
        points = columns.T.reshape(count, -1, 3)
        distances = self.backend.distances(bodies, points).reshape(count, PATH_PHASES, 2 * n + 1, -1) - self.radii
        near = np.maximum(RANGE_M - distances, 0).sum(axis=-1)
        smallest = np.clip(distances[:, :, 0].min(axis=-1), MIN_DISTANCE_M, MAX_DISTANCE_M)
        parts = smallest[..., None], near[:, :, :1], near[:, :, 1 : n + 1] - near[:, :, n + 1 :]
        return np.concatenate(parts, axis=2).reshape(count, -1)


def make_scene_features(robot: Robot, spec: TrajectorySpec, kernels: KernelLibrary) -> SceneFeatures:
    """Load the features of a robot's scenes.

    Raises:
        UsageError: The robot has no link geometry.
    """
    if robot.shape is None:
        raise UsageError('features of scenes need geometry = "urdf" in [robot]', concerns="problem")
    radii = [capsule.radius for capsule in robot.shape.moving_capsules for _ in _shares(capsule)]
    phases = (np.arange(PATH_PHASES) + 1) / (PATH_PHASES + 1)
    path = basis(phases, spec.path_control_points, spec.degree)
    return SceneFeatures(kernels.load(link_points), np.array(radii), observation_backend(kernels.backend), path)
