"""Plants whose drives differ from those of a problem: another friction law, other parameters, late and limited currents.

Friction has a Stribeck law, ``c (1 + 0.5 exp(-|dq| / 0.1)) sign(dq) + b dq``: half as much again at breakaway. Rotors and
friction are those of the problem times 1 + error. ``torque_errors`` judges the planned motion on such a plant.
``execute`` simulates the arm under a controller that knows the drives of the problem: its torques arrive 1 ms late, the
current follows with a time constant of 1 ms, and rises from zero to the limit in 5 ms at the fastest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cnpgen.plans.plans import Plans
from cnpgen.robots.drive import Drive
from cnpgen.robots.robot import Robot

STRIBECK_RATIO, STRIBECK_SPEED = 1.5, 0.1  # breakaway / dry friction; rad/s
TICK_S, STEPS = 1e-3, 5  # of the controller; of the simulation in a tick
DELAY_TICKS, CURRENT_S, RISE_S = 1, 1e-3, 5e-3
GAIN_RAD_S = 80.0  # of the controller, as that of 'cnpgen simulate'
SMOOTH_SPEED = 0.02  # rad/s, within which simulated dry friction rises


def friction(drive: Drive, dq: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Return the friction of the other law [N m]."""
    stribeck = 1 + (STRIBECK_RATIO - 1) * np.exp(-np.abs(dq) / STRIBECK_SPEED)
    return np.asarray(drive.viscous * dq + drive.coulomb * sign * stribeck)


def torque_errors(
    joint: np.ndarray,
    moving: tuple[np.ndarray, np.ndarray, np.ndarray],
    drive: Drive,
    errors: Sequence[float],
) -> dict[float, np.ndarray]:
    """Return the motor torques of planned states for each error of the drives, of the shape of ``joint``."""
    dq, ddq, sign = moving
    terms = drive.armature * ddq + friction(drive, dq, sign)
    return {error: joint + (1 + error) * terms for error in errors}


@dataclass(frozen=True)
class Executed:
    """Largest delivered motor torque over its limit, and largest distance from the plan [rad]."""

    use: float
    error: float


def execute(plans: Plans, robot: Robot, drive: Drive, error: float) -> list[Executed]:
    """Execute every plan on a plant with an error of its drives."""
    return [
        _execute(plans[[index]], robot, drive, error) for index in range(len(plans))
    ]


def _execute(plan: Plans, robot: Robot, drive: Drive, error: float) -> Executed:
    ticks = int(np.ceil(plan.duration[0] / TICK_S)) + 50
    times = np.minimum(TICK_S * np.arange(ticks), plan.duration[0])
    reference = [plan.states_at(np.array([t])) for t in times]
    (q, dq, _), step = (each[0].copy() for each in reference[0]), TICK_S / STEPS
    command, dynamics = _controller(robot, drive), _dynamics(robot, drive, error)
    torque = command(q, dq, reference[0])
    late, use, away = [torque] * DELAY_TICKS, 0.0, 0.0
    for tick, desired in enumerate(reference):
        late.append(command(q, dq, desired))
        wanted = late.pop(0)
        for _ in range(STEPS):
            change = (wanted - torque) * (1 - np.exp(-step / CURRENT_S))
            fastest = drive.torque_limit * step / RISE_S
            torque = torque + np.clip(change, -fastest, fastest)
            dq = dq + step * dynamics(q, dq, torque)
            q = q + step * dq
        use = max(use, float(np.max(np.abs(torque) / drive.torque_limit)))
        away = max(
            away, float(np.max(np.abs(q - reference[min(tick + 1, ticks - 1)][0][0])))
        )
    return Executed(use, away)


def _controller(robot: Robot, drive: Drive) -> Callable[..., np.ndarray]:
    """Return a computed torque with the rotors and the friction of the drives, in the direction of the plan."""
    model = robot.model.copy()
    model.armature = drive.armature
    data = model.createData()

    def command(
        q: np.ndarray, dq: np.ndarray, desired: tuple[np.ndarray, ...]
    ) -> np.ndarray:
        q0, dq0, ddq0 = (each[0] for each in desired)
        ddq = ddq0 + GAIN_RAD_S**2 * (q0 - q) + 2 * GAIN_RAD_S * (dq0 - dq)
        known = drive.viscous * dq0 + drive.coulomb * np.tanh(dq0 / SMOOTH_SPEED)
        return np.asarray(pin.rnea(model, data, q, dq, ddq) + known)

    return command


def _dynamics(robot: Robot, drive: Drive, error: float) -> Callable[..., np.ndarray]:
    """Return the acceleration of the plant for a motor torque."""
    model = robot.model.copy()
    model.armature = (1 + error) * drive.armature
    data = model.createData()

    def acceleration(q: np.ndarray, dq: np.ndarray, torque: np.ndarray) -> np.ndarray:
        lost = (1 + error) * friction(drive, dq, np.tanh(dq / SMOOTH_SPEED))
        return np.asarray(pin.aba(model, data, q, dq, torque - lost))

    return acceleration
