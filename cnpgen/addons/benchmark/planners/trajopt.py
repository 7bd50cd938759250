"""TrajOpt as the paper's authors ran it: direct collocation by SciPy's SLSQP ('cnpgen docs benchmark').

The program has 15 knots and explicit Euler steps of ``T / 15`` between them. SLSQP
minimizes T in at most 100 iterations. The initial guess is a cubic whose derivatives
are not scaled by T. The knots are sent with a spacing of ``T / 14``, so the sent motion
is slower than the optimized one by a fifteenth. Both are as in the authors' version.
Pinocchio computes the derivatives of the constraints at the knots.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

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
    depth,
    distance,
    require_table_or_transport,
)
from cnpgen.addons.benchmark.simulator.tip import Tip
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.robots.shape.hull import CUBE
from cnpgen.schema.keys import field
from cnpgen.trajectory.boundary import Boundary

KNOTS = 15
MIN_DURATION_S = 0.1
MAX_HEIGHT_ERROR_M = 0.01
MIN_CENTER_DISTANCE_M = 0.15  # of the object from the obstacles

KnotConstraints = Callable[
    [Array, Array, Array], tuple[Array, tuple[Array, Array, Array]]
]
"""Function of positions, velocities and accelerations at K knots, shape (K, n) each. It returns values that must not be
negative, shape (K, m), and their three derivatives, shape (K, m, n) each."""


@dataclass(frozen=True)
class TrajOpt(BenchmarkPlanner):
    """Sequential quadratic programming over knots (SciPy's SLSQP), as the paper's authors ran it."""

    iterations: int = field("largest number of iterations of SLSQP", default=100, low=1)

    def prepare(self, setting: Setting) -> Plan:
        """Choose the constraints at the knots."""
        problem, robot = open_problem(setting.problem)
        require_rigid_torque("trajopt", problem, robot)
        require_table_or_transport(problem)

        def plan(task: Plans) -> Answer:
            at_knots = knot_constraints(problem, robot, task.scene)
            return TrajOptTranscription(robot, task.boundary, at_knots).solve(
                self.iterations
            )

        return plan


class TrajOptTranscription:
    """One boundary problem as a nonlinear program.

    Its variables are positions, velocities and accelerations at the knots where these
    are free, and T, in this order: ``x = (q_1 .. q_13, dq_1 .. dq_13, ddq, T)``.
    Accelerations are free at all knots if the motion must not end at rest; else those
    at both ends are 0. ``at_knots`` are the constraints at the inner knots.
    """

    def __init__(
        self, robot: Robot, boundary: Boundary, at_knots: KnotConstraints
    ) -> None:
        self._robot = robot
        self._boundary = boundary
        self._at_knots = at_knots
        inner = KNOTS - 2
        moving = bool(np.any(boundary.goal_dq))
        self._free_ddq = slice(0, KNOTS) if moving else slice(1, KNOTS - 1)
        accelerations = self._free_ddq.stop - self._free_ddq.start
        counts = np.array([inner, inner, accelerations]) * robot.n
        self._ends = np.cumsum(counts)
        self._size = int(self._ends[-1]) + 1

    def solve(self, iterations: int = 100) -> Trajectory | None:
        """Minimize T and return the knots; None if they are not finite."""
        from scipy.optimize import Bounds, minimize

        low, high = self.bounds()
        gradient = np.zeros(self._size)
        gradient[-1] = 1.0
        constraints = [
            {"type": "eq", "fun": self.defects, "jac": self.defects_jacobian},
            {"type": "ineq", "fun": self.margins, "jac": self.margins_jacobian},
        ]
        solution = minimize(
            lambda x: x[-1],
            np.clip(self.start(), low, high),
            jac=lambda _: gradient,
            method="SLSQP",
            bounds=Bounds(low, high),
            constraints=constraints,
            options={"maxiter": iterations},
        )
        if not np.isfinite(solution.x).all():
            return None
        q, dq, ddq, duration = self.unpack(solution.x)
        return Trajectory(np.linspace(0, duration, KNOTS), q, dq, ddq)

    def unpack(self, x: Array) -> tuple[Array, Array, Array, float]:
        """Return positions, velocities and accelerations at all knots, shape (KNOTS, n) each, and T."""
        n = self._robot.n
        b = self._boundary
        q, dq, free = (part.reshape(-1, n) for part in np.split(x[:-1], self._ends[:2]))
        ddq = np.zeros((KNOTS, n))
        ddq[self._free_ddq] = free
        return (
            np.vstack([b.start_q, q, b.goal_q]),
            np.vstack([b.start_dq, dq, b.goal_dq]),
            ddq,
            float(x[-1]),
        )

    def start(self) -> Array:
        """Return the initial guess, a cubic.

        Its derivatives are those in its parameter.
        """
        b = self._boundary
        # Cubic sum_i a_i (1 - s)^(3 - i) s^i with q and dq of both ends, as if T were
        # 1.
        a = np.vstack(
            [b.start_q, b.start_dq + 3 * b.start_q, 3 * b.goal_q - b.goal_dq, b.goal_q]
        )
        s = np.linspace(0, 1, KNOTS)
        shape = np.polynomial.Polynomial
        up = shape([0, 1])
        down = shape([1, -1])
        basis = [down**3, down**2 * up, down * up**2, up**3]
        q, dq, ddq = (
            np.array([polynomial.deriv(order)(s) for polynomial in basis]).T @ a
            for order in range(3)
        )
        robot = self._robot
        # A duration T divides dq by T and ddq by T^2: the least T that meets both
        # limits.
        time = (
            np.max(np.abs(dq) / robot.velocity_limit),
            np.sqrt(np.max(np.abs(ddq) / robot.acceleration_limit)),
        )
        parts = [
            q[1:-1].ravel(),
            dq[1:-1].ravel(),
            ddq[self._free_ddq].ravel(),
            np.array([max(time)]),
        ]
        return np.concatenate(parts)

    def bounds(self) -> tuple[Array, Array]:
        """Return the lower and upper bounds of the variables."""
        robot = self._robot
        inner = KNOTS - 2
        free = self._free_ddq.stop - self._free_ddq.start
        high = [
            np.tile(robot.position_upper, inner),
            np.tile(robot.velocity_limit, inner),
        ]
        low = [np.tile(robot.position_lower, inner), -high[1]]
        acceleration = np.tile(robot.acceleration_limit, free)
        return (
            np.concatenate([*low, -acceleration, [MIN_DURATION_S]]),
            np.concatenate([*high, acceleration, [np.inf]]),
        )

    def _inner(self, x: Array) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations at the inner knots."""
        q, dq, ddq, _ = self.unpack(x)
        return q[1:-1], dq[1:-1], ddq[1:-1]

    def defects(self, x: Array) -> Array:
        """Return the defects of explicit Euler steps between knots, shape (2 (KNOTS - 1) n,)."""
        q, dq, ddq, duration = self.unpack(x)
        # Steps are T / 15 over 14 intervals, as in the authors' version.
        step = duration / KNOTS
        return np.concatenate(
            [
                (np.diff(q, axis=0) - step * dq[:-1]).ravel(),
                (np.diff(dq, axis=0) - step * ddq[:-1]).ravel(),
            ]
        )

    def defects_jacobian(self, x: Array) -> Array:
        """Return the derivative of ``defects``."""
        n = self._robot.n
        inner = KNOTS - 2
        _, dq, ddq, duration = self.unpack(x)
        step = duration / KNOTS
        rows = (KNOTS - 1) * n
        # Of consecutive knots, in the inner ones.
        differences = np.eye(KNOTS)[1:, 1:-1] - np.eye(KNOTS)[:-1, 1:-1]
        selection = np.eye(KNOTS)[:-1]
        unit = np.eye(n)
        J = np.zeros((2 * rows, self._size))
        first = slice(0, inner * n)
        second = slice(inner * n, 2 * inner * n)
        J[:rows, first] = np.kron(differences, unit)
        # Defects q_k+1 - q_k - h dq_k have the derivatives +1, -1 and -h.
        J[:rows, second] = -step * np.kron(selection[:, 1:-1], unit)
        J[rows:, second] = np.kron(differences, unit)
        J[rows:, second.stop : -1] = -step * np.kron(selection[:, self._free_ddq], unit)
        J[:rows, -1] = -dq[:-1].ravel() / KNOTS
        J[rows:, -1] = -ddq[:-1].ravel() / KNOTS
        return J

    def margins(self, x: Array) -> Array:
        """Return the constraints at the inner knots, nonnegative if satisfied."""
        return np.asarray(self._at_knots(*self._inner(x))[0].ravel())

    def margins_jacobian(self, x: Array) -> Array:
        """Return the derivative of ``margins``."""
        n = self._robot.n
        inner = KNOTS - 2
        g, derivatives = self._at_knots(*self._inner(x))
        rows = g.shape[1]
        J = np.zeros((inner, rows, self._size))
        # If accelerations at both ends are free, too, those of inner knots follow the
        # first one.
        offset = 1 - self._free_ddq.start
        starts = 0, inner * n, 2 * inner * n + offset * n
        for derivative, start in zip(derivatives, starts, strict=True):
            for knot in range(inner):
                J[knot, :, start + knot * n : start + (knot + 1) * n] = derivative[knot]
        return J.reshape(inner * rows, self._size)


def knot_constraints(problem: Problem, robot: Robot, scene: Scene) -> KnotConstraints:
    """Return the constraints of a boundary problem: of a hit, or of a transport.

    See ``require_table_or_transport``.
    """
    table = problem.first(Table)
    if table is not None:
        return _on_table(table, robot)
    return _with_object(robot, *boxes_of(problem, scene))


def _on_table(table: Table, robot: Robot) -> KnotConstraints:
    """Bound the tip: over the table and at most 1 cm from its height.

    |y| and |z| are two inequalities each.
    """
    # Rows are x, y, -y, z and -z of the tip.
    signs = np.array([[1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    bound = np.array(
        [
            -table.x.low,
            -table.y.low,
            table.y.high,
            MAX_HEIGHT_ERROR_M - table.z,
            MAX_HEIGHT_ERROR_M + table.z,
        ]
    )
    tip = Tip(robot)

    def at(
        q: Array, _dq: Array, _ddq: Array
    ) -> tuple[Array, tuple[Array, Array, Array]]:
        poses = [tip.at(position) for position in q]
        g = np.array([signs @ position + bound for position, _, _ in poses])
        J = np.array([signs @ jacobian[:3] for _, _, jacobian in poses])
        return g, (J, np.zeros_like(J), np.zeros_like(J))

    return at


def _with_object(robot: Robot, size: Array, boxes: list[Box]) -> KnotConstraints:
    """Constrain the object: upright, centre away from the boxes, corners outside.

    Torques within limits.
    """
    import pinocchio as pin

    model = robot.model
    data = robot.model.createData()
    limit = robot.torque_limit
    tip = Tip(robot)

    def knot(q: Array, dq: Array, ddq: Array) -> tuple[Array, Array, Array, Array]:
        values, gradient = _object_values(tip, q, size, boxes)
        pin.computeRNEADerivatives(model, data, q, dq, ddq)
        # Pinocchio fills the upper half of the symmetric M only.
        inertia = np.triu(data.M) + np.triu(data.M, 1).T
        torque = np.array(data.tau)
        g = np.concatenate([values, limit - torque, limit + torque])
        rows = [
            (gradient, data.dtau_dq),
            (np.zeros_like(gradient), data.dtau_dv),
            (np.zeros_like(gradient), inertia),
        ]
        of_q, of_dq, of_ddq = (
            np.vstack([first, -torques, torques]) for first, torques in rows
        )
        return g, of_q, of_dq, of_ddq

    def at(q: Array, dq: Array, ddq: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        g, a, b, c = (
            np.array(part) for part in zip(*map(knot, q, dq, ddq), strict=True)
        )
        return g, (a, b, c)

    return at


def _object_values(
    tip: Tip, q: Array, size: Array, boxes: list[Box]
) -> tuple[list[float], Array]:
    """Return the values of the constraints of the object at q [rad], and their gradients, shape (m, n)."""
    position, rotation, J = tip.at(q)
    turning = J[3:]
    # With dR/dt = w x R, the gradient of R_22 has the z components of w_j x (R e_z).
    values = [rotation[2, 2] - 1.0]
    gradients = [np.cross(turning.T, rotation[:, 2])[:, 2]]
    for box in boxes:
        separation, normal = distance(position, box)
        values.append(min(separation - MIN_CENTER_DISTANCE_M, 0.0))
        gradients.append(normal @ J[:3] * (separation < MIN_CENTER_DISTANCE_M))
        for corner in (CUBE * size) @ rotation.T:
            penetration, normal = depth(position + corner, box)
            values.append(-penetration)
            # A corner at r from the tip moves with v + w x r.
            gradients.append(-normal @ (J[:3] + np.cross(turning.T, corner).T))
    return values, np.array(gradients)
