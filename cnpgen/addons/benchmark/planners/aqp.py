"""Anchored quadratic programming ('cnpgen docs references', 2), a baseline of the paper for hits.

The planner first computes a path of the tip in the plane, two lines and an arc, with
constant acceleration up to the hit. At each sample, a quadratic program then computes
the joint velocity that follows the path. It moves the arm towards the hitting
configuration in the null space of the tip's Jacobian, within limits of position and
velocity only.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import BenchmarkPlanner, Plan, Setting
from cnpgen.addons.benchmark.simulator.hockey import (
    HOME_M,
    LENGTH_M,
    MALLET_RADIUS_M,
    WIDTH_M,
)
from cnpgen.addons.benchmark.simulator.tip import Tip
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array, Vector3
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field

SAMPLE_PERIOD_S = 0.01  # reduced so that a sample is the hit
JOINT_WEIGHTS = (1.0, 1.0, 5.0, 1.0, 10.0, 10.0, 0.01)
JOINT_LIMIT_FRACTION = 0.95
SPEED_REDUCTION, MAX_TRIES = 0.9, 10  # after a failure
BAND_MARGIN_M = 0.02  # between the mallet and a band
MIN_MALLET_XY_M = np.array(
    [
        HOME_M + MALLET_RADIUS_M + BAND_MARGIN_M,
        -WIDTH_M / 2 + MALLET_RADIUS_M + BAND_MARGIN_M,
    ]
)
MAX_MALLET_XY_M = np.array(
    [
        HOME_M + LENGTH_M / 2 - MALLET_RADIUS_M,
        WIDTH_M / 2 - MALLET_RADIUS_M - BAND_MARGIN_M,
    ]
)
STOP_OFFSET_M = np.array([0.1, 0.15])  # ahead of the hit and towards the centre
MAX_STOP_XY_M = np.array([HOME_M + 0.9, 0.42085])
MIN_BEND_RAD = 1e-6


@dataclass(frozen=True)
class AQP(BenchmarkPlanner):
    """Anchored quadratic programming along a path in the plane (Liu et al., 2021)."""

    acceleration: float = field(
        "largest acceleration of the mallet up to the hit",
        unit="m/s^2",
        default=8.0,
        low=0.1,
    )
    anchor_time: float = field(
        "time constant of the motion towards the hitting configuration",
        unit="s",
        default=0.5,
        low=1e-3,
    )

    def prepare(self, setting: Setting) -> Plan:
        """Check that there is a table to plan on."""
        problem, robot = open_problem(setting.problem)
        table = problem.first(Table)
        if table is None or robot.n > len(JOINT_WEIGHTS):
            raise UsageError(
                f"aqp plans hits on a table with up to 7 joints, {problem.name!r} is another problem"
            )
        return lambda task: _Follower(robot, task, self).plan(table.z)


class _Follower:
    """Joint motion that follows a path in the plane."""

    def __init__(self, robot: Robot, task: Plans, settings: AQP) -> None:
        self._robot = robot
        self._boundary = task.boundary
        self._settings = settings
        self._tip = Tip(robot)
        self._goal = task.columns["goal_xyz"][0]
        self._weights = np.array(JOINT_WEIGHTS[: robot.n])

    def plan(self, height: float) -> Trajectory | None:
        """Plan the fastest hit that can be followed, down to a third of the required speed."""
        start, _, _ = self._tip.at(self._boundary.start_q[0])
        velocity = (
            self._tip.at(self._boundary.goal_q[0])[2][:3] @ self._boundary.goal_dq[0]
        )
        speed = float(np.linalg.norm(velocity[:2]))
        if speed == 0:
            raise UsageError("aqp plans hits, this motion ends at rest")
        for _ in range(MAX_TRIES):
            hit = striking_path(
                start[:2],
                self._goal[:2],
                velocity[:2],
                speed,
                self._settings.acceleration,
            )
            stop = stopping_path(hit)
            trajectory = self._follow(hit, stop, height)
            if trajectory is not None:
                return trajectory
            speed *= SPEED_REDUCTION
        return None

    def _follow(
        self, hit: PlanePath, stop: PlanePath, height: float
    ) -> Trajectory | None:
        """Follow both parts; return None if a quadratic program has no solution."""
        from scipy.interpolate import CubicSpline

        # A whole number of periods ends with the hit.
        count = max(int(np.ceil(hit.duration / SAMPLE_PERIOD_S)), 2)
        period = hit.duration / count
        samples = np.array([*hit.sampled(period), *stop.sampled(period)])
        t = period * np.arange(len(samples) + 1.0)
        q = [self._boundary.start_q[0]]
        dq = self._boundary.start_dq[0]
        for sample, time in zip(samples, t[1:], strict=True):
            next_dq = self._velocity(
                q[-1],
                np.append(sample, height),
                period,
                self._anchor_velocity(q[-1], time, t[count], t[-1]),
            )
            if next_dq is None:
                return None
            # Velocities change linearly in a period, so their mean counts.
            q.append(q[-1] + (dq + next_dq) / 2 * period)
            dq = next_dq
        spline = CubicSpline(t, np.array(q), bc_type="clamped")
        # The part after the hit determines the spline's velocity there, and is not
        # sent.
        until = slice(0, count + 1)
        return Trajectory(t[until], np.array(q)[until], np.asarray(spline(t, 1))[until])

    def _anchor_velocity(self, q: Array, t: float, hit: float, end: float) -> Array:
        """Return the velocity towards the anchor.

        It increases up to the hit and then decreases.
        """
        velocity = (self._boundary.goal_q[0] - q) / self._settings.anchor_time
        if t > hit:
            return np.asarray((end - t) / (end - hit) * velocity)
        share = t / hit
        return np.asarray(
            share * velocity + np.clip(1 - share, 0, 1) * self._boundary.start_dq[0]
        )

    def _velocity(
        self, q: Array, position: Array, period: float, anchor_velocity: Array
    ) -> Array | None:
        """Return the joint velocity that moves the tip to the sample, closest to the velocity of the anchor."""
        robot = self._robot
        tip, _, J = self._tip.at(q)
        J = J[:3]
        # Velocity of minimum norm: J^T (J J^T)^-1 v.
        min_norm = J.T @ np.linalg.solve(J @ J.T, (position - tip) / period)
        # The right singular vectors beyond the rank of 3 span the null space.
        null = np.linalg.svd(J)[2][3:].T
        # The velocity that reaches a position limit within one period is a bound, too.
        low = np.maximum(
            -robot.velocity_limit,
            (JOINT_LIMIT_FRACTION * robot.position_lower - q) / period,
        )
        high = np.minimum(
            robot.velocity_limit,
            (JOINT_LIMIT_FRACTION * robot.position_upper - q) / period,
        )
        bounds = low - min_norm, high - min_norm
        null_velocity = nearest_in_null_space(
            null, self._weights, min_norm - anchor_velocity, bounds
        )
        return (
            None
            if null_velocity is None
            else np.asarray(min_norm + null @ null_velocity)
        )


def nearest_in_null_space(
    null: Array, weights: Array, ahead: Array, bounds: tuple[Array, Array]
) -> Array | None:
    """Minimize ``a^T N^T W N a / 2 + ahead^T W N a`` with ``low <= N a <= high``, by DAQP.

    N is ``null``, shape (n, k), and W has ``weights`` on its diagonal. ``ahead`` is the
    velocity without ``a`` minus the desired one [rad/s], shape (n,). Return a, shape
    (k,), or None if the bounds [rad/s] are infeasible.
    """
    import daqp

    weighted = weights[:, None] * null
    hessian = null.T @ weighted
    gradient = weighted.T @ ahead
    # DAQP bounds the rows N a, of which there is one for each joint.
    low, high = (np.ascontiguousarray(bound) for bound in bounds)
    if np.any(low > high):
        return None
    solution, _, status, _ = daqp.solve(
        np.ascontiguousarray(hessian),
        np.ascontiguousarray(gradient),
        np.ascontiguousarray(null),
        high,
        low,
    )
    return np.array(solution) if status > 0 else None


@dataclass(frozen=True)
class PlanePath:
    """A path of the mallet, from rest to a hit or, if it stops, from there to rest.

    Two lines lead from the start over the bend to the end [m], shape (2,) each; the
    speed at the hit is in m/s.
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
        # From rest to the speed v with constant acceleration, the mean speed is v / 2.
        return 2 * self.length / self.speed

    def sampled(self, period: float) -> Iterator[Array]:
        """Yield the positions at every period after the start, the last one at the end or within a period of it."""
        duration = self.duration
        length = self.length
        for k in range(1, round(duration / period + 0.499) + 1):
            t = min(k * period, duration)
            # s(t) = v t^2 / (2 T) from rest, and v (t - t^2 / (2 T)) to rest.
            accelerated = t * t / (2 * duration)
            yield self.at(
                min(
                    self.speed * (t - accelerated if self.stops else accelerated),
                    length,
                )
            )

    def at(self, s: float) -> Array:
        """Return the position at a length of the path [m], shape (2,)."""
        before, _ = self._lines()
        cut, radius, turn = self._arc()
        one, other = self._directions()
        if s <= before - cut:
            return np.asarray(self.start + s * one)
        along = s - (before - cut)
        if along >= radius * turn:
            return np.asarray(self.bend + (cut + along - radius * turn) * other)
        angle = along / radius
        across = _unit(other - (other @ one) * one)
        return np.asarray(
            self.bend
            - cut * one
            + radius * (np.sin(angle) * one + (1 - np.cos(angle)) * across)
        )

    def _lines(self) -> tuple[float, float]:
        before = self.bend - self.start
        after = self.end - self.bend
        return float(np.linalg.norm(before)), float(np.linalg.norm(after))

    def _directions(self) -> tuple[Array, Array]:
        return _unit(self.bend - self.start), _unit(self.end - self.bend)

    def _arc(self) -> Vector3:
        """Return the distance of the arc's ends from the bend [m], its radius [m] and its angle [rad]."""
        before, after = self._lines()
        one, other = self._directions()
        turn = float(np.arccos(np.clip(one @ other, -1, 1)))
        cut = min(before, after)
        if turn < MIN_BEND_RAD or cut == 0:
            return 0.0, 0.0, 0.0
        # An arc that is tangential to both lines at a distance c from the bend.
        return cut, cut / np.tan(turn / 2), turn


def striking_path(
    start: Array, hit: Array, velocity: Array, speed: float, acceleration: float
) -> PlanePath:
    """Plan a path from rest to a hit in a direction: it bends where the line of the hit leaves the box of both ends.

    Positions [m] and the direction have shape (2,). The speed [m/s] is reduced if it
    needs more than the largest acceleration along the path [m/s^2].
    """
    start = np.clip(start, MIN_MALLET_XY_M, MAX_MALLET_XY_M)
    hit = np.clip(hit, MIN_MALLET_XY_M, MAX_MALLET_XY_M)
    low = np.array([min(start[0], hit[0]), MIN_MALLET_XY_M[1]])
    high = np.array([max(start[0], hit[0]), MAX_MALLET_XY_M[1]])
    path = PlanePath(start, _exit_point(hit, -velocity, low, high), hit, speed)
    # v = 2 L / T and a = v / T give T >= sqrt(2 L / a).
    duration = max(2 * path.length / speed, np.sqrt(2 * path.length / acceleration))
    return PlanePath(path.start, path.bend, hit, 2 * path.length / duration)


def stopping_path(hit_path: PlanePath) -> PlanePath:
    """Plan the path from a hit to rest, ahead and towards the centre of the table."""
    hit = hit_path.end
    aside = STOP_OFFSET_M * np.array([1.0, -1.0 if hit[1] > 0 else 1.0])
    end = np.clip(hit + aside, [-np.inf, -MAX_STOP_XY_M[1]], MAX_STOP_XY_M)
    low = np.minimum(hit, end)
    high = np.maximum(hit, end)
    bends = bool((hit != hit_path.bend).any())
    forwards = hit - (hit_path.bend if bends else hit_path.start)
    return PlanePath(
        hit, _exit_point(hit, forwards, low, high), end, hit_path.speed, stops=True
    )


def _exit_point(point: Array, direction: Array, low: Array, high: Array) -> Array:
    """Return the point at which a ray leaves a box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(
            direction > 0, (high - point) / direction, (low - point) / direction
        )
    reach = reach[np.isfinite(reach)]
    return np.asarray(point + max(float(reach.min(initial=np.inf)), 0.0) * direction)


def _unit(vector: Array) -> Array:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0 else vector
