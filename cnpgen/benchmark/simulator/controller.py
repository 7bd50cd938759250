"""Controller: inverse dynamics of the URDF's robot (computed torque) with feedback of the error."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.simulator.plant import Plant, rated_torque
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

GAIN_RAD_S = 80.0  # natural frequency of the closed loop; an error decays within about 1/80 s


class Controller:
    """Computed torque, within the rated torques: ``M(q) (ddq* + w^2 (q* - q) + 2 w (dq* - dq)) + h(q, dq)``.

    w is ``GAIN_RAD_S``. If a torque would exceed its limit, the acceleration is scaled down in its direction, and the
    holding torque keeps priority. The controller models no friction, no damping and no other deviation of a plant.

    Args:
        problem: The problem, which defines the rated torques.
        robot: Nominal robot.
        plant: The simulated robot, for its delay.

    Attributes:
        limit: The rated torques [N m], shape (n,).
    """

    def __init__(self, problem: Problem, robot: Robot, plant: Plant) -> None:
        self._model = robot.model
        self._data = robot.model.createData()
        self.limit = rated_torque(problem, robot)
        self._delay = plant.delay
        self._delayed: deque[Array] = deque()

    def __call__(self, q: Array, dq: Array, desired: tuple[Array, Array, Array]) -> Array:
        """Compute the torque that takes effect now [N m], shape (n,).

        Args:
            q: Measured positions [rad], shape (n,).
            dq: Measured velocities [rad/s], shape (n,).
            desired: Positions, velocities and accelerations to follow.
        """
        import pinocchio as pin

        acceleration = desired[2] + GAIN_RAD_S**2 * (desired[0] - q) + 2 * GAIN_RAD_S * (desired[1] - dq)
        holding_torque = np.clip(pin.rnea(self._model, self._data, q, dq, np.zeros_like(q)), -self.limit, self.limit)
        acceleration_torque = pin.rnea(self._model, self._data, q, dq, acceleration) - holding_torque
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.nanmin(
                (self.limit - np.sign(acceleration_torque) * holding_torque) / np.abs(acceleration_torque)
            )
        torque = holding_torque + min(scale, 1.0) * acceleration_torque
        self._delayed.extend([torque] * (self._delay + 1 - len(self._delayed)))  # the first tick already holds the arm
        return self._delayed.popleft()
