"""Validity of states and positions of the tip for tree planners, by a kernel over many states."""

from typing import Any

import numpy as np

from cnpgen.addons.benchmark.planners.obstacle_boxes import (
    MAX_CORNER_PENETRATION_M,
    MIN_OBJECT_DISTANCE_M,
    require_table_or_transport,
)
from cnpgen.arrays import Array, Mask
from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.kernels.symbolic.linalg import Scalar, Vec, dot
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.hull import CUBE

MAX_UPRIGHT_ERROR = 0.05  # of 1 - R_22
MAX_TIP_HEIGHT_ERROR_M = 0.01


class StateCheck:
    """Check of states: limits of joints and torques, the manifold, the obstacles."""

    def __init__(self, problem: Problem, robot: Robot) -> None:
        require_table_or_transport(problem)
        self.robot = robot
        self._kernel = problem_kernels(problem, robot, *choose_backend(None)).load(
            tip_and_violation
        )

    def __call__(
        self, q: Array, dq: Array, ddq: Array, obstacle_poses: Array
    ) -> tuple[Array, Mask]:
        """Check N states of shape (N, n) each among obstacles.

        Return positions of the tip [m], shape (N, 3), and a mask of the valid states,
        shape (N,).
        """
        lanes = [np.ascontiguousarray(values.T) for values in (q, dq, ddq)]
        tip, violation = self._kernel(
            *lanes,
            np.ascontiguousarray(
                np.broadcast_to(obstacle_poses[:, None], (len(obstacle_poses), len(q)))
            ),
        )
        return np.ascontiguousarray(tip.T), violation[0] <= 0

    def random_position(
        self, obstacle_poses: Array, random: np.random.Generator
    ) -> Array:
        """Return the tip position of a random configuration [m], shape (3,)."""
        q = random.uniform(self.robot.position_lower, self.robot.position_upper)[None]
        still = np.zeros_like(q)
        return np.asarray(self(q, still, still, obstacle_poses)[0][0])


def tip_and_violation(robot: Robot, problem: Problem) -> Any:
    """Build ``(q, dq, ddq, obstacle_poses) -> (tip, violation)`` with the largest violation, in its own unit."""
    import casadi as ca

    columns, state = SymbolicState.of_symbols(
        robot, problem.obstacle, problem.object_size, problem.scene_width
    )
    tip = state.kinematics.tip
    table = problem.first(Table)
    violation = [
        ca.fabs(value) - limit
        for value, limit in zip(state.dq, robot.velocity_limit.tolist(), strict=True)
    ]
    violation += [
        ca.fabs(value) - limit
        for value, limit in zip(state.torque, robot.torque_limit.tolist(), strict=True)
    ]
    violation += [
        low - value
        for value, low in zip(state.q, robot.position_lower.tolist(), strict=True)
    ]
    violation += [
        value - high
        for value, high in zip(state.q, robot.position_upper.tolist(), strict=True)
    ]
    violation += (
        _table_violations(table, tip)
        if table is not None
        else _obstacle_violations(state)
    )
    return ca.Function(
        "tip_and_violation",
        columns,
        [ca.vertcat(*tip), ca.mmax(ca.vertcat(*violation))],
    )


def _table_violations(table: Table, tip: Vec) -> list[Scalar]:
    import casadi as ca

    sides = [
        side
        for x, span in zip(tip, (table.x, table.y), strict=False)
        for side in (span.low - x, x - span.high)
    ]
    return [ca.fabs(tip[2] - table.z) - MAX_TIP_HEIGHT_ERROR_M, *sides]


def _obstacle_violations(state: SymbolicState) -> list[Scalar]:
    """Return violations of the tilt, of the distance to the obstacles, and of the penetration of corners."""
    import casadi as ca

    rotation = state.kinematics.rotation
    tip = state.kinematics.tip
    corners = [
        [x + dot(row, corner) for x, row in zip(tip, rotation, strict=True)]
        for corner in (CUBE * np.array(state.object_size)).tolist()
    ]
    violation: list[Scalar] = [1.0 - rotation[2][2] - MAX_UPRIGHT_ERROR]
    for box, top in zip(state.obstacles, state.obstacle_poses, strict=True):
        spans = [(span.low, span.high) for span in (box.x, box.y) if span is not None]
        sides = (*spans, (-np.inf, top))
        # Distance of the tip from a box: the norm of its excesses along the axes.
        outside = [
            ca.fmax(ca.fmax(low - x, x - high), 0)
            for x, (low, high) in zip(tip, sides, strict=True)
        ]
        violation.append(MIN_OBJECT_DISTANCE_M - ca.sqrt(dot(outside, outside)))
        for corner in corners:
            # A corner is inside by its least distance from a face, negative outside.
            depths = [
                ca.fmin(x - low, high - x)
                for x, (low, high) in zip(corner, sides, strict=True)
            ]
            violation.append(
                ca.fmin(ca.fmin(depths[0], depths[1]), depths[2])
                - MAX_CORNER_PENETRATION_M
            )
    return violation
