"""Steering by the cross-entropy method: accelerations and a time that bring the arm near a configuration."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.planners.state_check import StateCheck

Array = NDArray[np.float64]

STEP = 0.01  # s
SAMPLES, ELITES, ITERATIONS = 64, 4, 30
NEAR = 0.02  # rad: nearer than this is near enough
LEARNT = 0.1  # of mean and spread: so much of them is the elites', the rest stays


@dataclass(frozen=True)
class Spread:
    """What controls are drawn from at first; the mean acceleration is 0.

    Attributes:
        acceleration: Standard deviation, as a share of the limits.
        mean_time: Mean of the time for which it is held [s].
        time: Standard deviation of that [s].
        longest: The longest time [s].
    """

    acceleration: float
    mean_time: float
    time: float
    max_duration: float


HIT = Spread(0.4, 0.1, 0.4, 0.5)
TRANSPORT = Spread(0.8, 0.05, 0.1, 0.1)


@dataclass(frozen=True)
class Steering:
    """Steers from states towards configurations, for one boundary problem.

    Attributes:
        check: What allows states.
        obstacle_poses: Heights of the obstacles' upper faces [m], shape (obstacles,).
        limit: Limits of the accelerations [rad/s^2], shape (n,).
        spread: What controls are drawn from at first.
        random: Where random numbers come from.
    """

    check: StateCheck
    obstacle_poses: Array
    limit: Array
    spread: Spread
    random: np.random.Generator

    def __call__(self, state: Array, target: Array) -> tuple[Array, Array] | None:
        """Steer; a control that leads to a state that is not allowed is held only until before that.

        Args:
            state: Where the arm is and how it moves, shape (2 n,).
            target: Where it is to be [rad], shape (n,); how it moves there does not matter.

        Returns:
            The states every ``STEP`` on the best way, shape (K, 2 n), and where the tip is at its end [m], shape (3,);
            None if no control led anywhere.
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
            if least < NEAR or not len(elites):
                break
            mean = (1 - LEARNT) * mean + LEARNT * elites.mean(axis=0)
            deviation = (1 - LEARNT) * deviation + LEARNT * elites.std(axis=0)
        return best

    def _drawn(self, mean: Array, deviation: Array) -> Array:
        """Draw controls within their limits: accelerations [rad/s^2] and a time [s], shape (SAMPLES, n + 1)."""
        drawn = self.random.normal(mean, deviation, (SAMPLES, len(mean)))
        return np.clip(drawn, np.append(-self.limit, STEP), np.append(self.limit, self.spread.max_duration))

    def followed(self, state: Array, controls: Array) -> tuple[Array, Array, NDArray[np.int64]]:
        """Follow controls from a state.

        Args:
            state: Shape (2 n,).
            controls: Accelerations [rad/s^2] and times [s], shape (N, n + 1).

        Returns:
            States every ``STEP``, shape (N, K, 2 n), where the tip is [m], shape (N, K, 3), and how many of them are
            allowed and within the time, one after the other from the first, shape (N,).
        """
        (q, dq), n = np.split(state, 2), len(self.limit)
        ddq = np.repeat(controls[:, None, :n], round(self.spread.max_duration / STEP), axis=1)
        t = STEP * np.arange(1.0, ddq.shape[1] + 1)[:, None]
        paths = np.concatenate([q + t * (dq + t / 2 * ddq), dq + t * ddq], axis=2)
        flat = paths.reshape(-1, 2 * n)
        tips, allowed = self.check(flat[:, :n], flat[:, n:], ddq.reshape(-1, n), self.obstacle_poses)
        within = t[:, 0] < controls[:, n:] + STEP / 2
        going = np.logical_and.accumulate(allowed.reshape(within.shape) & within, axis=1)
        return paths, tips.reshape(*within.shape, 3), going.sum(axis=1)
