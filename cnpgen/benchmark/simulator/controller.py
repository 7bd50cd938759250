"""The controller: inverse dynamics of the robot as the URDF has it, and gains on what is left of the error."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.simulator.plant import Plant, rated_torque
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

GAIN = 80.0  # rad/s: where an error that is left alone would be gone after 1/80 s


class Controller:
    """Computed torque, within the rated torques: ``M(q) (ddq* + w^2 (q* - q) + 2 w (dq* - dq)) + h(q, dq)``.

    w is ``GAIN``. Where a torque would be outside its limits, the acceleration is made smaller and keeps its direction:
    what holds the arm up comes first. It knows neither friction nor damping, nor what a plant has besides.

    Args:
        problem: What the torques are rated at.
        robot: The robot as the controller believes it to be.
        plant: The robot as it is: how late torques take effect.

    Attributes:
        limit: The rated torques [N m], shape (n,).
    """

    def __init__(self, problem: Problem, robot: Robot, plant: Plant) -> None:
        self._model = robot.model
        self._data = robot.model.createData()
        self.limit = rated_torque(problem, robot)
        self._delay = plant.delay
        self._waiting: deque[Array] = deque()

    def __call__(self, q: Array, dq: Array, wanted: tuple[Array, Array, Array]) -> Array:
        """Compute the torque that takes effect now [N m], shape (n,).

        Args:
            q: Measured positions [rad], shape (n,).
            dq: Measured velocities [rad/s], shape (n,).
            wanted: Positions, velocities and accelerations to follow.
        """
        import pinocchio as pin

        towards = wanted[2] + GAIN**2 * (wanted[0] - q) + 2 * GAIN * (wanted[1] - dq)
        holding = np.clip(pin.rnea(self._model, self._data, q, dq, np.zeros_like(q)), -self.limit, self.limit)
        pushing = pin.rnea(self._model, self._data, q, dq, towards) - holding
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.nanmin((self.limit - np.sign(pushing) * holding) / np.abs(pushing))
        torque = holding + min(share, 1.0) * pushing
        self._waiting.extend([torque] * (self._delay + 1 - len(self._waiting)))  # at the first tick it holds already
        return self._waiting.popleft()
