"""What a planner computes with kernels: equalities of the manifold, what slowing down helps against."""

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.symbolic.linalg import Vec, symbols
from cnpgen.kernels.symbolic.state import SymbolicState, jerk_along
from cnpgen.problems.constraints.constraint import FINEST, Condition
from cnpgen.problems.constraints.needs import symbolic_needs
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import count_numbers

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]


def equality_residuals(robot: "Robot", problem: Problem) -> Any:
    """Build ``(q, tops) -> (r, dr/dq)``: how far positions are off the manifold's equalities, column by column."""
    import casadi as ca

    (q_sx, q), (tops_sx, tops) = symbols("q", robot.n), symbols("tops", count_numbers(problem.obstacle))
    rows = [
        value - float(wanted)
        for condition, needs in _conditions(robot, problem, _moving(problem, q), tops)
        if needs == 0 and condition.is_equality
        for value, wanted in zip(condition.g, condition.lower, strict=True)
    ]
    residual = ca.vertcat(*rows) if rows else ca.SX(0, 1)
    jacobian = ca.densify(ca.jacobian(residual, q_sx))
    return ca.Function("equality_residuals", [q_sx, tops_sx], ca.cse([residual, ca.vec(jacobian)]))


def speed_residuals(robot: "Robot", problem: Problem) -> Any:
    """Build ``(q, dq, ddq, tops) -> g``: every value bounded by the problem that depends on how fast a path is run.

    With constraints of the jerk it is ``(q, dq, ddq, jerk, tops) -> g``.
    """
    import casadi as ca

    (q_sx, q), (tops_sx, tops) = symbols("q", robot.n), symbols("tops", count_numbers(problem.obstacle))
    state = _moving(problem, q)
    rows = [value for condition, needs in _conditions(robot, problem, state, tops) if needs for value in condition.g]
    g = ca.vertcat(*rows) if rows else ca.SX(0, 1)
    return ca.Function("speed_residuals", [q_sx, *state.moving, tops_sx], [g])


def speed_excess(robot: "Robot", problem: Problem) -> Any:
    """Build ``(p, p', p'', r, r', tops, in one column) -> e``: by how much the worst of ``speed_residuals`` is out.

    With constraints of the jerk the column has p''' after p'' and r'' after r'.

    Negative if all are within their bounds. The column is one argument because a first look at one plan takes no longer
    than handing over five.
    """
    import casadi as ca

    columns, (p, *path, rate, tops) = _on_path(robot, problem)
    orders, (p1, p2), (r, r1) = problem.path_orders, path[:2], rate[:2]
    dq = [slope * r for slope in p1]
    ddq = [(curve * r + slope * r1) * r for curve, slope in zip(p2, p1, strict=True)]
    moving = tuple(ca.vertcat(columns[order], columns[orders][order - 1]) for order in range(1, orders))
    state = _State(p, dq, ddq, jerk_along(path, rate), moving)
    out: list[Any] = []
    for condition, needs in _conditions(robot, problem, state, tops):
        if needs:
            out += _beyond(condition, np.ones(len(condition.g)))
    worst = reduce(ca.fmax, out) if out else ca.SX(-1)
    return ca.Function("speed_excess", [ca.vertcat(*columns)], [worst])


def speed_coefficients(robot: "Robot", problem: Problem) -> Any:
    """Build ``(the column of speed_excess) -> rest, square, mixed`` of what bounds rates on a given path.

    Values of ``speed_residuals`` that are quadratic in dq, without a linear part, and linear in ddq are ``rest +
    square r^2 + mixed r r'``. Of those that are proportional to dq the square of the largest share of a bound is, and
    it stands for all as the last row. Bounds are those of ``coefficient_bounds``.
    """
    import casadi as ca

    columns, values, still = _on_path(robot, problem)[0], speed_residuals(robot, problem), ca.SX.zeros(robot.n)
    p, p1, p2, _, tops = columns
    rest, fast, rising = (values(p, *moving, tops) for moving in ((still, still), (p1, p2), (still, p1)))
    bounds = speed_bounds(robot, problem)
    others, shares = np.flatnonzero(~bounds.proportional).tolist(), []
    for bound in (bounds.lower, bounds.upper):
        rows = np.flatnonzero(bounds.proportional & np.isfinite(bound)).tolist()
        shares += [fast[row] * float(1 / bound[row]) for row in rows]
    largest = [reduce(ca.fmax, shares, ca.SX(0)) ** 2] if shares else []
    nothing = [ca.SX.zeros(len(largest))]
    found = [(rest, nothing), (fast - rest, largest), (rising - rest, nothing)]
    outputs = [ca.densify(ca.vertcat(each[others], *last)) for each, last in found]
    return ca.Function("speed_coefficients", [ca.vertcat(*columns)], ca.cse(outputs))


def coefficient_bounds(bounds: "SpeedBounds") -> tuple[Array, Array]:
    """Lower and upper bounds of the rows of ``speed_coefficients``, from those of ``speed_residuals``."""
    others, shares = ~bounds.proportional, int(bounds.proportional.any())
    return np.append(bounds.lower[others], [-np.inf] * shares), np.append(bounds.upper[others], [1.0] * shares)


def rest_excess(robot: "Robot", problem: Problem) -> Any:
    """Build ``(q, tops) -> e``: by how much the worst condition is broken by the robot at rest, in tolerances."""
    import casadi as ca

    (q_sx, q), (tops_sx, tops) = symbols("q", robot.n), symbols("tops", count_numbers(problem.obstacle))
    rest = [0.0] * robot.n
    jerk = rest if problem.uses_jerk else None
    state = SymbolicState(robot, q, rest, rest, tops, problem.obstacle, problem.object_size, jerk)
    out: list[Any] = []
    for constraint in problem.constraint:
        for condition in constraint.symbolic(state):
            out += _beyond(condition, np.maximum(constraint.allowed(condition), FINEST))
    return ca.Function("rest_excess", [q_sx, tops_sx], [reduce(ca.fmax, out, ca.SX(-1))])


def _beyond(condition: Condition, units: Array) -> list[Any]:
    """Return by how many units, shape (m,), the values of a condition are beyond each of its finite bounds."""
    found = []
    for value, low, high, unit in zip(condition.g, condition.lower, condition.upper, units.tolist(), strict=True):
        found += [(float(low) - value) / unit] if np.isfinite(low) else []
        found += [(value - float(high)) / unit] if np.isfinite(high) else []
    return found


def useful_steps(kernels: KernelLibrary, steps: int) -> int:
    """How many of some steps onto the equalities are of use: none where ``equality_residuals`` has no rows."""
    return steps if steps and kernels.tape(equality_residuals).outputs[0] > 0 else 0


@dataclass(frozen=True)
class SpeedBounds:
    """What is known of the rows of ``speed_residuals``, shape (m,) each.

    Attributes:
        lower: Lower bounds.
        upper: Upper bounds.
        cubic: Which depend on the jerk.
        proportional: Which are proportional to dq, with a bound on one side of zero or on either.
    """

    lower: Array
    upper: Array
    cubic: NDArray[np.bool_]
    proportional: NDArray[np.bool_]


def speed_bounds(robot: "Robot", problem: Problem) -> SpeedBounds:
    """Find the bounds of the rows of ``speed_residuals``."""
    state, tops = _moving(problem, symbols("q", robot.n)[1]), symbols("tops", count_numbers(problem.obstacle))[1]
    rows = [
        (low, high, needs == 3, needs == 1 and _is_proportional(value, state.moving[0], low, high))
        for condition, needs in _conditions(robot, problem, state, tops)
        if needs
        for value, low, high in zip(condition.g, condition.lower, condition.upper, strict=True)
    ]
    lower, upper, cubic, proportional = np.array(rows, float).reshape(-1, 4).T
    return SpeedBounds(lower, upper, cubic.astype(bool), proportional.astype(bool))


def _is_proportional(value: Any, dq: Any, low: float, high: float) -> bool:
    import casadi as ca

    linear = ca.is_linear(value, dq) and ca.substitute(value, dq, ca.SX.zeros(dq.shape)).is_zero()
    return bool(linear and low < 0 < high and np.isfinite([low, high]).any())


def _on_path(robot: "Robot", problem: Problem) -> tuple[list[Any], list[Vec]]:
    """Name p, p', p'', ..., r, r', ... and tops, as SX columns and as lists of their scalars."""
    orders = problem.path_orders
    names = (*(f"p{order}" for order in range(orders)), "rates", "tops")
    widths = (*[robot.n] * orders, orders - 1, count_numbers(problem.obstacle))
    columns, scalars = zip(*map(symbols, names, widths), strict=True)
    return list(columns), list(scalars)


@dataclass(frozen=True)
class _State:
    """A state, its jerk where it is constrained, and the symbols that every derivative has and no lower one."""

    q: Vec
    dq: Vec
    ddq: Vec
    jerk: Vec | None
    moving: tuple[Any, ...]


def _moving(problem: Problem, q: Vec) -> _State:
    names = ("dq", "ddq", "jerk")[: problem.path_orders - 1]
    columns, (dq, ddq, *third) = zip(*(symbols(name, len(q)) for name in names), strict=True)
    return _State(q, dq, ddq, third[0] if third else None, columns)


def _conditions(robot: "Robot", problem: Problem, state: _State, tops: Vec) -> list[tuple[Condition, int]]:
    """State all constraints at a state, each with the highest derivative of q that it depends on."""
    size = problem.object_size
    symbolic = SymbolicState(robot, state.q, state.dq, state.ddq, tops, problem.obstacle, size, state.jerk)
    found = [condition for constraint in problem.constraint for condition in constraint.symbolic(symbolic)]
    return [(condition, symbolic_needs(condition, *state.moving)) for condition in found]
