"""Smooth motions through action chunks that start in a given state and end at rest, by one fixed least-squares matrix.

A chunk has K samples y_k at times k h. The path p(s) is a spline that passes the chunk
at the chunk time x(s), which rises at a constant rate and comes to rest at the end:

    x(s) = D s                      for s <= 1 - b,
    x'(s) = D (1 - sigma(y))        for y = (s - 1 + b) / b, sigma = 3 y^2 - 2 y^3,

with x(1) = (K - 1) h, so D = (K - 1) h / (1 - b / 2). The phases of the samples depend
on K alone, so the fit is one matrix. The rate of the motion is ds/dt = u(s) / D: u = 1
is the chunk's own timing. It rises or falls from the running speed within the blend.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cnpgen.addons.online.set_points import SetPoint
from cnpgen.arrays import Array
from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.spline import basis, clamped_knots
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

BRAKING_SHARE = 0.24  # b, of the phase: D is 1.14 times the chunk
RAMP_SHARE = 0.3  # of the phase, in which u changes from the running speed
MIN_RUNNING_SPEED = 0.75  # of u: slower starts would end after 1.2 times the chunk
CHUNK_DEGREE = 7
RATE_POINTS = 20
FIXED_POINTS = 3  # of the path at either end, by position, velocity and acceleration
MIN_CHUNK_POINTS = 12
MAX_CHUNK_POINTS = 20
SAMPLES_PER_POINT = 2.5
END_SAMPLES = 8  # whose parabola gives the state of a chunk at its ends
BLEND_SAMPLES = 24  # in which the difference to the running motion vanishes
SMOOTHNESS = 4e-5  # rad of residuals that are worth 1 rad/s^3 of jerk
MIN_SPEED2 = 1e-4  # (rad/s)^2 of a chunk that has a direction
PHASES = 129  # of the table of chunk times


@dataclass(frozen=True, eq=False)
class ChunkFit:
    """Fixed matrices of chunks of K samples; made by ``chunk_fit``.

    Attributes:
        spec: Degree and numbers of control points.
        length: Number of samples K.
        step: Time between samples h [s].
        duration: D [s], the duration at the chunk's own timing.
        phases: Phases of the samples, shape (K,).
        times: Chunk times x at ``PHASES`` equal phases [s], shape (PHASES,).
        solve: Pseudo-inverse of the rows of free control points, shape (free, rows).
        fixed: Rows of the control points at the ends, shape (rows, 2 FIXED_POINTS).
        first: Filter of position, velocity and acceleration of the first samples.
        last: Filter of the position of the last samples, shape (E,).
        decay: Blends of differences of position, velocity and acceleration, shape (K, 3).
        ramp: Share of the way from the running speed to the final one at every control
            point of the rate, shape (R,).
    """

    spec: TrajectorySpec
    length: int
    step: float
    duration: float
    phases: Array
    times: Array
    solve: Array
    fixed: Array
    first: Array
    last: Array
    decay: Array
    ramp: Array

    def running_speed(self, q: Array, state: SetPoint, max_speed: float) -> float:
        """Return u at the join: the component of the running velocity along the chunk, in its own speeds."""
        # The component of dq along the chunk's velocity v, in units of v: dq v / v^2.
        # The least square keeps it finite at rest.
        velocity = self.first[1] @ q[: self.first.shape[1]]
        along = float(state.dq @ velocity) / max(float(velocity @ velocity), MIN_SPEED2)
        return min(max(along, MIN_RUNNING_SPEED), max_speed)

    def rate(self, running: float, speed: Array) -> Array:
        """Return the rates of motions from a running speed to M speeds [1/s], shape (M, R)."""
        # Every control point of the rate moves from the running to the final speed by
        # its share.
        u = running + (speed[:, None] - running) * self.ramp
        return u / self.duration

    def blended(self, q: Array, state: SetPoint, running: float) -> Array:
        """Add the difference to the running motion at the join to the samples, shape (K, n); it vanishes later.

        In chunk time the running motion has velocity dq / u and acceleration ddq / u^2.
        """
        # State of the chunk at its first sample, by a least-squares parabola.
        own = self.first @ q[: self.first.shape[1]]
        running_state = np.stack([state.q, state.dq / running, state.ddq / running**2])
        return q + self.decay @ (running_state - own)

    def fit(self, q: Array, state: SetPoint, rate: Array) -> tuple[Boundary, Array]:
        """Fit a path to samples, shape (K, n), that starts in a state and ends at rest.

        The rate control points, shape (R,), are constant at the start.

        Returns:
            Boundary conditions and path control points, shape (C, n).
        """
        # The end of the parabola through the last samples lowers their noise.
        goal = self.last @ q[-len(self.last) :]
        still = np.zeros_like(goal)
        boundary = Boundary(*(x[None] for x in (*state, goal, still, still)))
        free = self.spec.path_control_points - 2 * FIXED_POINTS
        # Position, velocity and acceleration at both ends fix three control points
        # each.
        path = assemble(
            boundary, np.zeros((1, free, len(goal))), rate[None], self.spec
        )[0]
        ends = np.concatenate([path[:FIXED_POINTS], path[-FIXED_POINTS:]])
        # Least squares of the free points: A_free x = y - A_fixed x_fixed, with zero
        # jerk as target.
        target = -self.fixed @ ends
        target[: self.length] += q
        path[FIXED_POINTS:-FIXED_POINTS] = self.solve @ target
        return boundary, path


@lru_cache(maxsize=256)  # of lengths: those that delays leave
def chunk_fit(length: int, rate: float) -> ChunkFit:
    """Compute the matrices of chunks of K samples at a rate [Hz]."""
    step = 1 / rate
    # D = (K - 1) h / (1 - b / 2), of the module.
    duration = (length - 1) * step / (1 - BRAKING_SHARE / 2)
    points = int(
        np.clip(round(length / SAMPLES_PER_POINT), MIN_CHUNK_POINTS, MAX_CHUNK_POINTS)
    )
    spec = TrajectorySpec(
        degree=CHUNK_DEGREE, path_control_points=points, rate_control_points=RATE_POINTS
    )
    fine = np.linspace(0, 1, 4001)
    # The inverse of x(s) on a fine table gives the phases of the samples.
    phases = np.interp(np.arange(length) * step, chunk_times(fine, duration), fine)
    penalty = _jerk_penalty(points, length, duration)
    rows = np.concatenate([basis(phases, points, CHUNK_DEGREE), penalty])
    ends = np.r_[:FIXED_POINTS, points - FIXED_POINTS : points]
    samples = min(END_SAMPLES, length)
    x = np.arange(samples) * step
    ramp = _smooth_step(_greville(RATE_POINTS) / RAMP_SHARE)
    # r and r' at the start determine the path there
    ramp[:2] = 0.0
    return ChunkFit(
        spec,
        length,
        step,
        duration,
        phases,
        chunk_times(np.linspace(0, 1, PHASES), duration),
        # The pseudo-inverse is computed once for all chunks of this length.
        np.linalg.pinv(np.delete(rows, ends, axis=1)),
        rows[:, ends],
        # Parabola q + v x + a x^2 / 2 at the first sample, and its value at the last
        # one.
        np.linalg.pinv(np.stack([x**0, x, x**2 / 2], axis=1)),
        np.linalg.pinv(np.stack([x**0, x - x[-1], (x - x[-1]) ** 2], axis=1))[0],
        _decay(length, step),
        ramp,
    )


def _jerk_penalty(points: int, length: int, duration: float) -> Array:
    """Return the rows whose squares are the penalty of the jerks."""
    # Jerks are p''' / D^3, and their mean square over 4 C phases is the penalty.
    inner = np.linspace(0, 1, 4 * points)
    weight = SMOOTHNESS / duration**3 * np.sqrt(length / len(inner))
    rows: Array = weight * basis(inner, points, CHUNK_DEGREE, 3)
    return rows


def chunk_times(s: Array, duration: float) -> Array:
    """Return the chunk time x at phases in [0, 1] [s], shape (K,).

    The integral of 1 - sigma from 0 to y is y - y^3 + y^4 / 2.
    """
    b = BRAKING_SHARE
    y = np.clip((s - 1 + b) / b, 0.0, 1.0)
    return duration * (np.minimum(s, 1 - b) + b * (y - y**3 + y**4 / 2))


def _decay(length: int, step: float) -> Array:
    """Return the quintic Hermite polynomials of a unit position, velocity and acceleration that end at zero, (K, 3)."""
    samples = min(BLEND_SAMPLES, length - 1)
    span = samples * step
    u = np.minimum(np.arange(length) / samples, 1.0)
    # Every blend ends with zero value, velocity and acceleration: a factor of (1 -
    # u)^3.
    rest = (1 - u) ** 3
    return np.stack(
        [
            rest * (1 + 3 * u + 6 * u**2),
            span * u * rest * (1 + 3 * u),
            span**2 * u**2 * rest / 2,
        ],
        axis=1,
    )


def _greville(points: int) -> Array:
    """Return the phases at which control points act: means of the inner knots of their basis functions."""
    knots = clamped_knots(points, CHUNK_DEGREE)
    return np.array([knots[i + 1 : i + 1 + CHUNK_DEGREE].mean() for i in range(points)])


def _smooth_step(x: Array) -> Array:
    """Return 3 y^2 - 2 y^3 of values clipped to [0, 1]."""
    y = np.clip(x, 0.0, 1.0)
    return y**2 * (3 - 2 * y)
