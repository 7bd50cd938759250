"""Other executions of the same action chunks: as they are, clamped, timed by TOPP-RA, and Ruckig to the last sample."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from common import cpu_of, median

from cnpgen.addons.benchmark.planners.rrtconnect import (
    _torque_constraint,
    load_toppra,
)
from cnpgen.addons.benchmark.planners.ruckig import load_ruckig, time_optimal_motion
from cnpgen.addons.online.set_points import SetPoint, sample_states
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary

Array = np.ndarray[Any, np.dtype[np.float64]]

GRID_S = 5e-3
MAX_USE = 1.01  # of a limit: differences of samples are no derivatives
Execute = Callable[[Robot, SetPoint, Array, float], "Executed | None"]


@dataclass(frozen=True)
class Executed:
    """States of a motion of a chunk from the join on, shape (K, n) each."""

    q: Array
    dq: Array
    ddq: Array

    def use(self, robot: Robot) -> float:
        """Return the largest share of the limits of velocity, acceleration and torque."""
        data = robot.model.createData()
        torque = np.array(
            [
                pin.rnea(robot.model, data, *state)
                for state in zip(self.q, self.dq, self.ddq, strict=True)
            ]
        )
        pairs = (
            (self.dq, robot.velocity_limit),
            (self.ddq, robot.acceleration_limit),
            (torque, robot.torque_limit),
        )
        return max(float((np.abs(x) / limit).max()) for x, limit in pairs)

    def jump(self, state: SetPoint) -> Array:
        """Return the largest jumps of position, velocity and acceleration at the join, shape (3,)."""
        own = self.q[0], self.dq[0], self.ddq[0]
        return np.array([np.abs(x - y).max() for x, y in zip(own, state, strict=True)])

    def distance(self, chunk: Array) -> float:
        """Return the largest distance of the samples of a chunk from the path of the motion [rad]."""
        return max(float(np.abs(self.q - row).max(axis=1).min()) for row in chunk)


def raw(_: Robot, state: SetPoint, chunk: Array, rate: float) -> Executed:
    """Send every sample as it is; derivatives are differences, the first ones to the running motion."""
    before = state.q - np.arange(2, 0, -1)[:, None] / rate * state.dq
    q = np.concatenate([before, chunk])
    dq = np.diff(q, axis=0) * rate
    return Executed(chunk, dq[1:], np.diff(dq, axis=0) * rate)


def clamped(robot: Robot, state: SetPoint, chunk: Array, rate: float) -> Executed:
    """Send every sample, moved towards the last one to a step of at most the velocity limit."""
    largest, last, sent = robot.velocity_limit / rate, state.q, []
    for sample in chunk:
        last = last + np.clip(sample - last, -largest, largest)
        sent.append(last)
    return raw(robot, state, np.array(sent), rate)


def toppra(robot: Robot, state: SetPoint, chunk: Array, _: float) -> Executed | None:
    """Time the cubic spline through the running position and all samples to rest (Pham and Pham, 2018)."""
    library = load_toppra()
    points = np.concatenate([state.q[None], chunk[1:]])
    steps = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 1e-4)
    length = np.append(0.0, np.cumsum(steps))
    spline = library.SplineInterpolator(length / length[-1], points)
    bounds = library.constraint
    limits = [
        kind(np.stack([-limit, limit], axis=1))
        for kind, limit in (
            (bounds.JointVelocityConstraint, robot.velocity_limit),
            (bounds.JointAccelerationConstraint, robot.acceleration_limit),
        )
    ]
    limits.append(_torque_constraint(library, robot))
    timing = library.algorithm.TOPPRA(
        limits, spline, parametrizer="ParametrizeConstAccel"
    )
    tangent = spline(0.0, 1)
    start = max(float(tangent @ state.dq / (tangent @ tangent)), 0.0)
    timed = timing.compute_trajectory(start, 0.0)
    if timed is None:
        return None
    t = np.arange(0.0, float(timed.duration), GRID_S)
    return Executed(*(np.asarray(timed(t, order)) for order in range(3)))


def ruckig(robot: Robot, state: SetPoint, chunk: Array, _: float) -> Executed | None:
    """Move to the last sample at rest as fast as possible (Berscheid and Kroeger, 2021)."""
    still = np.zeros((1, robot.n))
    q, dq, ddq, goal = (x[None] for x in (*state, chunk[-1]))
    boundary = Boundary(q, dq, ddq, goal, still)
    found = time_optimal_motion(load_ruckig(), robot, boundary)
    if found is None or found.dq is None or found.ddq is None:
        return None
    return _resampled(found.t, SetPoint(found.q, found.dq, found.ddq))


def _resampled(t: Array, states: SetPoint) -> Executed:
    """Return quintics through states at times on a grid."""
    motion = sample_states(t, states, None, np.zeros(len(t)))  # type: ignore[arg-type]
    return Executed(*motion.at(np.arange(0.0, t[-1], GRID_S)))


BASELINES: dict[str, Execute] = {
    "raw": raw,
    "clamped": clamped,
    "TOPP-RA": toppra,
    "Ruckig": ruckig,
}


def compare(
    robot: Robot, cases: list[tuple[SetPoint, Array]], rate: float
) -> dict[str, dict[str, float]]:
    """Execute the same chunks from the same states of the running motion by every baseline."""
    return {
        name: dict(_figures(robot, cases, rate, execute))
        for name, execute in BASELINES.items()
    }


def _figures(
    robot: Robot, cases: list[tuple[SetPoint, Array]], rate: float, execute: Execute
) -> Iterator[tuple[str, float]]:
    found: list[Executed | None] = []
    seconds = [
        cpu_of(lambda s=state, c=chunk: found.append(execute(robot, s, c, rate)))  # type: ignore[misc]
        for state, chunk in cases
    ]
    pairs = [(x, *case) for x, case in zip(found, cases, strict=True) if x is not None]
    jumps = np.array([x.jump(state) for x, state, _ in pairs])
    uses = [x.use(robot) for x, _, _ in pairs]
    yield "found", len(pairs) / len(cases)
    yield "within limits", sum(use <= MAX_USE for use in uses) / len(cases)
    yield "largest use", max(uses)
    yield from zip(("jump q", "jump dq", "jump ddq"), jumps.max(axis=0), strict=True)
    yield "distance", max(x.distance(chunk[8:]) for x, _, chunk in pairs)
    yield "ms", 1e3 * median(seconds)
