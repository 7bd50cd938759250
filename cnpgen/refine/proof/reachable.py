"""Where joints can be some time after the start of a motion, or before its end, whatever it does within its limits."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.joint import JointAcceleration, JointPosition, JointVelocity
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]
NONE = 1e6  # stands for a limit that the problem does not set
STEP = 1e-3  # s, of the search for the shortest duration
LOOKS = np.arange(10, 151, 10)  # steps from an end: later, intervals are too wide to prove anything


@dataclass(frozen=True)
class JointLimits:
    """Limits of positions, velocities and accelerations, shape (n,) each; the last two are symmetric."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array


def joint_limits(problem: Problem, robot: Robot, *, tolerances: float) -> JointLimits:
    """Return the limits that a problem's constraints set.

    Args:
        problem: The problem.
        robot: Its robot.
        tolerances: Fraction of the constraints' tolerances by which they are wider: 0, or 1 for what the verdict
            lets pass.
    """
    lower, upper, velocity, acceleration = (sign * np.full(robot.n, NONE) for sign in (-1, 1, 1, 1))
    for constraint in problem.constraint:
        room = tolerances * constraint.tolerance
        if isinstance(constraint, JointPosition):
            lower, upper = robot.position_lower - room, robot.position_upper + room
        elif isinstance(constraint, JointVelocity):
            velocity = robot.velocity_limit * (1 + room)
        elif isinstance(constraint, JointAcceleration):
            acceleration = robot.acceleration_limit * (1 + room)
    return JointLimits(lower, upper, velocity, acceleration)


@dataclass(frozen=True)
class Departure:
    """A state that a motion leaves from: its start, or its goal with time running backwards.

    Attributes:
        q: Joint positions [rad], shape (n,).
        dq: Joint velocities [rad/s], shape (n,); at the goal the opposite of the motion's.
    """

    q: Array
    dq: Array

    def box(self, time: float, limits: JointLimits) -> tuple[Array, Array]:
        """Bound where each joint can be ``time`` [s] later: (lower, upper), shape (n,); lower > upper is nowhere."""
        upper = _farthest(self.q, self.dq, time, limits)
        lower = -_farthest(-self.q, -self.dq, time, limits)
        return np.maximum(lower, limits.lower), np.minimum(upper, limits.upper)


def departures(boundary: Boundary) -> dict[str, Departure]:
    """Return both ends of one motion."""
    return {
        "start": Departure(boundary.start_q[0], boundary.start_dq[0]),
        "goal": Departure(boundary.goal_q[0], -boundary.goal_dq[0]),
    }


def moments(boundary: Boundary, limits: JointLimits) -> Array:
    """Return times from either end [s] at which no motion between the two ends can be over already."""
    start, goal = departures(boundary).values()
    pairs = (start, goal), (goal, start)
    over = next(
        (k for k in range(1, LOOKS[-1] + 1) if all(_reaches(one, other.q, k * STEP, limits) for one, other in pairs)),
        LOOKS[-1] + 1,
    )
    return np.asarray(STEP * LOOKS[over > LOOKS])


def _reaches(departure: Departure, q: Array, time: float, limits: JointLimits) -> bool:
    """Whether q may be reached within one step before ``time``."""
    lower, upper = departure.box(time, limits)
    on_the_way = STEP * np.maximum(limits.velocity, np.abs(departure.dq))
    return bool(((lower - on_the_way <= q) & (q <= upper + on_the_way)).all())


def _farthest(q: Array, dq: Array, time: float, limits: JointLimits) -> Array:
    """Accelerate to the velocity limit, then keep it."""
    ramp = np.clip((limits.velocity - dq) / limits.acceleration, 0.0, time)
    cruise = np.maximum(limits.velocity, dq) * (time - ramp)
    return np.asarray(q + dq * ramp + limits.acceleration * ramp**2 / 2 + cruise)
