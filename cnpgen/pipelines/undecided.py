"""Boundary states that conditions in symbolic form leave undecided, put to Pinocchio and Coal.

Capsules hold more than the links that they cover: where they are clear, so are the links; where they are not, the
links' pieces decide.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.symbolic.linalg import Scalar, symbols
from cnpgen.kernels.symbolic.state import SymbolicState
from cnpgen.pipelines.context import Context
from cnpgen.problems.constraints.constraint import EXACTNESS, Condition, Constraint, End
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import count_numbers
from cnpgen.world.path import PathWorld
from cnpgen.world.state import World

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
Settle = Callable[[tuple[Array, Array, Array], Array, NDArray[np.bool_]], NDArray[np.bool_]]


def settle(context: Context, end: End, *, exact: bool = True) -> Settle | None:
    """Prepare the decision about what is undecided at an end; None where nothing ever is.

    Args:
        context: The surroundings.
        end: Which end of the motion.
        exact: Whether its state must be exact; else it may be as far outside as motions may.

    Returns:
        A function of states ``(q, dq, ddq)``, shape (n, N) each, numbers of obstacles, shape (numbers, N), and which
        of the N are worth asking for; it says which constraints these break, shape (constraints, N).
    """
    problem, robot = context.problem, context.robot
    if robot.shape is None and all(each.upright for each in problem.obstacle):
        return None
    kernel = context.kernels.load(undecided, end=end, dtype=context.dtype)
    world = World(robot, problem.obstacle, problem.object_size)
    path = PathWorld(robot, problem.obstacle, problem.object_size)

    def decide(state: tuple[Array, Array, Array], tops: Array, asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        (doubts,) = kernel(*state, tops)
        open_, broken = (doubts > 0) & asked, np.zeros(doubts.shape, bool)
        for row in np.flatnonzero(open_.any(axis=1)) if np.all(tops == tops[:, :1]) else ():
            draws = np.flatnonzero(open_[row])
            slack = _slack(problem.constraint[row], context.dtype, exact=exact)
            q, dq, ddq = (np.ascontiguousarray(values[:, draws], float) for values in state)
            path.set_path(q, dq, ddq, tops[:, 0])
            met = problem.constraint[row].met(path, slack)
            if met is not None:
                open_[row, draws], broken[row, draws] = False, ~met
        for draw in np.flatnonzero(open_.any(axis=0)):
            q, dq, ddq = (np.ascontiguousarray(values[:, draw]) for values in state)
            world.set_state(q, dq, ddq, tops[:, draw])
            for row in np.flatnonzero(open_[:, draw]):
                broken[row, draw] = _breaks(problem.constraint[row], world, end, context.dtype, exact=exact)
        return broken

    return decide


def _slack(constraint: Constraint, dtype: str, *, exact: bool) -> float:
    """How far a boundary state may be outside a condition of lengths [m]."""
    slack = EXACTNESS[dtype]["position"]
    return slack if exact else max(slack, constraint.tolerance)


def _breaks(constraint: Constraint, world: World, end: End, dtype: str, *, exact: bool) -> bool:
    """Whether the measured form of a constraint is broken by more than a boundary state may."""
    for condition in constraint.measured_at(world, end):
        g, slack = np.array(condition.g, float), condition.slack(dtype)
        slack = slack if exact else np.maximum(slack, constraint.allowed(condition))
        if not ((g >= condition.lower - slack) & (g <= condition.upper + slack)).all():
            return True
    return False


def undecided(robot: "Robot", problem: Problem, *, end: End, dtype: str) -> Any:
    """Build ``(q, dq, ddq, tops) -> doubts``: positive for constraints whose sufficient conditions are not all met."""
    import casadi as ca

    columns = [symbols(name, robot.n) for name in ("q", "dq", "ddq")] + [
        symbols("tops", count_numbers(problem.obstacle))
    ]
    (q, dq, ddq, tops), size = [scalars for _, scalars in columns], problem.object_size
    state = SymbolicState(robot, q, dq, ddq, tops, problem.obstacle, size)
    rows: list[Scalar] = []
    for constraint in problem.constraint:
        conditions = [each for each in constraint.symbolic_at(state, end) if each.sufficient]
        rows.append(sum((unmet(each, each.slack(dtype)) for each in conditions), ca.SX(0)))
    return ca.Function(f"undecided_{end}", [column for column, _ in columns], [ca.vertcat(*rows)])


def unmet(condition: Condition, slack: Array) -> Scalar:
    """Count the values of a condition that are outside its bounds by more than a slack; a nan is within none."""
    import casadi as ca

    count: Scalar = ca.SX(0)
    for value, low, high, room in zip(condition.g, condition.lower, condition.upper, slack, strict=True):
        if np.isfinite(low):
            count = count + ca.logic_not(value >= float(low - room))
        if np.isfinite(high):
            count = count + ca.logic_not(value <= float(high + room))
    return count
