"""Boundary states moved onto the constraints of a problem by the smallest change."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.continuous_collision import is_contact
from cnpgen.problems.constraints.constraint import End
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.world.world import World

Array = NDArray[np.float64]
State = tuple[Array, Array, Array]

MAX_ITERATIONS = 12
DIFFERENCE = 1e-6  # of central differences, in units of the scaled state
BOUND_INSET = 1e-6  # distance from a violated bound, relative to its range, at which a state is placed
MAX_RESIDUAL = 1e-10  # at which the iteration ends
SCALES = (1.0, 100.0, 1e5)  # a change of 1 mrad counts as much as one of 0.1 rad/s, or of 100 rad/s^2


class StateSnapper:
    """Moves boundary states onto the constraints of a problem by Gauss-Newton steps of minimum norm.

    Distances between bodies are not considered.
    """

    def __init__(self, problem: Problem, robot: Robot) -> None:
        self._constraints = [constraint for constraint in problem.constraint if not is_contact(constraint)]
        self._world = World(robot, problem.obstacle, problem.object_size)
        self._problem = problem
        self.set_parameters(None)
        self._scale = np.repeat(SCALES, robot.n)

    def set_parameters(self, parameters: Array | None) -> None:
        """Set the values of the problem's parameters, shape (p,); nominal for None."""
        rows = None if parameters is None else parameters[None]
        nowhere = np.zeros((1, 3))
        self._poses = scene_of(self._problem, nowhere, nowhere, nowhere, rows).poses[0]

    def __call__(self, state: State, end: End) -> State:
        """Move a state at an end, or return the last one that was reached if the constraints cannot be met."""
        x = np.concatenate(state) / self._scale
        for _ in range(MAX_ITERATIONS):
            g, lower, upper = self._values(x, end)
            inset = BOUND_INSET * np.where(np.isfinite(upper - lower), upper - lower, 1.0)
            residual = np.where(g < lower, g - lower - inset, np.where(g > upper, g - upper + inset, 0.0))
            rows = np.flatnonzero(np.abs(residual) > MAX_RESIDUAL)
            if not len(rows) or not np.isfinite(g).all():
                break
            steps = DIFFERENCE * np.eye(len(x))
            changes = [self._values(x + step, end)[0][rows] - self._values(x - step, end)[0][rows] for step in steps]
            jacobian = np.stack(changes, axis=1) / (2 * DIFFERENCE)
            x = x - np.linalg.lstsq(jacobian, residual[rows], rcond=1e-8)[0]
        q, dq, ddq = np.split(x * self._scale, 3)
        return q, dq, ddq

    def _values(self, x: Array, end: End) -> tuple[Array, Array, Array]:
        """Return the values and both bounds of all conditions, shape (m,) each."""
        q, dq, ddq = np.split(x * self._scale, 3)
        self._world.set_state(q, dq, ddq, self._poses)
        conditions = [condition for part in self._constraints for condition in part.measured_at(self._world, end)]
        values = [np.array(condition.g, float) for condition in conditions]
        bounds = ([getattr(condition, side) for condition in conditions] for side in ("lower", "upper"))
        lower, upper = (np.concatenate([np.empty(0), *rows]) for rows in bounds)
        return np.concatenate([np.empty(0), *values]), lower, upper
