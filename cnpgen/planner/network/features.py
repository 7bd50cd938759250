"""The network's inputs: start and goal states and derived values, standardized by the training rows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.planner.network.scene_features import count_scene_features
from cnpgen.planner.tasks import Tasks
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[Any]

STATES = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
USUAL = (*STATES, "sin_cos", "tips", "expected_time")
ARRIVAL = "goal_ddq"  # only if goal accelerations are given
SCENE = "scene"  # only if samples place obstacles
PARAMETERS = "parameters"  # only for problems with parameters
LINE = "line"  # only if the network corrects its own path
BLOCKS = (*USUAL, ARRIVAL, PARAMETERS, SCENE, LINE)
FEATURE_SETS = ("full", "no-scene", "states", "paper")
MIN_DEVIATION = 1e-7  # SI units; features with a smaller standard deviation are constant


@dataclass(frozen=True)
class Features:
    """Standardized features.

    Attributes:
        blocks: Selected names of ``BLOCKS``, in order.
        mean: Mean of every feature over the training rows, shape (F,).
        scale: Reciprocal of the standard deviation; 0 for constant features, shape (F,).
    """

    blocks: tuple[str, ...]
    mean: Array
    scale: Array

    def of(self, tasks: Tasks, dtype: str = "float32") -> Array:
        """Compute the features of N tasks, shape (N, F)."""
        raw = raw_features(tasks, self.blocks)
        raw -= self.mean
        raw *= self.scale
        return raw.astype(dtype)


def feature_blocks(
    boundary: Boundary, features: str = "full", *, placed: bool = False, iterated: bool = False
) -> tuple[str, ...]:
    """Return the feature blocks of tasks with such boundary conditions.

    Args:
        boundary: The boundary conditions.
        features: One of ``FEATURE_SETS``: all blocks ("full"), all but those of placed obstacles ("no-scene"), or the
            boundary states ("states", "paper").
        placed: Whether samples place obstacles.
        iterated: Whether the network corrects its own path.
    """
    blocks = USUAL if features in {"full", "no-scene"} else STATES
    optional = {ARRIVAL: boundary.goal_ddq, PARAMETERS: boundary.parameters}
    blocks = (*blocks, *(name for name, values in optional.items() if values is not None))
    blocks = (*blocks, SCENE) if placed and features == "full" else blocks
    return (*blocks, LINE) if iterated else blocks


def published_features(blocks: tuple[str, ...], velocity_limit: Array, acceleration_limit: Array) -> Features:
    """Return states divided by pi and by the limits (paper, section on the neural network: normalized states).

    The paper does not define the normalization; this one is that of the authors' implementation. Limits are those of
    planning [rad/s, rad/s^2], shape (n,).
    """
    units = {"q": np.full_like(velocity_limit, np.pi), "dq": velocity_limit, "ddq": acceleration_limit}
    scale = np.concatenate([1 / units[name.partition("_")[2]] for name in blocks])
    return Features(blocks, np.zeros_like(scale), scale)


def fit_features(parts: Iterable[Tasks], blocks: tuple[str, ...] = USUAL) -> Features:
    """Compute mean and standard deviation of every feature over the training rows, given in parts."""
    count, mean, squares, line = 0, np.zeros(1), np.zeros(1), 0
    for tasks in parts:
        raw = raw_features(tasks, blocks)
        line = 0 if tasks.correction is None else tasks.correction[:1].size
        new, total = raw.mean(axis=0) - mean, count + len(raw)
        squares = squares + raw.var(axis=0) * len(raw) + new**2 * (count * len(raw) / total)  # Chan et al., 1983
        count, mean = total, mean + new * (len(raw) / total)
    deviation = np.sqrt(squares / count)
    constant = deviation < MIN_DEVIATION
    scale = np.where(constant, 0.0, 1 / np.where(constant, 1.0, deviation))
    if LINE in blocks:  # the last one; zero along straight lines
        mean[-line:], scale[-line:] = 0.0, 1.0
    return Features(blocks, mean, scale)


def raw_features(tasks: Tasks, blocks: tuple[str, ...]) -> Array:
    """Compute features in their own units, float64, shape (N, F).

    * ``start_q`` to ``goal_dq``, and ``goal_ddq`` if it is given: the states [rad, rad/s, rad/s^2];
    * ``sin_cos``: sines and cosines of start and goal positions, whose products appear in the forward kinematics;
    * ``tips``: tip positions at start and goal [m];
    * ``expected_time``: its logarithm;
    * ``parameters``: the parameters of the problem, if it has any;
    * ``scene``: features of the obstacles that samples place (``scene_features``);
    * ``line``: offsets of the interior control points of the path that the network corrects [rad], not standardized.
    """
    parts = [part for name in blocks for part in _block(tasks, name)]
    return np.concatenate(parts, axis=1, dtype=np.float64)


def count_features(blocks: tuple[str, ...], joints: int, parameters: int = 0, line: int = 0) -> int:
    """Return the number of features of some of ``BLOCKS``; ``line`` counts coordinates of interior control points."""
    widths = {**dict.fromkeys((*STATES, ARRIVAL), joints), "sin_cos": 4 * joints, "tips": 6}
    widths |= {"expected_time": 1, PARAMETERS: parameters, SCENE: count_scene_features(joints), LINE: line}
    return sum(widths[name] for name in blocks)


def _block(tasks: Tasks, name: str) -> tuple[Array, ...]:
    boundary = tasks.boundary
    if name in {*STATES, ARRIVAL, PARAMETERS}:
        return (getattr(boundary, name),)
    if name == "sin_cos":
        angles = np.concatenate([boundary.start_q, boundary.goal_q], axis=1)
        return np.sin(angles), np.cos(angles)
    if name == "tips":
        return tasks.start_xyz, tasks.goal_xyz
    if name == "expected_time":
        return (np.log(tasks.expected_time)[:, None],)
    if name == SCENE and tasks.observation is not None:
        return (tasks.observation,)
    if name == LINE and tasks.correction is not None:
        return (tasks.correction.reshape(len(tasks), -1),)
    raise ValueError(f"unknown feature block {name!r}: expected one of {', '.join(BLOCKS)}")
