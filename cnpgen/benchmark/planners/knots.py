"""Constraints of TrajOpt at its knots, with analytic derivatives by Pinocchio ('cnpgen docs benchmark')."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.planners.obstacle_boxes import Box, boxes_of, depth, distance
from cnpgen.benchmark.simulator.tip import Tip
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.robots.shape.hull import CUBE

Array = NDArray[np.float64]
KnotConstraints = Callable[[Array, Array, Array], tuple[Array, tuple[Array, Array, Array]]]
"""Function of positions, velocities and accelerations at K knots, shape (K, n) each. It returns values that must not be
negative, shape (K, m), and their three derivatives, shape (K, m, n) each."""

MAX_HEIGHT_ERROR_M = 0.01
MIN_CENTER_DISTANCE_M = 0.15  # of the object from the obstacles


def knot_constraints(problem: Problem, robot: Robot, scene: Scene) -> KnotConstraints:
    """Return the constraints of a boundary problem: of a hit, or of a transport.

    Args:
        problem: The problem.
        robot: Its robot.
        scene: Obstacles of the boundary problem.

    Raises:
        UsageError: The problem has neither a table nor a held object.
    """
    table = problem.first(Table)
    if table is not None:
        return _on_table(table, robot)
    return _with_object(robot, *boxes_of(problem, scene))


def _on_table(table: Table, robot: Robot) -> KnotConstraints:
    """Bound the tip: over the table and at most 1 cm from its height; |y| and |z| are two inequalities each."""
    signs = np.array([[1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    bound = np.array(
        [-table.x.low, -table.y.low, table.y.high, MAX_HEIGHT_ERROR_M - table.z, MAX_HEIGHT_ERROR_M + table.z]
    )
    tip = Tip(robot)

    def at(q: Array, _dq: Array, _ddq: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        poses = [tip.at(position) for position in q]
        g = np.array([signs @ position + bound for position, _, _ in poses])
        J = np.array([signs @ jacobian[:3] for _, _, jacobian in poses])
        return g, (J, np.zeros_like(J), np.zeros_like(J))

    return at


def _with_object(robot: Robot, size: Array, boxes: list[Box]) -> KnotConstraints:
    """Constrain the object: upright, centre away from the boxes, corners outside; torques within limits."""
    import pinocchio as pin

    tip, model, data, limit = Tip(robot), robot.model, robot.model.createData(), robot.torque_limit

    def object_values(q: Array) -> tuple[list[float], Array]:
        position, rotation, J = tip.at(q)
        turning = J[3:]
        values, gradients = [rotation[2, 2] - 1.0], [np.cross(turning.T, rotation[:, 2])[:, 2]]
        for box in boxes:
            separation, normal = distance(position, box)
            values.append(min(separation - MIN_CENTER_DISTANCE_M, 0.0))
            gradients.append(normal @ J[:3] * (separation < MIN_CENTER_DISTANCE_M))
            for corner in (CUBE * size) @ rotation.T:
                penetration, normal = depth(position + corner, box)
                values.append(-penetration)
                gradients.append(-normal @ (J[:3] + np.cross(turning.T, corner).T))
        return values, np.array(gradients)

    def knot(q: Array, dq: Array, ddq: Array) -> tuple[Array, Array, Array, Array]:
        values, gradient = object_values(q)
        pin.computeRNEADerivatives(model, data, q, dq, ddq)
        inertia, torque = np.triu(data.M) + np.triu(data.M, 1).T, np.array(data.tau)
        g = np.concatenate([values, limit - torque, limit + torque])
        rows = [(gradient, data.dtau_dq), (np.zeros_like(gradient), data.dtau_dv), (np.zeros_like(gradient), inertia)]
        of_q, of_dq, of_ddq = (np.vstack([first, -torques, torques]) for first, torques in rows)
        return g, of_q, of_dq, of_ddq

    def at(q: Array, dq: Array, ddq: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        g, a, b, c = (np.array(part) for part in zip(*map(knot, q, dq, ddq), strict=True))
        return g, (a, b, c)

    return at
