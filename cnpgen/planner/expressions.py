"""Build the CasADi functions of a planner: residuals that depend on velocity, and largest violations."""

from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.symbolic.linalg import Vec, symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState, time_derivatives
from cnpgen.problems.conditions import (
    conditions_with_needs,
    equality_residuals,
    state_of_symbols,
)
from cnpgen.problems.constraints.constraint import MIN_TOLERANCE, Condition
from cnpgen.problems.constraints.joint import POWER_UNIT, JointTorque
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot


def speed_residuals(robot: Robot, problem: Problem) -> Any:
    """Build ``(q, dq, ddq, obstacle_poses) -> g``: all bounded values of the problem that depend on velocity.

    With jerk constraints it is ``(q, dq, ddq, jerk, obstacle_poses) -> g``. With
    friction a last argument has the velocities that determine its direction, so that a
    scaled motion has the friction of the given one and not that of rest.
    """
    import casadi as ca

    columns, state = state_of_symbols(robot, problem)
    moving = columns[1:-1]
    if has_friction(robot):
        column, rates = symbols("friction_rates", robot.n)
        columns, state = [*columns, column], replace(state, friction_rates=rates)
    # Values that do not depend on velocity cannot be met by slower motions.
    conditions = conditions_with_needs(problem, state, moving)
    rows = [value for condition, needs in conditions if needs for value in condition.g]
    g = ca.vertcat(*rows) if rows else ca.SX(0, 1)
    return ca.Function("speed_residuals", columns, [g])


def has_friction(robot: Robot) -> bool:
    """Return whether drives have friction, whose direction ``speed_residuals`` takes as an argument."""
    return robot.drive is not None and bool(
        robot.drive.coulomb.any() or robot.drive.viscous.any()
    )


@dataclass(frozen=True)
class _FrictionalState(SymbolicState):
    """A state of massless links: its motor torques are those of rotors and friction alone."""

    @cached_property
    def torque(self) -> Vec:
        """Zero."""
        return [0.0] * self.robot.n


def _linear_rows(robot: Robot, problem: Problem, p1: Vec, friction_rates: Vec) -> Any:
    """Return the coefficients of r in the rows of ``speed_residuals``: friction and lines, zero in other rows, as SX.

    The torque of a rigid body is quadratic in the velocity without a linear part, so
    massless links suffice. Friction of a fixed direction and torque-speed lines are
    linear in the velocity.
    """
    import casadi as ca

    columns, state = state_of_symbols(robot, problem)
    zero = [0.0] * robot.n
    q, poses, size = state.q, state.obstacle_poses, problem.object_size
    # The difference of two states with the same friction direction is linear in dq.
    still, moving = (
        _FrictionalState(robot, q, dq, zero, poses, (), size, None, friction_rates)
        for dq in (zero, p1)
    )
    rows: list[Any] = []
    for constraint in problem.constraint:
        if isinstance(constraint, JointTorque):
            pairs = zip(
                constraint.symbolic(moving), constraint.symbolic(still), strict=True
            )
            rows += [x - y for a, b in pairs for x, y in zip(a.g, b.g, strict=True)]
            continue
        alone = replace(problem, constraint=(constraint,))
        # Rows without torques have no linear part: zeros for each of their values.
        conditions = conditions_with_needs(alone, state, columns[1:-1])
        rows += [0.0] * sum(len(each.g) for each, needs in conditions if needs)
    return ca.vertcat(*rows)


def speed_violation(robot: Robot, problem: Problem) -> Any:
    """Build ``(p, p', p'', r, r', obstacle_poses, in one column) -> e``, the largest violation.

    The violation is that of ``speed_residuals``. With jerk constraints the column has
    p''' after p'' and r'' after r'.

    The value is negative if all residuals are within their bounds. The arguments form
    one column because passing five arguments takes longer than one evaluation of one
    plan.
    """
    import casadi as ca

    columns, (p, *path, rate, obstacle_poses) = _on_path(robot, problem)
    orders = problem.path_orders
    moving = [
        ca.vertcat(columns[order], columns[orders][order - 1])
        for order in range(1, orders)
    ]
    # Violations are functions of phase derivatives and rate: dq = p' r, ddq = p'' r^2 +
    # p' r' r.
    dq, ddq, jerk = time_derivatives(path, rate)
    state = SymbolicState(
        robot, p, dq, ddq, obstacle_poses, problem.obstacle, problem.object_size, jerk
    )
    violations: list[Any] = []
    for condition, needs in conditions_with_needs(problem, state, moving):
        if needs:
            violations += _violations(condition, np.ones(len(condition.g)))
    # A constant, if nothing depends on velocity: -1 is no violation.
    worst = reduce(ca.fmax, violations) if violations else ca.SX(-1)
    return ca.Function("speed_violation", [ca.vertcat(*columns)], [worst])


def _largest_fraction(fast: Any, bounds: "SpeedBounds") -> list[Any]:
    """Return the square of the largest fraction of the bounds of proportional residuals; none without them.

    (dq / bound)^2 <= 1 for both signs of the bound: one row replaces all of them.
    """
    import casadi as ca

    fractions = []
    for bound in (bounds.lower, bounds.upper):
        rows = np.flatnonzero(bounds.proportional & np.isfinite(bound)).tolist()
        fractions += [fast[row] * float(1 / bound[row]) for row in rows]
    return [reduce(ca.fmax, fractions, ca.SX(0)) ** 2] if fractions else []


def speed_coefficients(robot: Robot, problem: Problem) -> Any:
    """Build ``(the column of speed_violation) -> constant, square, mixed``: coefficients of the rate's bounds.

    Values of ``speed_residuals`` that are quadratic in dq, without a linear part, and
    linear in ddq are ``constant + square r^2 + mixed r r'``. With viscous friction or
    torque-speed lines of drives a fourth output has the coefficient of r; the direction of friction is that
    of the given rates, and both ones near a reversal. Values proportional to dq
    are combined in the last row: the square of the largest fraction of a bound. The
    bounds are those of ``coefficient_bounds``.
    """
    import casadi as ca

    columns, _ = _on_path(robot, problem)
    values = speed_residuals(robot, problem)
    p, p1, p2, rates, obstacle_poses = columns
    zero = ca.SX.zeros(robot.n)
    friction = [p1 * rates[0]] if has_friction(robot) else []
    # Three evaluations determine the coefficients: at rest (constant), at p' and p''
    # with r = 1 (square), and with ddq = p' alone (mixed).
    at_rest, fast, rising = (
        values(p, *moving, obstacle_poses, *friction)
        for moving in ((zero, zero), (p1, p2), (zero, p1))
    )
    square, linear = fast - at_rest, []
    drive = robot.drive
    if drive is not None and (drive.viscous.any() or drive.lines):
        parts = map(ca.vertsplit, (p1, p1 * rates[0]))
        linear = [_linear_rows(robot, problem, *parts)]
        # The evaluation at r = 1 contains the linear part, too.
        square = square - linear[0]
    bounds = speed_bounds(robot, problem)
    others = np.flatnonzero(~bounds.proportional).tolist()
    largest = _largest_fraction(fast, bounds)
    none = [ca.SX.zeros(len(largest))]
    coefficients = [
        (at_rest, none),
        (square, largest),
        (rising - at_rest, none),
        *((coefficient, none) for coefficient in linear),
    ]
    outputs = [
        ca.densify(ca.vertcat(values_of_rows[others], *last))
        for values_of_rows, last in coefficients
    ]
    return ca.Function("speed_coefficients", [ca.vertcat(*columns)], ca.cse(outputs))


def coefficient_bounds(bounds: "SpeedBounds") -> tuple[Array, Array]:
    """Return lower and upper bounds of the rows of ``speed_coefficients`` from those of ``speed_residuals``."""
    others, count = ~bounds.proportional, int(bounds.proportional.any())
    return np.append(bounds.lower[others], [-np.inf] * count), np.append(
        bounds.upper[others], [1.0] * count
    )


def static_violation(robot: Robot, problem: Problem) -> Any:
    """Build ``(q, obstacle_poses) -> e``: the largest violation of a condition by the robot at rest, in tolerances."""
    import casadi as ca

    columns, state = state_of_symbols(robot, problem)
    zero = [0.0] * robot.n
    # At rest torques are those of gravity.
    rest = replace(state, dq=zero, ddq=zero, jerk=zero if problem.uses_jerk else None)
    violations: list[Any] = []
    for constraint in problem.constraint:
        for condition in constraint.symbolic(rest):
            violations += _violations(
                condition, np.maximum(constraint.allowed(condition), MIN_TOLERANCE)
            )
    return ca.Function(
        "static_violation",
        [columns[0], columns[-1]],
        [reduce(ca.fmax, violations, ca.SX(-1))],
    )


def _violations(condition: Condition, units: Array) -> list[Any]:
    """Return the violations of a condition's finite bounds, in the given units, shape (m,)."""
    violations = []
    for value, low, high, unit in zip(
        condition.g, condition.lower, condition.upper, units.tolist(), strict=True
    ):
        # Positive outside a bound; infinite bounds have no violation.
        violations += [(float(low) - value) / unit] if np.isfinite(low) else []
        violations += [(value - float(high)) / unit] if np.isfinite(high) else []
    return violations


def effective_steps(kernels: KernelLibrary, steps: int) -> int:
    """Return the number of projection steps: 0 if ``equality_residuals`` has no rows."""
    return steps if steps and kernels.tape(equality_residuals).outputs[0] > 0 else 0


@dataclass(frozen=True)
class SpeedBounds:
    """Bounds and structure of the rows of ``speed_residuals``, shape (m,) each.

    Attributes:
        lower: Lower bounds.
        upper: Upper bounds.
        cubic: Mask of the rows that depend on the jerk.
        power: Mask of the rows that are powers of motors.
        proportional: Mask of the rows proportional to dq whose bounds enclose zero.
    """

    lower: Array
    upper: Array
    cubic: NDArray[np.bool_]
    power: NDArray[np.bool_]
    proportional: NDArray[np.bool_]


def speed_bounds(robot: Robot, problem: Problem) -> SpeedBounds:
    """Return the bounds of the rows of ``speed_residuals``."""
    columns, state = state_of_symbols(robot, problem)
    rows = [
        (
            low,
            high,
            needs == 3,
            condition.unit == POWER_UNIT,
            needs == 1 and _is_proportional(value, columns[1], low, high),
        )
        for condition, needs in conditions_with_needs(problem, state, columns[1:-1])
        if needs
        for value, low, high in zip(
            condition.g, condition.lower, condition.upper, strict=True
        )
    ]
    # The reshape gives five columns to a problem without rows, too.
    lower, upper, *masks = np.array(rows, float).reshape(-1, 5).T
    return SpeedBounds(lower, upper, *(mask.astype(bool) for mask in masks))


def _is_proportional(value: Any, dq: Any, low: float, high: float) -> bool:
    import casadi as ca

    # Linear without a constant part: proportional to dq.
    linear = (
        ca.is_linear(value, dq)
        and ca.substitute(value, dq, ca.SX.zeros(dq.shape)).is_zero()
    )
    # Only such a row is met at rest and scales with the rate.
    return bool(linear and low < 0 < high and np.isfinite([low, high]).any())


def _on_path(robot: Robot, problem: Problem) -> tuple[list[Any], list[Vec]]:
    """Return the path, the rate, their derivatives, and obstacle poses, as SX columns and as lists of their scalars."""
    orders = problem.path_orders
    names = (*(f"p{order}" for order in range(orders)), "rates", "obstacle_poses")
    widths = (*[robot.n] * orders, orders - 1, problem.scene_width)
    columns, scalars = zip(*map(symbols, names, widths), strict=True)
    return list(columns), list(scalars)
