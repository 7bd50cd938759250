"""A planner package: differential dynamic programming of Crocoddyl (Mastalli et al., 2020), with penalties.

BoxFDDP bounds the torques. Quadratic barriers penalize joint positions, velocities and accelerations outside their limits,
and quadratic costs the manifold, the obstacles and the goal. The duration is fixed in such a program, so the planner tries
increasing durations until the violations are small.

The package that holds this module registers the planner in its pyproject.toml:

    [project]
    name = "cnpgen-crocoddyl"
    version = "1.0"
    dependencies = ["cnpgen", "crocoddyl>=3.2.1,<3.3", "pin==4.0.*"]

    [project.entry-points."cnpgen.planners"]
    crocoddyl = "crocoddyl_planner:Crocoddyl"

The wheels of Crocoddyl 3.2 need Pinocchio 4.0, so it needs an environment of its own.
"""

from __future__ import annotations

import importlib.metadata
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.addons.benchmark.benchmark_planner import (
    Answer,
    BenchmarkPlanner,
    Plan,
    Setting,
    require_rigid_torque,
)
from cnpgen.addons.benchmark.planners.obstacle_boxes import (
    Box,
    boxes_of,
    require_table_or_transport,
)
from cnpgen.addons.benchmark.simulator.tip import Tip
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.errors import MachineError
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.hull import CUBE
from cnpgen.schema.keys import field
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]

MIN_CENTER_DISTANCE_M = 0.15  # of the object from the obstacles
MIN_DURATION_S, MAX_DURATION_S = 0.05, 10.0
MAX_LIMIT_USE = 1.01  # of velocities and accelerations
# The answer ends at the goal exactly.
MAX_GOAL_ERROR_RAD, MAX_GOAL_ERROR_RAD_S = 2e-5, 1e-3
MAX_PENALIZED_VIOLATION = 1e-3  # of the height [m], and of tilt and obstacles
PINOCCHIO = {
    "3.2": "4.0"
}  # version of Crocoddyl -> that of Pinocchio, whose binary interface its wheels need
TORQUE_WEIGHT, ACCELERATION_WEIGHT = 1e-6, 1e-4
LIMIT_WEIGHT = 1e3  # of positions, velocities and accelerations outside their limits
# Of velocities and accelerations, because penalties are violated a little.
LIMIT_FRACTION = 0.98
MANIFOLD_WEIGHT, OBSTACLE_WEIGHT = 1e6, 1e5
END_ACCELERATION_WEIGHT, GOAL_WEIGHT = 1e3, 1e6
FACE_NORMALS = np.vstack(
    [np.eye(3), -np.eye(3)]
)  # of the lower and the upper faces, inwards


@dataclass(frozen=True)
class Crocoddyl(BenchmarkPlanner):
    """BoxFDDP: torques within bounds, other limits as penalties, increasing durations (Crocoddyl)."""

    nodes: int = field("number of spans of constant torque", default=50, low=5)
    iterations: int = field(
        "largest number of iterations per duration", default=50, low=1
    )
    growth: float = field("ratio of successive durations", default=1.1, low=1.001)

    def prepare(self, setting: Setting) -> Plan:
        """Import Crocoddyl and check the kind of problem."""
        load_crocoddyl()
        problem, robot = open_problem(setting.problem)
        require_rigid_torque("crocoddyl", problem, robot)
        require_table_or_transport(problem)

        def plan(task: Plans) -> Answer:
            deadline = time.perf_counter() + setting.time_limit
            return self._plan(
                ShootingCosts(problem, robot, task), robot, task.boundary, deadline
            )

        return plan

    def _plan(
        self, costs: ShootingCosts, robot: Robot, boundary: Boundary, deadline: float
    ) -> Trajectory | None:
        """Return the first motion with small violations, or None if none is found in time."""
        duration = min_duration(robot, boundary)
        while duration < MAX_DURATION_S and time.perf_counter() < deadline:
            t = np.linspace(0.0, duration, self.nodes + 1)
            solver = costs.solver(duration / self.nodes, self.nodes)
            guess = cubic_states(boundary, t)
            torques = solver.problem.quasiStatic(guess[:-1])
            solver.solve(guess, torques, self.iterations, False)
            states = np.array(solver.xs.tolist())
            if (
                are_small(robot, boundary, t, states)
                and costs.residual(states) <= MAX_PENALIZED_VIOLATION
            ):
                states[-1] = np.append(boundary.goal_q[0], boundary.goal_dq[0])
                return Trajectory(t, states[:, : robot.n], states[:, robot.n :])
            duration *= self.growth
        return None


def min_duration(robot: Robot, boundary: Boundary) -> float:
    """Return a duration that no motion within the limits of velocity and acceleration can undercut [s]."""
    distance = np.abs(boundary.goal_q[0] - boundary.start_q[0])
    change = np.abs(boundary.goal_dq[0] - boundary.start_dq[0])
    times = distance / robot.velocity_limit, change / robot.acceleration_limit
    return max(float(np.max(times)), MIN_DURATION_S)


def cubic_states(boundary: Boundary, t: Array) -> list[Array]:
    """Return positions and velocities of the cubic between both ends at K times, a list of arrays of shape (2 n,)."""
    b = boundary
    cubic = Trajectory(
        t[[0, -1]], np.vstack([b.start_q, b.goal_q]), np.vstack([b.start_dq, b.goal_dq])
    )
    q, dq, _ = cubic.states(t)
    return list(np.hstack([q, dq]))


def are_small(robot: Robot, boundary: Boundary, t: Array, states: Array) -> bool:
    """Return whether a motion meets its goal and exceeds its limits of velocity and acceleration by 1 % at most.

    States at the times t [s] of shape (K,) are positions and velocities, shape (K, 2
    n).
    """
    q, dq = np.split(states, 2, axis=1)
    use = (
        np.abs(dq) / robot.velocity_limit,
        np.abs(np.diff(dq, axis=0) / t[1]) / robot.acceleration_limit,
    )
    errors = (
        np.abs(q[-1] - boundary.goal_q[0]).max(),
        np.abs(dq[-1] - boundary.goal_dq[0]).max(),
    )
    at_goal = errors[0] <= MAX_GOAL_ERROR_RAD and errors[1] <= MAX_GOAL_ERROR_RAD_S
    return bool(at_goal and max(part.max() for part in use) <= MAX_LIMIT_USE)


def load_crocoddyl() -> Any:
    """Import Crocoddyl.

    Raise MachineError if its version is unknown, or its wheel is for another version of
    Pinocchio, with which it would read wrong memory.
    """
    import pinocchio

    try:
        number = importlib.metadata.version("crocoddyl")
    except importlib.metadata.PackageNotFoundError as error:
        raise MachineError("Crocoddyl is missing: pip install crocoddyl") from error
    needed = PINOCCHIO.get(".".join(number.split(".")[:2]))
    if needed is None:
        known = ", ".join(
            f"{version}.* with Pinocchio {other}.*"
            for version, other in PINOCCHIO.items()
        )
        raise MachineError(f"Crocoddyl must be {known}, installed is {number}")
    if not pinocchio.__version__.startswith(f"{needed}."):
        raise MachineError(
            f"Crocoddyl {number} needs Pinocchio {needed},"
            f" installed is {pinocchio.__version__}"
        )
    import crocoddyl

    return crocoddyl


class ShootingCosts:
    """Costs of one boundary problem on a table, or of a transport among upright boxes."""

    def __init__(self, problem: Problem, robot: Robot, task: Plans) -> None:
        self._package, self._robot, self._boundary = (
            load_crocoddyl(),
            robot,
            task.boundary,
        )
        self._state = self._package.StateMultibody(robot.model)
        self._actuation = self._package.ActuationModelFull(self._state)
        self._table, self._tip = problem.first(Table), Tip(robot)
        self._object = (
            None
            if self._table is not None
            else ObjectViolation(robot, *boxes_of(problem, task.scene))
        )

    def solver(self, period: float, nodes: int) -> Any:
        """Return BoxFDDP on spans of constant torque of a duration [s]."""
        package, boundary = self._package, self._boundary
        at_rest = not np.any(boundary.goal_dq)
        first = self._action(period, boundary.start_ddq[0])
        inner = self._action(period)
        last = self._action(period, np.zeros(self._robot.n)) if at_rest else inner
        start = np.concatenate([boundary.start_q[0], boundary.start_dq[0]])
        actions = [first, *[inner] * (nodes - 2), last]
        return package.SolverBoxFDDP(
            package.ShootingProblem(start, actions, self._final())
        )

    def residual(self, states: Array) -> float:
        """Return the largest violation of manifold and obstacles at K states of shape (K, 2 n) [m or 1]."""
        worst = 0.0
        for q in states[:, : self._robot.n]:
            position, rotation, _ = self._tip.at(q)
            if self._table is not None:
                worst = max(worst, abs(position[2] - self._table.z))
            else:
                assert self._object is not None
                worst = max(
                    worst,
                    float(np.hypot(*rotation[:2, 2])),
                    float(self._object.values(q).max()),
                )
        return worst

    def _action(self, period: float, acceleration: Array | None = None) -> Any:
        """Return the model of a span, with or without a desired acceleration, by Runge and Kutta's method."""
        package, robot, costs = self._package, self._robot, self._costs()
        controls = package.ResidualModelControlGrav(self._state)
        accelerations = package.ResidualModelJointAcceleration(
            self._state, np.zeros(robot.n)
        )
        self._add(costs, "torque", controls, TORQUE_WEIGHT)
        self._add(costs, "acceleration", accelerations, ACCELERATION_WEIGHT)
        limit = LIMIT_FRACTION * robot.acceleration_limit
        self._add(
            costs,
            "acceleration limit",
            accelerations,
            LIMIT_WEIGHT,
            self._barrier(-limit, limit),
        )
        if acceleration is not None:
            desired = package.ResidualModelJointAcceleration(self._state, acceleration)
            self._add(costs, "end acceleration", desired, END_ACCELERATION_WEIGHT)
        dynamics = package.DifferentialActionModelFreeFwdDynamics(
            self._state, self._actuation, costs
        )
        action = package.IntegratedActionModelRK(dynamics, package.RKType.four, period)
        action.u_lb, action.u_ub = -robot.torque_limit, robot.torque_limit
        return action

    def _final(self) -> Any:
        """Return the model of the end, with the goal."""
        package, costs = self._package, self._costs()
        goal = np.concatenate([self._boundary.goal_q[0], self._boundary.goal_dq[0]])
        self._add(
            costs, "goal", package.ResidualModelState(self._state, goal), GOAL_WEIGHT
        )
        dynamics = package.DifferentialActionModelFreeFwdDynamics(
            self._state, self._actuation, costs
        )
        return package.IntegratedActionModelEuler(dynamics, 0.0)

    def _costs(self) -> Any:
        """Return the costs of a state: limits, and the table or the object."""
        package, robot, state = self._package, self._robot, self._state
        costs, speed = (
            package.CostModelSum(state),
            LIMIT_FRACTION * robot.velocity_limit,
        )
        low, high = (
            np.append(robot.position_lower, -speed),
            np.append(robot.position_upper, speed),
        )
        states = package.ResidualModelState(state, np.zeros(2 * robot.n))
        self._add(costs, "state limits", states, LIMIT_WEIGHT, self._barrier(low, high))
        if self._table is not None:
            table, weighted = self._table, package.ActivationModelWeightedQuad
            tip = package.ResidualModelFrameTranslation(
                state, robot.tip_frame, np.array([0.0, 0.0, table.z])
            )
            self._add(
                costs,
                "height",
                tip,
                MANIFOLD_WEIGHT,
                weighted(np.array([0.0, 0.0, 1.0])),
            )
            low, high = (
                np.array([table.x.low, table.y.low, -np.inf]),
                np.array([table.x.high, table.y.high, np.inf]),
            )
            self._add(costs, "table", tip, MANIFOLD_WEIGHT, self._barrier(low, high))
            return costs
        upright = package.ResidualModelFrameRotation(state, robot.tip_frame, np.eye(3))
        tilts = package.ActivationModelWeightedQuad(np.array([1.0, 1.0, 0.0]))
        self._add(costs, "tilt", upright, MANIFOLD_WEIGHT, tilts)
        assert self._object is not None
        self._add(
            costs,
            "obstacles",
            _residual_model(package, state, self._object),
            OBSTACLE_WEIGHT,
        )
        return costs

    def _add(
        self,
        costs: Any,
        name: str,
        residual: Any,
        weight: float,
        activation: Any = None,
    ) -> None:
        """Add a cost, quadratic without an activation."""
        package = self._package
        activation = (
            package.ActivationModelQuad(residual.nr)
            if activation is None
            else activation
        )
        costs.addCost(
            name, package.CostModelResidual(self._state, activation, residual), weight
        )

    def _barrier(self, low: Array, high: Array) -> Any:
        return self._package.ActivationModelQuadraticBarrier(
            self._package.ActivationBounds(low, high)
        )


class ObjectViolation:
    """Missing distance of a held object's centre from B boxes [m], and depths of its corners in them [m]."""

    def __init__(self, robot: Robot, size: Array, boxes: list[Box]) -> None:
        self._tip, self._corners = Tip(robot), CUBE * size
        self._low, self._high = (
            np.array(corners)[:, None] for corners in zip(*boxes, strict=True)
        )
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
        turns = (
            arms[:, [1, 2, 0]] * normals[:, [2, 0, 1]]
            - arms[:, [2, 0, 1]] * normals[:, [1, 2, 0]]
        )
        return np.asarray((normals @ J[:3] + turns @ J[3:]) * (values > 0)[:, None])

    def _violations(
        self, position: Array, rotation: Array
    ) -> tuple[Array, Array, Array]:
        """Return the violations, their directions, and the violating points relative to the tip, in world axes."""
        offset = position - np.clip(position, self._low[:, 0], self._high[:, 0])
        separation = np.sqrt(np.einsum("ij,ij->i", offset, offset))
        missing = np.maximum(MIN_CENTER_DISTANCE_M - separation, 0.0)
        corners = self._corners @ rotation.T
        faces = np.concatenate(
            [position + corners - self._low, self._high - position - corners], axis=2
        )
        faces = faces.reshape(-1, 6)
        nearest = np.argmin(faces, axis=1)
        depth = np.maximum(faces[np.arange(len(faces)), nearest], 0.0)
        directions = -offset / np.maximum(separation, np.finfo(float).tiny)[:, None]
        arms = np.concatenate(
            [np.zeros_like(offset), np.tile(corners, (len(offset), 1))]
        )
        return (
            np.append(missing, depth),
            np.concatenate([directions, FACE_NORMALS[nearest]]),
            arms,
        )


def _residual_model(package: Any, state: Any, violation: ObjectViolation) -> Any:
    """Wrap violations for Crocoddyl."""
    n = state.nq

    class Violation(package.ResidualModelAbstract):
        def __init__(self) -> None:
            super().__init__(state, violation.size, n, True, False, False)

        def calc(self, data: Any, x: Any, _u: Any = None) -> None:
            data.r[:] = violation.values(np.array(x[:n]))

        def calcDiff(self, data: Any, x: Any, _u: Any = None) -> None:
            data.Rx[:, :n] = violation.derivatives(np.array(x[:n]))

    return Violation()
