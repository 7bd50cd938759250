"""The constraints of TrajOpt at its knots, with Pinocchio and by their analytic derivatives (docs/benchmark.md)."""

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
KnotConstraints = Callable[[Array, Array, Array], tuple[Array, tuple[Array, Array, Array]]]
"""Of positions, velocities and accelerations at K knots, shape (K, n) each: values that must not be negative, shape
(K, m), and their derivatives in the three, shape (K, m, n) each."""

TABLE = 0.01  # m: how far from its height the tip may be
APART = 0.15  # m: of the object's centre from the pedestals
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))


def knot_constraints(problem: Problem, robot: Robot, start_xyz: Array, goal_xyz: Array) -> KnotConstraints:
    """Return the constraints of a boundary problem: of a hit, or of a transport.

    Args:
        problem: The problem.
        robot: Its robot.
        start_xyz: Where the tip begins [m], shape (3,).
        goal_xyz: Where it ends [m], shape (3,).

    Raises:
        UsageError: The problem has neither a table nor a held object.
    """
    table = next((each for each in problem.constraint if isinstance(each, Table)), None)
    if table is not None:
        return _on_table(table, robot)
    if problem.object_size is None:
        raise UsageError(f"{problem.name!r} has neither a table nor a held object")
    tops = obstacle_tops(problem, start_xyz, goal_xyz)
    boxes = [
        (np.array([box.x.low, box.y.low, -np.inf]), np.array([box.x.high, box.y.high, top]))
        for box, top in zip(problem.obstacle, tops.tolist(), strict=True)
    ]
    return _carrying(robot, np.array(problem.object_size), boxes)


def _on_table(table: Table, robot: Robot) -> KnotConstraints:
    """The tip over the table and at most 1 cm from its height; |y| and |z| as two inequalities each."""
    signs = np.array([[1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    bound = np.array([-table.x.low, -table.y.low, table.y.high, TABLE - table.z, TABLE + table.z])
    tip = _Tip(robot)

    def at(q: Array, _dq: Array, _ddq: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        found = [tip(each) for each in q]
        g = np.array([signs @ position + bound for position, _, _ in found])
        J = np.array([signs @ jacobian[:3] for _, _, jacobian in found])
        return g, (J, np.zeros_like(J), np.zeros_like(J))

    return at


def _carrying(robot: Robot, size: Array, boxes: list[tuple[Array, Array]]) -> KnotConstraints:
    """The object upright, away from the boxes with its centre and outside with its corners; torques within limits."""
    import pinocchio as pin

    tip, model, data, limit = _Tip(robot), robot.model, robot.model.createData(), robot.torque_limit

    def knot(q: Array, dq: Array, ddq: Array) -> tuple[Array, Array, Array, Array]:
        position, rotation, J = tip(q)
        turning = J[3:]
        values, slopes = [rotation[2, 2] - 1.0], [np.cross(turning.T, rotation[:, 2])[:, 2]]
        for low, high in boxes:
            value, normal = _near(position, low, high)
            values.append(value)
            slopes.append(normal @ J[:3])
            for corner in (_CORNERS * size) @ rotation.T:
                value, normal = _inside(position + corner, low, high)
                values.append(value)
                slopes.append(normal @ (J[:3] + np.cross(turning.T, corner).T))
        pin.computeRNEADerivatives(model, data, q, dq, ddq)
        inertia = np.triu(data.M) + np.triu(data.M, 1).T
        torque = np.array(data.tau)
        g = np.concatenate([values, limit - torque, limit + torque])
        slope = np.array(slopes)
        rows = [(slope, data.dtau_dq), (np.zeros_like(slope), data.dtau_dv), (np.zeros_like(slope), inertia)]
        of_q, of_dq, of_ddq = (np.vstack([first, -torques, torques]) for first, torques in rows)
        return g, of_q, of_dq, of_ddq

    def at(q: Array, dq: Array, ddq: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        g, a, b, c = (np.array(part) for part in zip(*map(knot, q, dq, ddq), strict=True))
        return g, (a, b, c)

    return at


def _near(point: Array, low: Array, high: Array) -> tuple[float, Array]:
    """``-max(APART - distance, 0)`` of a point from a box, and its gradient."""
    offset = point - np.clip(point, low, high)
    distance = float(np.linalg.norm(offset))
    if distance >= APART or distance == 0:
        return min(distance - APART, 0.0), np.zeros(3)
    return distance - APART, offset / distance


def _inside(point: Array, low: Array, high: Array) -> tuple[float, Array]:
    """``-(depth of a point in a box)``, 0 outside, and its gradient."""
    rooms = np.concatenate([point - low, high - point])
    least = int(np.argmin(rooms))
    if rooms[least] <= 0:
        return 0.0, np.zeros(3)
    normal = np.zeros(3)
    normal[least % 3] = -1.0 if least < 3 else 1.0
    return -float(rooms[least]), normal


class _Tip:
    """Where the tip is, and how it moves with the joints."""

    def __init__(self, robot: Robot) -> None:
        self._model, self._data = robot.model, robot.model.createData()
        self._frame = robot.model.getFrameId(robot.tip)

    def __call__(self, q: Array) -> tuple[Array, Array, Array]:
        """Return the position, the rotation and the Jacobian in world axes, shape (6, n), translation first."""
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        J = pin.computeFrameJacobian(self._model, self._data, q, self._frame, frame)
        pose = pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(pose.translation), np.array(pose.rotation), np.array(J)
