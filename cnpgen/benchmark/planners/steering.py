"""Steering by the cross-entropy method: accelerations and a time that move the arm near a configuration."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.planners.state_check import StateCheck

Array = NDArray[np.float64]

STEERING_STEP_S = 0.01
SAMPLES, ELITES, ITERATIONS = 64, 4, 30
TARGET_TOLERANCE_RAD = 0.02
LEARNING_RATE = 0.1  # of mean and deviation towards the elites


@dataclass(frozen=True)
class Spread:
    """Initial distribution of controls; the mean acceleration is 0.

    Attributes:
        acceleration: Standard deviation, as a fraction of the limits.
        mean_time: Mean duration of a control [s].
        time: Standard deviation of the duration [s].
        max_duration: Maximum duration [s].
    """

    acceleration: float
    mean_time: float
    time: float
    max_duration: float


HIT = Spread(0.4, 0.1, 0.4, 0.5)
TRANSPORT = Spread(0.8, 0.05, 0.1, 0.1)


@dataclass(frozen=True)
class Steering:
    """Steering from states towards configurations, for one boundary problem.

    Attributes:
        check: Check of states.
        obstacle_poses: Heights of the obstacles' upper faces [m], shape (obstacles,).
        limit: Limits of the accelerations [rad/s^2], shape (n,).
        spread: Initial distribution of controls.
        random: Random generator.
    """

    check: StateCheck
    obstacle_poses: Array
    limit: Array
    spread: Spread
    random: np.random.Generator

    def __call__(self, state: Array, target: Array) -> tuple[Array, Array] | None:
        """Steer; a control is cut before its first invalid state.

        Args:
            state: Positions [rad] and velocities [rad/s], shape (2 n,).
            target: Target configuration [rad], shape (n,), with any velocity.

        Returns:
            The states of the best motion, one per ``STEERING_STEP_S``, shape (K, 2 n), and the tip position at its end
            [m], shape (3,); None if all controls are invalid.
        """
        mean = np.append(np.zeros_like(self.limit), self.spread.mean_time)
        deviation = np.append(self.spread.acceleration * self.limit, self.spread.time)
        best, least = None, np.inf
        for _ in range(ITERATIONS):
            controls = self._drawn(mean, deviation)
            paths, tips, lengths = self.followed(state, controls)
            ends = paths[np.arange(SAMPLES), lengths - 1, : len(target)]
            away = np.where(lengths > 0, np.linalg.norm(ends - target, axis=1), np.inf)
            order = np.argsort(away)[:ELITES]
            first, length = int(order[0]), int(lengths[order[0]])
            if away[first] < least:
                best, least = (paths[first, :length], tips[first, length - 1]), float(away[first])
            elites = controls[order[np.isfinite(away[order])]]
            if least < TARGET_TOLERANCE_RAD or not len(elites):
                break
            mean = (1 - LEARNING_RATE) * mean + LEARNING_RATE * elites.mean(axis=0)
            deviation = (1 - LEARNING_RATE) * deviation + LEARNING_RATE * elites.std(axis=0)
        return best

    def _drawn(self, mean: Array, deviation: Array) -> Array:
        """Draw controls within their limits: accelerations [rad/s^2] and a time [s], shape (SAMPLES, n + 1)."""
        drawn = self.random.normal(mean, deviation, (SAMPLES, len(mean)))
        return np.clip(drawn, np.append(-self.limit, STEERING_STEP_S), np.append(self.limit, self.spread.max_duration))

    def followed(self, state: Array, controls: Array) -> tuple[Array, Array, NDArray[np.int64]]:
        """Integrate controls from a state.

        Args:
            state: Shape (2 n,).
            controls: Accelerations [rad/s^2] and times [s], shape (N, n + 1).

        Returns:
            States every ``STEERING_STEP_S``, shape (N, K, 2 n), tip positions [m], shape (N, K, 3), and the numbers of
            valid states from the first, shape (N,).
        """
        (q, dq), n = np.split(state, 2), len(self.limit)
        ddq = np.repeat(controls[:, None, :n], round(self.spread.max_duration / STEERING_STEP_S), axis=1)
        t = STEERING_STEP_S * np.arange(1.0, ddq.shape[1] + 1)[:, None]
        paths = np.concatenate([q + t * (dq + t / 2 * ddq), dq + t * ddq], axis=2)
        flat = paths.reshape(-1, 2 * n)
        tips, allowed = self.check(flat[:, :n], flat[:, n:], ddq.reshape(-1, n), self.obstacle_poses)
        within = t[:, 0] < controls[:, n:] + STEERING_STEP_S / 2
        going = np.logical_and.accumulate(allowed.reshape(within.shape) & within, axis=1)
        return paths, tips.reshape(*within.shape, 3), going.sum(axis=1)
