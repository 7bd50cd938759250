"""Shooting problems of Crocoddyl: torques as controls, limits and constraints as quadratic costs."""

import importlib.metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.planners.knots import MIN_CENTER_DISTANCE_M
from cnpgen.benchmark.planners.obstacle_boxes import Box, boxes_of
from cnpgen.benchmark.simulator.tip import Tip
from cnpgen.errors import MachineError, requires_extra
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.hull import CUBE

Array = NDArray[np.float64]

PINOCCHIO = {"3.2": "4.0"}  # version of Crocoddyl -> that of Pinocchio, whose binary interface its wheels need
TORQUE_WEIGHT, ACCELERATION_WEIGHT = 1e-6, 1e-4
LIMIT_WEIGHT = 1e3  # of positions, velocities and accelerations outside their limits
LIMIT_FRACTION = 0.98  # of velocities and accelerations, because penalties are violated a little
MANIFOLD_WEIGHT, OBSTACLE_WEIGHT = 1e6, 1e5
END_ACCELERATION_WEIGHT, GOAL_WEIGHT = 1e3, 1e6
FACE_NORMALS = np.vstack([np.eye(3), -np.eye(3)])  # of the lower and the upper faces, inwards


def load_crocoddyl() -> Any:
    """Import Crocoddyl.

    Raises:
        MissingExtraError: Crocoddyl is missing.
        MachineError: Its version is unknown, or its wheel is for another version of Pinocchio, with which it would read
            wrong memory.
    """
    import pinocchio

    with requires_extra("crocoddyl", "Crocoddyl"):
        number = importlib.metadata.version("crocoddyl")
        needed = PINOCCHIO.get(".".join(number.split(".")[:2]))
        if needed is None:
            known = ", ".join(f"{version}.* with Pinocchio {other}.*" for version, other in PINOCCHIO.items())
            raise MachineError(
                f"Crocoddyl must be {known}, installed is {number}:"
                " pip install 'cnpgen[crocoddyl]' in another environment"
            )
        if not pinocchio.__version__.startswith(f"{needed}."):
            raise MachineError(
                f"Crocoddyl {number} needs Pinocchio {needed}, installed is {pinocchio.__version__}:"
                " pip install 'cnpgen[crocoddyl]' in another environment"
            )
        import crocoddyl
    return crocoddyl


class ShootingCosts:
    """Costs of one boundary problem on a table, or of a transport among upright boxes."""

    def __init__(self, problem: Problem, robot: Robot, task: Plans) -> None:
        self._package, self._robot, self._boundary = load_crocoddyl(), robot, task.boundary
        self._state = self._package.StateMultibody(robot.model)
        self._actuation = self._package.ActuationModelFull(self._state)
        self._table, self._tip = problem.first(Table), Tip(robot)
        self._object = None if self._table is not None else ObjectViolation(robot, *boxes_of(problem, task.scene))

    def solver(self, period: float, nodes: int) -> Any:
        """Return BoxFDDP on spans of constant torque.

        Args:
            period: Duration of a span [s].
            nodes: Number of spans.
        """
        package, boundary = self._package, self._boundary
        at_rest = not np.any(boundary.goal_dq)
        first = self._action(period, boundary.start_ddq[0])
        inner = self._action(period)
        last = self._action(period, np.zeros(self._robot.n)) if at_rest else inner
        start = np.concatenate([boundary.start_q[0], boundary.start_dq[0]])
        actions = [first, *[inner] * (nodes - 2), last]
        return package.SolverBoxFDDP(package.ShootingProblem(start, actions, self._final()))

    def residual(self, states: Array) -> float:
        """Return the largest violation of manifold and obstacles at K states of shape (K, 2 n) [m or 1]."""
        worst = 0.0
        for q in states[:, : self._robot.n]:
            position, rotation, _ = self._tip.at(q)
            if self._table is not None:
                worst = max(worst, abs(position[2] - self._table.z))
            else:
                assert self._object is not None
                worst = max(worst, float(np.hypot(*rotation[:2, 2])), float(self._object.values(q).max()))
        return worst

    def _action(self, period: float, acceleration: Array | None = None) -> Any:
        """Return the model of a span, with or without a desired acceleration, by Runge and Kutta's method."""
        package, robot, costs = self._package, self._robot, self._costs()
        controls = package.ResidualModelControlGrav(self._state)
        accelerations = package.ResidualModelJointAcceleration(self._state, np.zeros(robot.n))
        self._add(costs, "torque", controls, TORQUE_WEIGHT)
        self._add(costs, "acceleration", accelerations, ACCELERATION_WEIGHT)
        limit = LIMIT_FRACTION * robot.acceleration_limit
        self._add(costs, "acceleration limit", accelerations, LIMIT_WEIGHT, self._barrier(-limit, limit))
        if acceleration is not None:
            desired = package.ResidualModelJointAcceleration(self._state, acceleration)
            self._add(costs, "end acceleration", desired, END_ACCELERATION_WEIGHT)
        dynamics = package.DifferentialActionModelFreeFwdDynamics(self._state, self._actuation, costs)
        action = package.IntegratedActionModelRK(dynamics, package.RKType.four, period)
        action.u_lb, action.u_ub = -robot.torque_limit, robot.torque_limit
        return action

    def _final(self) -> Any:
        """Return the model of the end, with the goal."""
        package, costs = self._package, self._costs()
        goal = np.concatenate([self._boundary.goal_q[0], self._boundary.goal_dq[0]])
        self._add(costs, "goal", package.ResidualModelState(self._state, goal), GOAL_WEIGHT)
        dynamics = package.DifferentialActionModelFreeFwdDynamics(self._state, self._actuation, costs)
        return package.IntegratedActionModelEuler(dynamics, 0.0)

    def _costs(self) -> Any:
        """Return the costs of a state: limits, and the table or the object."""
        package, robot, state = self._package, self._robot, self._state
        costs, speed = package.CostModelSum(state), LIMIT_FRACTION * robot.velocity_limit
        low, high = np.append(robot.position_lower, -speed), np.append(robot.position_upper, speed)
        states = package.ResidualModelState(state, np.zeros(2 * robot.n))
        self._add(costs, "state limits", states, LIMIT_WEIGHT, self._barrier(low, high))
        if self._table is not None:
            table, weighted = self._table, package.ActivationModelWeightedQuad
            tip = package.ResidualModelFrameTranslation(state, robot.tip_frame, np.array([0.0, 0.0, table.z]))
            self._add(costs, "height", tip, MANIFOLD_WEIGHT, weighted(np.array([0.0, 0.0, 1.0])))
            low, high = np.array([table.x.low, table.y.low, -np.inf]), np.array([table.x.high, table.y.high, np.inf])
            self._add(costs, "table", tip, MANIFOLD_WEIGHT, self._barrier(low, high))
            return costs
        upright = package.ResidualModelFrameRotation(state, robot.tip_frame, np.eye(3))
        tilts = package.ActivationModelWeightedQuad(np.array([1.0, 1.0, 0.0]))
        self._add(costs, "tilt", upright, MANIFOLD_WEIGHT, tilts)
        assert self._object is not None
        self._add(costs, "obstacles", _residual_model(package, state, self._object), OBSTACLE_WEIGHT)
        return costs

    def _add(self, costs: Any, name: str, residual: Any, weight: float, activation: Any = None) -> None:
        """Add a cost, quadratic without an activation."""
        package = self._package
        activation = package.ActivationModelQuad(residual.nr) if activation is None else activation
        costs.addCost(name, package.CostModelResidual(self._state, activation, residual), weight)

    def _barrier(self, low: Array, high: Array) -> Any:
        return self._package.ActivationModelQuadraticBarrier(self._package.ActivationBounds(low, high))


class ObjectViolation:
    """Missing distance of a held object's centre from the boxes [m], and depths of its corners in them [m].

    Args:
        robot: The robot.
        size: Edge lengths of the object [m], shape (3,).
        boxes: The B obstacles.
    """

    def __init__(self, robot: Robot, size: Array, boxes: list[Box]) -> None:
        self._tip, self._corners = Tip(robot), CUBE * size
        self._low, self._high = (np.array(corners)[:, None] for corners in zip(*boxes, strict=True))
        self.size = len(boxes) * (1 + len(CUBE))

    def values(self, q: Array) -> Array:
        """Return the violations at q, not negative, shape (9 B,): the distances, then the depths."""
        position, rotation, _ = self._tip.at(q)
        return self._violations(position, rotation)[0]

    def derivatives(self, q: Array) -> Array:
        """Return the derivatives of ``values``, shape (9 B, n)."""
        position, rotation, J = self._tip.at(q)
        values, normals, arms = self._violations(position, rotation)
        if not values.any():
            return np.zeros((self.size, J.shape[1]))
        turns = arms[:, [1, 2, 0]] * normals[:, [2, 0, 1]] - arms[:, [2, 0, 1]] * normals[:, [1, 2, 0]]
        return np.asarray((normals @ J[:3] + turns @ J[3:]) * (values > 0)[:, None])

    def _violations(self, position: Array, rotation: Array) -> tuple[Array, Array, Array]:
        """Return the violations, their directions, and the violating points relative to the tip, in world axes."""
        offset = position - np.clip(position, self._low[:, 0], self._high[:, 0])
        separation = np.sqrt(np.einsum("ij,ij->i", offset, offset))
        missing = np.maximum(MIN_CENTER_DISTANCE_M - separation, 0.0)
        corners = self._corners @ rotation.T
        faces = np.concatenate([position + corners - self._low, self._high - position - corners], axis=2)
        faces = faces.reshape(-1, 6)
        nearest = np.argmin(faces, axis=1)
        depth = np.maximum(faces[np.arange(len(faces)), nearest], 0.0)
        directions = -offset / np.maximum(separation, np.finfo(float).tiny)[:, None]
        arms = np.concatenate([np.zeros_like(offset), np.tile(corners, (len(offset), 1))])
        return np.append(missing, depth), np.concatenate([directions, FACE_NORMALS[nearest]]), arms


def _residual_model(package: Any, state: Any, violation: ObjectViolation) -> Any:
    """Wrap violations for Crocoddyl."""
    n = state.nq

    class Violation(package.ResidualModelAbstract):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(state, violation.size, n, True, False, False)

        def calc(self, data: Any, x: Any, _u: Any = None) -> None:
            data.r[:] = violation.values(np.array(x[:n]))

        def calcDiff(self, data: Any, x: Any, _u: Any = None) -> None:  # noqa: N802 - a method of Crocoddyl
            data.Rx[:, :n] = violation.derivatives(np.array(x[:n]))

    return Violation()
