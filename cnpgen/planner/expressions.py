"""What a planner computes with kernels: tip positions, equalities of the manifold, what slowing down helps against."""

from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import Condition
from cnpgen.problems.problem import Problem
from cnpgen.symbolic.state import SymbolicState, Vec, forward_kinematics, symbols

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]


def tip_position(robot: "Robot") -> Any:
    """Build ``q -> p``, the tip's position [m]."""
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    return ca.Function("tip_position", [q_sx], [ca.vertcat(*forward_kinematics(robot.chain, q).tip)])


def equality_residuals(robot: "Robot", problem: Problem) -> Any:
    """Build ``(q, tops) -> (r, dr/dq)``: how far positions are off the manifold's equalities, column by column."""
    import casadi as ca

    (q_sx, q), (tops_sx, tops) = symbols("q", robot.n), symbols("tops", len(problem.obstacle))
    still: Vec = [0.0] * robot.n
    rows = [
        value - float(wanted)
        for condition in _conditions(robot, problem, (q, still, still), tops)
        if _is_equality(condition)
        for value, wanted in zip(condition.g, condition.lower, strict=True)
    ]
    residual = ca.vertcat(*rows) if rows else ca.SX(0, 1)
    jacobian = ca.densify(ca.jacobian(residual, q_sx))
    return ca.Function("equality_residuals", [q_sx, tops_sx], ca.cse([residual, ca.vec(jacobian)]))


def speed_residuals(robot: "Robot", problem: Problem) -> Any:
    """Build ``(q, dq, ddq, tops) -> g``: every value bounded by the problem that depends on how fast a path is run."""
    import casadi as ca

    names = ("q", "dq", "ddq")
    (q_sx, q), (dq_sx, dq), (ddq_sx, ddq) = (symbols(name, robot.n) for name in names)
    tops_sx, tops = symbols("tops", len(problem.obstacle))
    rows = [
        value
        for condition in _conditions(robot, problem, (q, dq, ddq), tops)
        if condition.needs
        for value in condition.g
    ]
    g = ca.vertcat(*rows) if rows else ca.SX(0, 1)
    return ca.Function("speed_residuals", [q_sx, dq_sx, ddq_sx, tops_sx], [g])


def speed_excess(robot: "Robot", problem: Problem) -> Any:
    """Build ``(p, p', p'', r, r', tops, in one column) -> e``: by how much the worst of ``speed_residuals`` is out.

    Negative if all are within their bounds. The column is one argument because a first look at one plan takes no longer
    than handing over five.
    """
    import casadi as ca

    n, names = robot.n, ("p", "p1", "p2", "rates", "tops")
    widths = (n, n, n, 2, len(problem.obstacle))
    columns, (p, p1, p2, (r, r1), tops) = zip(*map(symbols, names, widths), strict=True)
    dq = [slope * r for slope in p1]
    ddq = [(curve * r + slope * r1) * r for curve, slope in zip(p2, p1, strict=True)]
    out: list[Any] = []
    for condition in _conditions(robot, problem, (p, dq, ddq), tops):
        if condition.needs:
            for value, low, high in zip(condition.g, condition.lower, condition.upper, strict=True):
                out += [float(low) - value] if np.isfinite(low) else []
                out += [value - float(high)] if np.isfinite(high) else []
    worst = reduce(ca.fmax, out) if out else ca.SX(-1)
    return ca.Function("speed_excess", [ca.vertcat(*columns)], [worst])


def count_equalities(robot: "Robot", problem: Problem) -> int:
    """Count the rows of ``equality_residuals``."""
    return sum(len(condition.g) for condition in _any_conditions(robot, problem) if _is_equality(condition))


def speed_bounds(robot: "Robot", problem: Problem) -> tuple[Array, Array]:
    """Bounds of the rows of ``speed_residuals``: lower and upper, shape (m,) each."""
    found = [condition for condition in _any_conditions(robot, problem) if condition.needs]
    return (
        np.concatenate([condition.lower for condition in found] or [np.empty(0)]),
        np.concatenate([condition.upper for condition in found] or [np.empty(0)]),
    )


def _is_equality(condition: Condition) -> bool:
    return condition.needs == 0 and condition.is_equality


def _any_conditions(robot: "Robot", problem: Problem) -> list[Condition]:
    q, dq, ddq = (symbols(name, robot.n)[1] for name in ("q", "dq", "ddq"))
    return _conditions(robot, problem, (q, dq, ddq), symbols("tops", len(problem.obstacle))[1])


def _conditions(robot: "Robot", problem: Problem, state: tuple[Vec, Vec, Vec], tops: Vec) -> list[Condition]:
    """State all constraints at the state (q, dq, ddq)."""
    size = problem.object.size if problem.object is not None else None
    symbolic = SymbolicState(robot, *state, tops, problem.obstacle, size)
    return [condition for constraint in problem.constraint for condition in constraint.symbolic(symbolic)]
