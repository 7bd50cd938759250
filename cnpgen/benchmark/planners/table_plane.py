"""Paths of the mallet in the plane: two lines joined by an arc, with constant acceleration."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.simulator.hockey import HOME_M, LENGTH_M, MALLET_RADIUS_M, WIDTH_M

Array = NDArray[np.float64]

BAND_MARGIN_M = 0.02  # between the mallet and a band
MIN_MALLET_XY_M = np.array([HOME_M + MALLET_RADIUS_M + BAND_MARGIN_M, -WIDTH_M / 2 + MALLET_RADIUS_M + BAND_MARGIN_M])
MAX_MALLET_XY_M = np.array([HOME_M + LENGTH_M / 2 - MALLET_RADIUS_M, WIDTH_M / 2 - MALLET_RADIUS_M - BAND_MARGIN_M])
STOP_OFFSET_M = np.array([0.1, 0.15])  # ahead of the hit and towards the centre
MAX_STOP_XY_M = np.array([HOME_M + 0.9, 0.42085])
MIN_BEND_RAD = 1e-6


@dataclass(frozen=True)
class PlanePath:
    """A path of the mallet, from rest to a hit or from there to rest.

    Attributes:
        start: First position [m], shape (2,).
        bend: Intersection of the two lines [m], shape (2,).
        end: Last position [m], shape (2,).
        speed: At the hit [m/s].
        stops: Whether the path begins with the hit.
    """

    start: Array
    bend: Array
    end: Array
    speed: float
    stops: bool = False

    @property
    def length(self) -> float:
        """Length [m]."""
        before, after = self._lines()
        cut, radius, turn = self._arc()
        return before + after - 2 * cut + radius * turn

    @property
    def duration(self) -> float:
        """Time [s], with constant acceleration."""
        return 2 * self.length / self.speed

    def sampled(self, period: float) -> Iterator[Array]:
        """Yield the positions at every period after the start, the last one at the end or within a period of it."""
        duration, length = self.duration, self.length
        for k in range(1, round(duration / period + 0.499) + 1):
            t = min(k * period, duration)
            accelerated = t * t / (2 * duration)
            yield self.at(min(self.speed * (t - accelerated if self.stops else accelerated), length))

    def at(self, s: float) -> Array:
        """Return the position at a length of the path [m], shape (2,)."""
        before, _ = self._lines()
        cut, radius, turn = self._arc()
        one, other = _unit(self.bend - self.start), _unit(self.end - self.bend)
        if s <= before - cut:
            return np.asarray(self.start + s * one)
        along = s - (before - cut)
        if along >= radius * turn:
            return np.asarray(self.bend + (cut + along - radius * turn) * other)
        angle = along / radius
        across = _unit(other - (other @ one) * one)
        return np.asarray(self.bend - cut * one + radius * (np.sin(angle) * one + (1 - np.cos(angle)) * across))

    def _lines(self) -> tuple[float, float]:
        return float(np.linalg.norm(self.bend - self.start)), float(np.linalg.norm(self.end - self.bend))

    def _arc(self) -> tuple[float, float, float]:
        """Return the distance of the arc's ends from the bend [m], its radius [m] and its angle [rad]."""
        before, after = self._lines()
        one, other = _unit(self.bend - self.start), _unit(self.end - self.bend)
        turn = float(np.arccos(np.clip(one @ other, -1, 1)))
        cut = min(before, after)
        if turn < MIN_BEND_RAD or cut == 0:
            return 0.0, 0.0, 0.0
        return cut, cut / np.tan(turn / 2), turn


def striking_path(start: Array, hit: Array, velocity: Array, speed: float, acceleration: float) -> PlanePath:
    """Plan a path from rest to a hit in a direction: it bends where the line of the hit leaves the box of both ends.

    Args:
        start: Position at rest [m], shape (2,).
        hit: Position of the hit [m], shape (2,).
        velocity: Direction of the hit, of any length, shape (2,).
        speed: Speed of the hit [m/s], reduced if it needs more than ``acceleration``.
        acceleration: Largest acceleration along the path [m/s^2].
    """
    start, hit = np.clip(start, MIN_MALLET_XY_M, MAX_MALLET_XY_M), np.clip(hit, MIN_MALLET_XY_M, MAX_MALLET_XY_M)
    low, high = (
        np.array([min(start[0], hit[0]), MIN_MALLET_XY_M[1]]),
        np.array([max(start[0], hit[0]), MAX_MALLET_XY_M[1]]),
    )
    path = PlanePath(start, _exit_point(hit, -velocity, low, high), hit, speed)
    duration = max(2 * path.length / speed, np.sqrt(2 * path.length / acceleration))
    return PlanePath(path.start, path.bend, hit, 2 * path.length / duration)


def stopping_path(hit_path: PlanePath) -> PlanePath:
    """Plan the path from a hit to rest, ahead and towards the centre of the table."""
    hit = hit_path.end
    aside = STOP_OFFSET_M * np.array([1.0, -1.0 if hit[1] > 0 else 1.0])
    end = np.clip(hit + aside, [-np.inf, -MAX_STOP_XY_M[1]], MAX_STOP_XY_M)
    low, high = np.minimum(hit, end), np.maximum(hit, end)
    bends = bool((hit != hit_path.bend).any())
    forwards = hit - (hit_path.bend if bends else hit_path.start)
    return PlanePath(hit, _exit_point(hit, forwards, low, high), end, hit_path.speed, stops=True)


def _exit_point(point: Array, direction: Array, low: Array, high: Array) -> Array:
    """Return the point at which a ray leaves a box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(direction > 0, (high - point) / direction, (low - point) / direction)
    reach = reach[np.isfinite(reach)]
    return np.asarray(point + max(float(reach.min(initial=np.inf)), 0.0) * direction)


def _unit(vector: Array) -> Array:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0 else vector
