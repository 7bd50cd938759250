"""Steering by the cross-entropy method: accelerations and a duration that move the arm near a configuration."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.planners.state_check import StateCheck
from cnpgen.problems.problem import Problem

Array = NDArray[np.float64]

STEERING_STEP_S = 0.01
TARGET_TOLERANCE_RAD = 0.02
CEM_LEARNING_RATE = 0.1  # of mean and deviation towards the elites


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


HIT_SPREAD = Spread(0.4, 0.1, 0.4, 0.5)
TRANSPORT_SPREAD = Spread(0.8, 0.05, 0.1, 0.1)


def spread_of(problem: Problem) -> Spread:
    """Return the initial distribution for hits or for transports."""
    return HIT_SPREAD if problem.object_size is None else TRANSPORT_SPREAD


@dataclass(frozen=True)
class Steering:
    """Steering from states towards configurations, for one boundary problem.

    Attributes:
        check: Check of states.
        obstacle_poses: Poses and sizes of the obstacles, shape (width,).
        limit: Limits of the accelerations [rad/s^2], shape (n,).
        spread: Initial distribution of controls.
        random: Random generator.
        samples: Controls per iteration of the cross-entropy method.
        elites: Best controls, which determine the next distribution.
        iterations: Largest number of iterations.
    """

    check: StateCheck
    obstacle_poses: Array
    limit: Array
    spread: Spread
    random: np.random.Generator
    samples: int = 64
    elites: int = 4
    iterations: int = 30

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
        for _ in range(self.iterations):
            controls = self._sample_controls(mean, deviation)
            paths, tips, lengths = self.integrate(state, controls)
            ends = paths[np.arange(self.samples), lengths - 1, : len(target)]
            distances = np.where(lengths > 0, np.linalg.norm(ends - target, axis=1), np.inf)
            order = np.argsort(distances)[: self.elites]
            first, length = int(order[0]), int(lengths[order[0]])
            if distances[first] < least:
                best, least = (paths[first, :length], tips[first, length - 1]), float(distances[first])
            elites = controls[order[np.isfinite(distances[order])]]
            if least < TARGET_TOLERANCE_RAD or not len(elites):
                break
            mean = (1 - CEM_LEARNING_RATE) * mean + CEM_LEARNING_RATE * elites.mean(axis=0)
            deviation = (1 - CEM_LEARNING_RATE) * deviation + CEM_LEARNING_RATE * elites.std(axis=0)
        return best

    def _sample_controls(self, mean: Array, deviation: Array) -> Array:
        """Sample controls within their limits: accelerations [rad/s^2] and a time [s], shape (samples, n + 1)."""
        controls = self.random.normal(mean, deviation, (self.samples, len(mean)))
        low, high = np.append(-self.limit, STEERING_STEP_S), np.append(self.limit, self.spread.max_duration)
        return np.clip(controls, low, high)

    def integrate(self, state: Array, controls: Array) -> tuple[Array, Array, NDArray[np.int64]]:
        """Integrate controls from a state.

        Args:
            state: Shape (2 n,).
            controls: Accelerations [rad/s^2] and times [s], shape (N, n + 1).

        Returns:
            States every ``STEERING_STEP_S``, shape (N, K, 2 n), and tip positions [m], shape (N, K, 3). The third array
            has the numbers of states before the first invalid one, shape (N,).
        """
        (q, dq), n = np.split(state, 2), len(self.limit)
        ddq = np.repeat(controls[:, None, :n], round(self.spread.max_duration / STEERING_STEP_S), axis=1)
        t = STEERING_STEP_S * np.arange(1.0, ddq.shape[1] + 1)[:, None]
        paths = np.concatenate([q + t * (dq + t / 2 * ddq), dq + t * ddq], axis=2)
        flat = paths.reshape(-1, 2 * n)
        tips, valid_states = self.check(flat[:, :n], flat[:, n:], ddq.reshape(-1, n), self.obstacle_poses)
        active = t[:, 0] < controls[:, n:] + STEERING_STEP_S / 2
        valid = np.logical_and.accumulate(valid_states.reshape(active.shape) & active, axis=1)
        return paths, tips.reshape(*active.shape, 3), valid.sum(axis=1)
