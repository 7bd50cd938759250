"""What a planner computes with kernels: equalities of the manifold, what slowing down helps against."""

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import Condition
from cnpgen.problems.constraints.needs import symbolic_needs
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import count_numbers
from cnpgen.symbolic.state import SymbolicState, Vec, symbols

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]


def equality_residuals(robot: "Robot", problem: Problem) -> Any:
    """Build ``(q, tops) -> (r, dr/dq)``: how far positions are off the manifold's equalities, column by column."""
    import casadi as ca

    (q_sx, q), (tops_sx, tops) = symbols("q", robot.n), symbols("tops", count_numbers(problem.obstacle))
    rows = [
        value - float(wanted)
        for condition, needs in _conditions(robot, problem, _moving(robot, q), tops)
        if needs == 0 and condition.is_equality
        for value, wanted in zip(condition.g, condition.lower, strict=True)
    ]
    residual = ca.vertcat(*rows) if rows else ca.SX(0, 1)
    jacobian = ca.densify(ca.jacobian(residual, q_sx))
    return ca.Function("equality_residuals", [q_sx, tops_sx], ca.cse([residual, ca.vec(jacobian)]))


def speed_residuals(robot: "Robot", problem: Problem) -> Any:
    """Build ``(q, dq, ddq, tops) -> g``: every value bounded by the problem that depends on how fast a path is run."""
    import casadi as ca

    (q_sx, q), (tops_sx, tops) = symbols("q", robot.n), symbols("tops", count_numbers(problem.obstacle))
    state = _moving(robot, q)
    rows = [value for condition, needs in _conditions(robot, problem, state, tops) if needs for value in condition.g]
    g = ca.vertcat(*rows) if rows else ca.SX(0, 1)
    return ca.Function("speed_residuals", [q_sx, state.of_dq, state.of_ddq, tops_sx], [g])


def speed_excess(robot: "Robot", problem: Problem) -> Any:
    """Build ``(p, p', p'', r, r', tops, in one column) -> e``: by how much the worst of ``speed_residuals`` is out.

    Negative if all are within their bounds. The column is one argument because a first look at one plan takes no longer
    than handing over five.
    """
    import casadi as ca

    n, names = robot.n, ("p", "p1", "p2", "rates", "tops")
    widths = (n, n, n, 2, count_numbers(problem.obstacle))
    columns, (p, p1, p2, (r, r1), tops) = zip(*map(symbols, names, widths), strict=True)
    dq = [slope * r for slope in p1]
    ddq = [(curve * r + slope * r1) * r for curve, slope in zip(p2, p1, strict=True)]
    state = _State(p, dq, ddq, of_dq=ca.vertcat(columns[1], r), of_ddq=ca.vertcat(columns[2], r1))
    out: list[Any] = []
    for condition, needs in _conditions(robot, problem, state, tops):
        if needs:
            for value, low, high in zip(condition.g, condition.lower, condition.upper, strict=True):
                out += [float(low) - value] if np.isfinite(low) else []
                out += [value - float(high)] if np.isfinite(high) else []
    worst = reduce(ca.fmax, out) if out else ca.SX(-1)
    return ca.Function("speed_excess", [ca.vertcat(*columns)], [worst])


def count_equalities(robot: "Robot", problem: Problem) -> int:
    """Count the rows of ``equality_residuals``."""
    found = _any_conditions(robot, problem)
    return sum(len(condition.g) for condition, needs in found if needs == 0 and condition.is_equality)


def speed_bounds(robot: "Robot", problem: Problem) -> tuple[Array, Array]:
    """Bounds of the rows of ``speed_residuals``: lower and upper, shape (m,) each."""
    found = [condition for condition, needs in _any_conditions(robot, problem) if needs]
    return (
        np.concatenate([condition.lower for condition in found] or [np.empty(0)]),
        np.concatenate([condition.upper for condition in found] or [np.empty(0)]),
    )


@dataclass(frozen=True)
class _State:
    """A state (q, dq, ddq), the symbols that its velocities are made of, and those of its accelerations alone."""

    q: Vec
    dq: Vec
    ddq: Vec
    of_dq: Any
    of_ddq: Any


def _moving(robot: "Robot", q: Vec) -> _State:
    (dq_sx, dq), (ddq_sx, ddq) = symbols("dq", robot.n), symbols("ddq", robot.n)
    return _State(q, dq, ddq, dq_sx, ddq_sx)


def _any_conditions(robot: "Robot", problem: Problem) -> list[tuple[Condition, int]]:
    tops = symbols("tops", count_numbers(problem.obstacle))[1]
    return _conditions(robot, problem, _moving(robot, symbols("q", robot.n)[1]), tops)


def _conditions(robot: "Robot", problem: Problem, state: _State, tops: Vec) -> list[tuple[Condition, int]]:
    """State all constraints at a state, each with the highest derivative of q that it depends on."""
    size = problem.object_size
    symbolic = SymbolicState(robot, state.q, state.dq, state.ddq, tops, problem.obstacle, size)
    found = [condition for constraint in problem.constraint for condition in constraint.symbolic(symbolic)]
    return [(condition, symbolic_needs(condition, state.of_dq, state.of_ddq)) for condition in found]
