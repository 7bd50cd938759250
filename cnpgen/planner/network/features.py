"""The network's inputs: start and goal states and derived values, standardized by the training rows.

Features of the obstacles that samples place do not depend on their order: they are
    signed distances at points.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.errors import UsageError
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.observation.compiled_observations import observation_backend
from cnpgen.planner.tasks import Tasks
from cnpgen.robots.observation.observations import BasisPoints, ObservationBackend
from cnpgen.robots.observation.primitives import Primitives, scene_primitives
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.robots.shape.capsule import Capsule
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline import basis
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

STATES = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
USUAL = (*STATES, "sin_cos", "tips", "expected_time")
ARRIVAL = "goal_ddq"  # only if goal accelerations are given
SCENE = "scene"  # only if samples place obstacles
PARAMETERS = "parameters"  # only for problems with parameters
LINE = "line"  # only if the network corrects its own path
BLOCKS = (*USUAL, ARRIVAL, PARAMETERS, SCENE, LINE)
FIELDS = frozenset({*STATES, ARRIVAL, PARAMETERS})  # of ``Boundary``
FEATURE_SETS = ("full", "no-scene", "states", "paper")
# SI units; features with a smaller standard deviation are constant.
MIN_DEVIATION = 1e-7
PATH_PHASES = 12  # states of the path
STEP_RAD = 0.15  # rad or m: of every joint to both sides of the path
RANGE_M = 0.12  # clearance below which points count
MIN_DISTANCE_M, MAX_DISTANCE_M = -0.15, 0.3  # to which distances are clipped
POINT_SPACING_M = 0.12  # of the points on the axis of a link's capsule
BASIS = BasisPoints(points=64, low=(-0.75, -0.75, -0.05), high=(0.85, 0.75, 0.75))
TASKS_PER_BLOCK = 256


@dataclass(frozen=True)
class Features:
    """Standardized features.

    Attributes:
        blocks: Selected names of ``BLOCKS``, in order.
        mean: Mean of every feature over the training rows, shape (F,).
        scale: Reciprocal of the standard deviation; 0 for constant features, shape
            (F,).
    """

    blocks: tuple[str, ...]
    mean: AnyArray
    scale: AnyArray

    def of(self, tasks: Tasks, dtype: str = "float32") -> AnyArray:
        """Compute the features of N tasks, shape (N, F)."""
        raw = raw_features(tasks, self.blocks)
        raw -= self.mean
        raw *= self.scale
        return raw.astype(dtype)


def feature_blocks(
    boundary: Boundary,
    features: str = "full",
    *,
    placed: bool = False,
    iterated: bool = False,
) -> tuple[str, ...]:
    """Return the feature blocks of tasks with such boundary conditions, for one of ``FEATURE_SETS``.

    These are all blocks ("full"), all but those of placed obstacles ("no-scene"), or
    boundary states ("states", "paper"). Samples may place obstacles, and the network
    may correct its own path (``iterated``).
    """
    blocks = USUAL if features in {"full", "no-scene"} else STATES
    optional = {ARRIVAL: boundary.goal_ddq, PARAMETERS: boundary.parameters}
    blocks = (
        *blocks,
        *(name for name, values in optional.items() if values is not None),
    )
    blocks = (*blocks, SCENE) if placed and features == "full" else blocks
    return (*blocks, LINE) if iterated else blocks


def published_features(
    blocks: tuple[str, ...], velocity_limit: AnyArray, acceleration_limit: AnyArray
) -> Features:
    """Return states divided by pi and by the limits (paper, section on the neural network: normalized states).

    The paper does not define the normalization; this one is that of the authors'
    implementation. Limits are those of planning [rad/s, rad/s^2], shape (n,).
    """
    units = {
        "q": np.full_like(velocity_limit, np.pi),
        "dq": velocity_limit,
        "ddq": acceleration_limit,
    }
    # "start_dq" has the unit of "dq".
    scale = np.concatenate([1 / units[name.partition("_")[2]] for name in blocks])
    return Features(blocks, np.zeros_like(scale), scale)


def fit_features(parts: Iterable[Tasks], blocks: tuple[str, ...] = USUAL) -> Features:
    """Compute mean and standard deviation of every feature over the training rows, given in parts."""
    count, mean, squares, line = 0, np.zeros(1), np.zeros(1), 0
    for tasks in parts:
        raw = raw_features(tasks, blocks)
        line = 0 if tasks.correction is None else tasks.correction[:1].size
        # Moments of two groups combine without keeping the rows:
        #   M2 = M2_a + M2_b + (mean_b - mean_a)^2 n_a n_b / n.
        new, total = raw.mean(axis=0) - mean, count + len(raw)
        # Chan et al., 1983
        squares = (
            squares + raw.var(axis=0) * len(raw) + new**2 * (count * len(raw) / total)
        )
        count, mean = total, mean + new * (len(raw) / total)
    deviation = np.sqrt(squares / count)
    # Constant features carry no information; scaled by rounding errors they would be
    # noise.
    constant = deviation < MIN_DEVIATION
    scale = np.where(constant, 0.0, 1 / np.where(constant, 1.0, deviation))
    if LINE in blocks:
        # The last one; zero along straight lines.
        mean[-line:], scale[-line:] = 0.0, 1.0
    return Features(blocks, mean, scale)


def raw_features(tasks: Tasks, blocks: tuple[str, ...]) -> AnyArray:
    """Compute features in their own units, float64, shape (N, F).

    * ``start_q`` to ``goal_dq``, and ``goal_ddq`` if it is given: the states [rad, rad/s, rad/s^2];
    * ``sin_cos``: sines and cosines of start and goal positions, whose products appear in the forward kinematics;
    * ``tips``: tip positions at start and goal [m];
    * ``expected_time``: its logarithm;
    * ``parameters``: the parameters of the problem, if it has any;
    * ``scene``: features of the obstacles that samples place (``SceneFeatures``);
    * ``line``: offsets of the interior control points of the path that the network corrects [rad], not standardized.
    """
    parts = [part for name in blocks for part in _block(tasks, name)]
    return np.concatenate(parts, axis=1, dtype=np.float64)


def count_features(
    blocks: tuple[str, ...], joints: int, parameters: int = 0, line: int = 0
) -> int:
    """Return the number of features of some of ``BLOCKS``.

    ``line`` counts coordinates of interior control points.
    """
    widths = {
        **dict.fromkeys((*STATES, ARRIVAL), joints),
        "sin_cos": 4 * joints,
        "tips": 6,
    }
    widths |= {
        "expected_time": 1,
        PARAMETERS: parameters,
        SCENE: count_scene_features(joints),
        LINE: line,
    }
    return sum(widths[name] for name in blocks)


def _block(tasks: Tasks, name: str) -> tuple[AnyArray, ...]:
    boundary = tasks.boundary
    if name in FIELDS:
        return (getattr(boundary, name),)
    if name == "sin_cos":
        # Forward kinematics is a polynomial of these sines and cosines.
        angles = np.concatenate([boundary.start_q, boundary.goal_q], axis=1)
        return np.sin(angles), np.cos(angles)
    if name == "tips":
        return tasks.start_xyz, tasks.goal_xyz
    if name == "expected_time":
        # Durations differ by factors, so the logarithm is the natural scale.
        return (np.log(tasks.expected_time)[:, None],)
    if name == SCENE and tasks.observation is not None:
        return (tasks.observation,)
    if name == LINE and tasks.correction is not None:
        count, points, joints = tasks.correction.shape
        return (tasks.correction.reshape(count, points * joints),)
    raise ValueError(
        f"unknown feature block {name!r}: expected one of {', '.join(BLOCKS)}"
    )


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
            points += [
                (1 - share) * a + share * b for a, b in zip(first, second, strict=True)
            ]
    return ca.Function("link_points", [q_sx], [ca.vertcat(*points)])


def _shares(capsule: Capsule) -> list[float]:
    """Return the places of the points on a capsule's axis, as shares of its length."""
    # Points at most ``POINT_SPACING_M`` apart cover the capsule.
    length = float(np.linalg.norm(np.subtract(capsule.second, capsule.first)))
    return (
        np.linspace(0, 1, int(np.ceil(length / POINT_SPACING_M)) + 1).tolist()
        if length > 0
        else [0.5]
    )


@dataclass(frozen=True)
class SceneFeatures:
    """Features of the obstacles of tasks, made by ``make_scene_features``.

    At some phases of a path they are the smallest clearance of points of the links, the
    sum of what their clearances lack of ``RANGE_M``, and its differences if each joint
    moves by ``STEP_RAD`` to both sides. The others are signed distances at the points
    of ``BASIS``.

    Attributes:
        points: Kernel of ``link_points``.
        radii: Radii of the capsules at these points [m], shape (P,).
        backend: Signed distances.
        path: Basis of the path at its phases, shape (PATH_PHASES, C).
    """

    points: Kernel
    radii: AnyArray
    backend: ObservationBackend
    path: AnyArray

    def __call__(self, path: AnyArray, scene: Scene) -> AnyArray:
        """Compute the features of N paths, from control points [rad], shape (N, C, n), and the obstacles of each."""
        features = np.empty((len(path), count_scene_features(path.shape[2])))
        for first in range(0, len(path), TASKS_PER_BLOCK):
            rows = slice(first, first + TASKS_PER_BLOCK)
            bodies = scene_primitives(scene[rows])
            along = self._along(path[rows], bodies)
            # The basis points are fixed in the world, so their distances describe the
            # scene alone.
            around = self.backend.distances(bodies, BASIS.positions)
            features[rows] = np.concatenate(
                [along, np.clip(around, MIN_DISTANCE_M, MAX_DISTANCE_M)], axis=1
            )
        return features

    def _along(self, path: AnyArray, bodies: Primitives) -> AnyArray:
        """Return the features along paths, shape (N, PATH_PHASES * (n + 2))."""
        count, _, n = path.shape
        # Central differences: the state itself, then each joint moved to both sides.
        steps = STEP_RAD * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
        states = ((self.path @ path)[:, :, None] + steps).reshape(-1, n)
        (columns,) = self.points(np.ascontiguousarray(states.T))
        points = columns.T.reshape(count, -1, 3)
        distances = (
            self.backend.distances(bodies, points).reshape(
                count, PATH_PHASES, 2 * n + 1, -1
            )
            - self.radii
        )
        # Smooth measure of crowding: clearances below ``RANGE_M`` add up.
        near = np.maximum(RANGE_M - distances, 0).sum(axis=-1)
        smallest = np.clip(
            distances[:, :, 0].min(axis=-1), MIN_DISTANCE_M, MAX_DISTANCE_M
        )
        parts = (
            smallest[..., None],
            near[:, :, :1],
            # Sign of the joint motion that increases the clearance.
            near[:, :, 1 : n + 1] - near[:, :, n + 1 :],
        )
        return np.concatenate(parts, axis=2).reshape(count, -1)


def make_scene_features(
    robot: Robot, spec: TrajectorySpec, kernels: KernelLibrary
) -> SceneFeatures:
    """Load the features of a robot's scenes.

    Raise UsageError for a robot without link geometry.
    """
    if robot.shape is None:
        raise UsageError(
            'features of scenes need geometry = "urdf" in [robot]', concerns="problem"
        )
    radii = [
        capsule.radius
        for capsule in robot.shape.moving_capsules
        for _ in _shares(capsule)
    ]
    # Interior phases: the ends are features of their own.
    phases = (np.arange(PATH_PHASES) + 1) / (PATH_PHASES + 1)
    path = basis(phases, spec.path_control_points, spec.degree)
    return SceneFeatures(
        kernels.load(link_points),
        np.array(radii),
        observation_backend(),
        path,
    )
