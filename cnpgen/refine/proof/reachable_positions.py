"""Joint positions that any motion within its limits can reach some time after the start, or before the goal."""

from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array
from cnpgen.problems.constraints.joint import (
    JointAcceleration,
    JointPosition,
    JointVelocity,
)
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary

NO_LIMIT = 1e6  # replaces a limit that the problem does not set
DURATION_STEP_S = 1e-3  # of the search for the minimum duration
# From an end; later, intervals are too wide to prove anything.
SAMPLED_STEPS = np.arange(10, 151, 10)


@dataclass(frozen=True)
class JointLimits:
    """Limits of positions, velocities and accelerations, shape (n,) each.

    The last two are symmetric.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array


def joint_limits(problem: Problem, robot: Robot, *, tolerances: float) -> JointLimits:
    """Return the limits of a problem's constraints, relaxed by a fraction of their tolerances, from 0 to 1."""
    lower, upper, velocity, acceleration = (
        sign * np.full(robot.n, NO_LIMIT) for sign in (-1, 1, 1, 1)
    )
    for constraint in problem.constraint:
        tolerance = tolerances * constraint.tolerance
        if isinstance(constraint, JointPosition):
            lower = robot.position_lower - tolerance
            upper = robot.position_upper + tolerance
        elif isinstance(constraint, JointVelocity):
            velocity = robot.velocity_limit * (1 + tolerance)
        elif isinstance(constraint, JointAcceleration):
            acceleration = robot.acceleration_limit * (1 + tolerance)
    return JointLimits(lower, upper, velocity, acceleration)


@dataclass(frozen=True)
class EndState:
    """State at the start of a motion, or at its goal with reversed time."""

    q: Array  # joint positions [rad], shape (n,)
    # Joint velocities [rad/s], shape (n,); at the goal the opposite of the motion's.
    dq: Array

    def box(self, time: float, limits: JointLimits) -> tuple[Array, Array]:
        """Bound each joint's position ``time`` [s] later: (lower, upper), shape (n,).

        Empty where lower > upper.
        """
        upper = _max_position(self.q, self.dq, time, limits)
        # The lowest position is the highest one of the mirrored joint.
        lower = -_max_position(-self.q, -self.dq, time, limits)
        return np.maximum(lower, limits.lower), np.minimum(upper, limits.upper)


def end_states(boundary: Boundary) -> dict[str, EndState]:
    """Return both end states of one motion."""
    return {
        "start": EndState(boundary.start_q[0], boundary.start_dq[0]),
        # Reversed time changes the sign of velocities.
        "goal": EndState(boundary.goal_q[0], -boundary.goal_dq[0]),
    }


def sample_times(boundary: Boundary, limits: JointLimits) -> Array:
    """Return times from either end [s] that are shorter than any motion between the two ends."""
    start, goal = end_states(boundary).values()
    pairs = (start, goal), (goal, start)
    # The first time at which each end is in the box of the other; no motion is shorter.
    min_steps = next(
        (
            k
            for k in range(1, SAMPLED_STEPS[-1] + 1)
            if all(
                _reaches(state, other.q, k * DURATION_STEP_S, limits)
                for state, other in pairs
            )
        ),
        SAMPLED_STEPS[-1] + 1,
    )
    return np.asarray(DURATION_STEP_S * SAMPLED_STEPS[min_steps > SAMPLED_STEPS])


def _reaches(state: EndState, q: Array, time: float, limits: JointLimits) -> bool:
    """Return whether q may be reached within one step before ``time``."""
    lower, upper = state.box(time, limits)
    change = DURATION_STEP_S * np.maximum(limits.velocity, np.abs(state.dq))
    return bool(((lower - change <= q) & (q <= upper + change)).all())


def _max_position(q: Array, dq: Array, time: float, limits: JointLimits) -> Array:
    """Return the positions after full acceleration to the velocity limit, and constant velocity from there."""
    # v(t) = min(dq + a t, v_max): q + dq t_r + a t_r^2 / 2 + v_max (t - t_r) with t_r =
    # (v_max - dq) / a.
    ramp = np.clip((limits.velocity - dq) / limits.acceleration, 0.0, time)
    cruise = np.maximum(limits.velocity, dq) * (time - ramp)
    return np.asarray(q + dq * ramp + limits.acceleration * ramp**2 / 2 + cruise)
