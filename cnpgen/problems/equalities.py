"""Conditions of a problem at a state as SX expressions, and the residuals of its equalities."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from cnpgen.problems.constraints.constraint import Condition
from cnpgen.problems.constraints.needs import symbolic_needs
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState


def equality_residuals(robot: Robot, problem: Problem) -> Any:
    """Build ``(q, obstacle_poses) -> (r, dr/dq)``: residuals of the equalities, Jacobian column by column."""
    import casadi as ca

    columns, state = state_of_symbols(robot, problem)
    rows = [
        value - float(target)
        for condition, needs in conditions_with_needs(problem, state, columns[1:-1])
        if needs == 0 and condition.is_equality
        for value, target in zip(condition.g, condition.lower, strict=True)
    ]
    residual = ca.vertcat(*rows) if rows else ca.SX(0, 1)
    jacobian = ca.densify(ca.jacobian(residual, columns[0]))
    return ca.Function("equality_residuals", [columns[0], columns[-1]], ca.cse([residual, ca.vec(jacobian)]))


def state_of_symbols(robot: Robot, problem: Problem) -> tuple[list[Any], "SymbolicState"]:
    """Return the columns q, dq, ddq, the jerk if it is constrained, and obstacle poses, and their state."""
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState

    scene = problem.obstacle, problem.object_size, problem.scene_width
    return SymbolicState.of_symbols(robot, *scene, uses_jerk=problem.uses_jerk)


def conditions_with_needs(
    problem: Problem, state: "SymbolicState", moving: Sequence[Any]
) -> list[tuple[Condition, int]]:
    """Return all constraints at a state, each with the highest derivative of q, of ``moving``, that it depends on."""
    conditions = [condition for constraint in problem.constraint for condition in constraint.symbolic(state)]
    return [(condition, symbolic_needs(condition, *moving)) for condition in conditions]
