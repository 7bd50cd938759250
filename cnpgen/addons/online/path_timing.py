"""Slower time laws along the path of a motion that are within its limits of acceleration and torque.

A motion ``q(t)`` is followed as ``q(sigma(t))`` with the speed ``u = dsigma/dt``, which
falls from 1 to 0, and ``w = -du/dt``. Its derivatives are ``dq = q' u`` and
``ddq = q'' u^2 - q' w``, so every acceleration and torque (Bobrow et al. 1985) is

    value = rest + square u^2 - brake_factor w.

The motion itself has u = 1 and w = 0. The feasible set of (u^2, w) is convex at each
state and contains (1, 0) and, since the arm can rest there, (0, 0): braking slowly
enough is feasible. The time law is one of a few shapes of w: it rises linearly, stays,
and falls linearly, so that accelerations are continuous at both ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np

from cnpgen.addons.online.motion_check import MotionChecker, passed_parts
from cnpgen.addons.online.set_points import (
    SampledMotion,
    SetPoint,
    grid,
    joined_motions,
    sample_states,
)
from cnpgen.arrays import Array, Integers, Mask
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.joint import JointAcceleration, JointTorque
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.world.drive import friction_bounds

RAMPS = (0.1, 0.25, 0.45, 0.7)  # shares of the braking time in which w rises or falls
NODE_STEP_S = 2e-3  # of the states at which limits are evaluated
PHASES_OF_LAW = 41  # at which a time law is compared with the limits
PHASES_OF_INVERSE = 1001  # of a table from which times at places of a law follow
TIMING_ROUNDING = 1e-9  # of times [s], and relative of limits
MAX_BRAKING_USE = 0.999  # of the limits: states between the phases differ a little


@dataclass(frozen=True)
class TimeLaw:
    """Speed along a path that falls from 1 to 0: after a time, within a duration [s].

    Attributes:
        start: Time at which the speed begins to fall [s].
        duration: Time that it takes to fall to 0 [s].
        rise: Share of the duration in which w rises from 0.
        fall: Share in which it falls to 0 again.
    """

    start: float
    duration: float
    rise: float
    fall: float

    @property
    def end(self) -> float:
        """Time at which the speed is 0 [s]."""
        return self.start + self.duration


@dataclass(frozen=True)
class PathLimits:
    """Accelerations and torques of a motion between two times at K nodes, and their limits, shape (K, m) each."""

    times: Array
    rest: Array
    square: Array
    brake_factor: Array
    limit: Array

    def feasible(self, start: Array, duration: Array, shapes: Integers) -> Mask:
        """Return which of N time laws are within the limits, shape (N,).

        Starts and durations [s] have shape (N,), shapes are indices of ``shape_table``.
        """
        speed, brake, travel = (table[shapes] for table in shape_table())
        # The tables have w times the duration.
        sigma = start[:, None] + duration[:, None] * travel
        return self.within(sigma, speed, brake / duration[:, None])

    def within(self, sigma: Array, speed: Array, brake: Array) -> Mask:
        """Return which of N time laws are within the limits at K places on the path sigma [s], shape (N,).

        The speed u and w [1/s] at these places have shape (N, K).
        """
        node = np.searchsorted(self.times, sigma, side="right") - 1
        node = np.clip(node, 0, len(self.times) - 2)
        width = self.times[node + 1] - self.times[node]
        share = np.clip((sigma - self.times[node]) / width, 0.0, 1.0)[..., None]
        u2 = (speed**2)[..., None]
        w = brake[..., None]
        # The value is linear in each of the tables, so the two nodes are compared.
        low, high = (
            np.abs(self.rest[k] + self.square[k] * u2 - self.brake_factor[k] * w)
            / self.limit[k]
            for k in (node, node + 1)
        )
        largest = (low + share * (high - low)).max(axis=(1, 2), initial=0.0)
        return np.asarray(largest <= 1.0)


@cache
def shapes() -> tuple[tuple[float, float], ...]:
    """Return the shapes of time laws: shares of the braking time in which w rises and falls."""
    return tuple(
        (rise, fall) for rise, fall in product(RAMPS, RAMPS) if rise + fall <= 1
    )


@cache
def shape_table() -> tuple[Array, Array, Array]:
    """Return u, w times the duration, and sigma over the duration of every shape, shape (shapes, K) each."""
    x = np.linspace(0.0, 1.0, PHASES_OF_LAW)
    tables = [shape_at(x, rise, fall) for rise, fall in shapes()]
    return tuple(np.array(table) for table in zip(*tables, strict=True))  # type: ignore[return-value]


def shape_at(x: Array, rise: float, fall: float) -> tuple[Array, Array, Array]:
    """Evaluate u, w T and sigma / T of a time law of duration T at phases x in [0, 1], shape (K,).

    With the height h = 1 / (1 - (rise + fall) / 2), w T = h min(x / rise, 1,
    (1 - x) / fall); u = 1 - integral of w T; sigma / T = integral of u.
    """
    height = 1 / (1 - (rise + fall) / 2)
    # A trapezoid of area 1: the speed falls by one.
    brake = height * np.minimum(np.minimum(x / rise, (1 - x) / fall), 1.0)
    # Integrals of the ramps (x - e)+ that w T consists of: its gradient changes at e.
    edges = (0.0, rise, 1 - fall)
    gradients = (1 / rise, -1 / rise, -1 / fall)
    lost = np.zeros_like(x)
    shortened = np.zeros_like(x)
    for edge, gradient in zip(edges, gradients, strict=True):
        after = np.maximum(x - edge, 0.0)
        lost += height * gradient * after**2 / 2
        shortened += height * gradient * after**3 / 6
    return 1 - lost, brake, x - shortened


def path_limits(
    checker: MotionChecker, motion: SampledMotion, first: float, last: float
) -> PathLimits:
    """Evaluate the limits of a motion with a plan between two times [s].

    A limit that the motion itself exceeds within its tolerance is the value of the
    motion there.
    """
    assert motion.plan is not None
    # At least three nodes, also for a short remainder of the motion.
    times = np.linspace(first, last, max(3, int((last - first) / NODE_STEP_S) + 2))
    kinks = _kinks(motion)
    # Between kinks, velocities are parabolas of large curvature: more nodes are needed.
    parts = np.linspace(kinks[:-1], kinks[1:], 5).ravel()
    nodes = np.append(parts, kinks)
    times = np.union1d(times, nodes[(first < nodes) & (nodes < last)])
    # At its end a sampled motion is at rest: the state before is that of its last cell.
    states = motion.at(np.minimum(times, np.nextafter(motion.end_time, -np.inf)))
    terms = []
    for part, mask, _ in passed_parts(motion, times):
        terms.append(_terms(checker, part, SetPoint(*(x[mask] for x in states))))
    rest, square, brake_factor, limit = (
        np.concatenate(x) for x in zip(*terms, strict=True)
    )
    # The motion itself is valid within tolerances: braking must not be refused for
    # them.
    limit = np.maximum(
        MAX_BRAKING_USE * limit, np.abs(rest + square) * (1 + TIMING_ROUNDING)
    )
    return PathLimits(times, rest, square, brake_factor, limit)


def _kinks(motion: SampledMotion) -> Array:
    """Return the edges [s] at which an acceleration may have a kink: of slowed cells, and between unequal widths."""
    width = np.diff(motion.edges)
    slowed = np.abs(np.diff(motion.plan_times) - width) > TIMING_ROUNDING
    unequal = np.abs(np.diff(width)) > TIMING_ROUNDING
    return motion.edges[1:-1][slowed[:-1] | slowed[1:] | unequal]


def _terms(
    checker: MotionChecker, part: Plans, states: SetPoint
) -> tuple[Array, Array, Array, Array]:
    """Return rest, square, brake_factor and limit of the limited quantities at K states, shape (K, m) each."""
    q, dq, ddq = states
    still, (problem, robot) = np.zeros_like(q), open_problem(part.problem)
    quantities = []
    if problem.first(JointAcceleration) is not None:
        limit = _acceleration_factor(part, robot) * robot.acceleration_limit
        quantities.append((still, ddq, dq, np.broadcast_to(limit, q.shape)))
    if problem.first(JointTorque) is not None:
        # Inverse dynamics at rest are the torques of gravity.
        gravity = checker.torques(part, q, still, still)
        # With dq = 0 and ddq = q', they are M q' + gravity.
        brake_factor = checker.torques(part, q, still, dq) - gravity
        # With u = 1 and w = 0, they are those of the motion: M q'' + n(q, q') +
        # gravity.
        square = checker.torques(part, q, dq, ddq) - gravity
        limit = np.broadcast_to(robot.torque_limit, q.shape)
        quantities.append((gravity, square, brake_factor, limit))
        if (drive := robot.drive) is not None and drive.motor_rows:
            # Friction of either direction reduces the limit: its sum would not be linear.
            friction = np.max(np.abs(friction_bounds(drive, dq.T)), axis=0).T
            left = drive.torque_limit - np.maximum(friction, drive.resting_friction)
            # Rotors add armature times ddq, which has the same form q'' u^2 - q' w.
            rotors = square + drive.armature * ddq, brake_factor + drive.armature * dq
            quantities.append((gravity, *rotors, left))
    if not quantities:
        return (np.zeros((len(q), 0)),) * 4
    return tuple(np.hstack(term) for term in zip(*quantities, strict=True))  # type: ignore[return-value]


def _acceleration_factor(part: Plans, robot: Robot) -> float:
    """Return the parameter of a plan that scales its acceleration limits, 1 without one."""
    if part.boundary.parameters is None:
        return 1.0
    values = part.boundary.parameters[0].tolist()
    return float(
        dict(zip(robot.parameters.names, values, strict=True)).get(
            JointAcceleration.factor_name, 1.0
        )
    )


def _law_grid(motion: SampledMotion, law: TimeLaw) -> Array:
    """Return the edges of cells from 0 to the duration of a time law along a motion [s].

    No cell has a kink of w or of the motion's acceleration: a polynomial over it would
    exceed both of its ends.
    """
    rise = law.duration * law.rise
    fall = law.duration * law.fall
    ramp = grid(rise)
    level = rise + grid(law.duration - rise - fall)
    times = np.concatenate([ramp[:-1], level[:-1], law.duration - grid(fall)[::-1]])
    places = (_kinks(motion) - law.start) / law.duration
    # The times at which the law passes the kinks: the inverse of a table of the places.
    phases = np.linspace(0.0, 1.0, PHASES_OF_INVERSE)
    travel = shape_at(phases, law.rise, law.fall)[2]
    inside = places[(places > 0.0) & (places < travel[-1])]
    passed = law.duration * np.interp(inside, travel, phases)
    times = np.union1d(times, passed)
    # Cells of no width, by rounding, have no polynomial.
    kept = np.diff(times, append=np.inf) > TIMING_ROUNDING
    return np.append(times[:-1][kept[:-1]], law.duration)


def keeps_limits(limits: PathLimits, motion: SampledMotion, law: TimeLaw) -> bool:
    """Return whether a time law along a motion is within the limits at the edges and in the middle of its cells."""
    times = _law_grid(motion, law)
    times = np.sort(np.append(times, times[:-1] + np.diff(times) / 2))
    u, brake, travel = shape_at(times / law.duration, law.rise, law.fall)
    sigma = law.start + law.duration * travel
    return bool(limits.within(sigma[None], u[None], brake[None] / law.duration)[0])


def retimed(motion: SampledMotion, law: TimeLaw) -> SampledMotion:
    """Return the motion that leaves another one at ``law.start`` and rests at ``law.end``.

    Before the law begins, it is the given motion.
    """
    assert motion.plan is not None
    times = _law_grid(motion, law)
    u, brake, travel = shape_at(times / law.duration, law.rise, law.fall)
    sigma = law.start + law.duration * travel
    # A law may end where the path ends.
    if sigma[-1] >= motion.end_time - TIMING_ROUNDING:
        # A slower end stops with the path.
        sigma = np.minimum(sigma, np.nextafter(motion.end_time, -np.inf))
    q, dq, ddq = motion.at(sigma)
    u[-1] = brake[-1] = 0.0  # exactly at rest
    u = u[:, None]
    w = brake[:, None] / law.duration
    states = SetPoint(q, dq * u, ddq * u**2 - dq * w)
    # Slower times keep the place on the path of the plan.
    plan_times = np.interp(sigma, motion.edges, motion.plan_times)
    slower = sample_states(law.start + times, states, motion.plan, plan_times)
    return joined_motions(motion, slower) if law.start > motion.start else slower
