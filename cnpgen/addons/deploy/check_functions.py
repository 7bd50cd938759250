"""Build the CasADi functions of the check: the largest violation of every constraint at a phase of a motion.

Conditions that depend on velocity and those on positions are separate functions: the
latter include clearances, which take most of the time, and are evaluated at fewer
phases.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from cnpgen.errors import UsageError
from cnpgen.kernels.symbolic.linalg import Vec, symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState, time_derivatives
from cnpgen.problems.conditions import conditions_with_needs
from cnpgen.problems.constraints.constraint import (
    MIN_TOLERANCE,
    Condition,
    Constraint,
)
from cnpgen.problems.constraints.tip_manifold import BOUND_KINKS, TipManifold
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot


def moving_violations(robot: Robot, problem: Problem) -> Any:
    """Build ``(p, p', ..., r, r', obstacle poses, in one column) -> violations``, one per ``checked(moving=True)``.

    Each is the largest violation of the conditions of one constraint that depend on
    velocity, in tolerances of valid motions.
    """
    import casadi as ca

    columns, state, moving = _state_on_path(robot, problem)
    rows = [row for _, row in _worst(problem, state, moving, True)]
    return ca.Function(
        "moving_violations", [ca.vertcat(*columns)], ca.cse([_column(rows)])
    )


def position_violations(robot: Robot, problem: Problem) -> Any:
    """Build ``(p, s, scene, in one column) -> violations``, one per ``checked(moving=False)``.

    ``s`` is the phase, and the scene that of ``task``.
    """
    import casadi as ca

    columns, state, moving = _state_on_path(robot, problem)
    phase_sx, (phase,) = symbols("s", 1)
    off_sx, off = symbols("off", len(relaxed(problem)))
    relaxation = {
        index: value * _opening(phase)
        # Relaxations are inputs: they depend on the start, not on the phase.
        for index, value in zip(relaxed(problem), off, strict=True)
    }
    rows = [row for _, row in _worst(problem, state, moving, False, relaxation)]
    inputs = ca.vertcat(columns[0], phase_sx, columns[-1], off_sx)
    return ca.Function("position_violations", [inputs], ca.cse([_column(rows)]))


def relaxed(problem: Problem) -> list[int]:
    """Return the indices of the constraints whose bounds are relaxed for a start off the manifold.

    Raises:
        UsageError: Another kind than those of this package relaxes its bounds.
    """
    indices = []
    for index, constraint in enumerate(problem.constraint):
        if not _relaxes(constraint):
            continue
        if not isinstance(constraint, TipManifold):
            raise UsageError(
                f"{type(constraint).__name__} relaxes its bounds along the path, which C planners do not compute"
            )
        indices += [index] if constraint.band > 0 else []
    return indices


def _relaxes(constraint: Constraint) -> bool:
    return type(constraint).bound_relaxation is not Constraint.bound_relaxation


def _opening(phase: Any) -> Any:
    """Return the fraction of a relaxation at a phase: 1 until the first kink, 0 from the second one on."""
    import casadi as ca

    first, last = BOUND_KINKS
    return ca.fmin(ca.fmax((last - phase) / (last - first), 0.0), 1.0)


def checked(robot: Robot, problem: Problem, *, moving: bool) -> list[int]:
    """Return the indices of the constraints that have a row in the violations of moving, or of still, conditions."""
    _, state, derivatives = _state_on_path(robot, problem)
    return [index for index, _ in _worst(problem, state, derivatives, moving)]


def _state_on_path(
    robot: Robot, problem: Problem
) -> tuple[list[Any], SymbolicState, list[Any]]:
    """Return the columns of ``moving_violations``, the state, and the columns that make it move."""
    import casadi as ca

    orders = problem.path_orders
    names = (*(f"p{order}" for order in range(orders)), "rates", "obstacle_poses")
    widths = (*[robot.n] * orders, orders - 1, problem.scene_width)
    columns, scalars = zip(*map(symbols, names, widths), strict=True)
    p, *path, rate, poses = scalars
    # Derivatives by time follow from those by the phase and from r = ds/dt.
    dq, ddq, jerk = time_derivatives(path, rate)
    state = SymbolicState(
        robot, p, dq, ddq, poses, problem.obstacle, problem.object_size, jerk
    )
    # A condition depends on velocity if it depends on one of these columns.
    moving = [
        ca.vertcat(columns[order], columns[orders][order - 1])
        for order in range(1, orders)
    ]
    return list(columns), state, moving


def _worst(
    problem: Problem,
    state: SymbolicState,
    derivatives: list[Any],
    moving: bool,
    relaxation: Mapping[int, Any] | None = None,
) -> Iterator[tuple[int, Any]]:
    """Yield index and largest violation of each constraint with conditions that depend on velocity, or do not."""
    import casadi as ca

    for index, constraint in enumerate(problem.constraint):
        # Constraints are evaluated alone, so that each has a row of its own.
        alone = replace(problem, constraint=(constraint,))
        violations = [
            violation
            for condition, needs in conditions_with_needs(alone, state, derivatives)
            if bool(needs) == moving
            for violation in _violations(
                constraint, condition, (relaxation or {}).get(index, 0.0)
            )
        ]
        if violations:
            yield index, reduce(ca.fmax, violations)


def _violations(
    constraint: Constraint, condition: Condition, relaxation: Any
) -> list[Any]:
    """Return the violations of a condition's finite bounds, in tolerances of valid motions.

    The relaxation [m] is that of the condition that keeps the tip on a manifold.
    """
    held = (
        isinstance(constraint, TipManifold) and condition.name == constraint.held_name
    )
    relaxed_by = relaxation if held else 0.0
    # Valid motions may use the tolerance, which is 1 in these units.
    # Products take a fifth of the time of quotients.
    per_unit = 1 / np.maximum(constraint.allowed(condition), MIN_TOLERANCE)
    violations = []
    for value, low, high, factor in zip(
        condition.g, condition.lower, condition.upper, per_unit.tolist(), strict=True
    ):
        violations += (
            [(float(low) - value - relaxed_by) * factor] if np.isfinite(low) else []
        )
        violations += (
            [(value - float(high) - relaxed_by) * factor] if np.isfinite(high) else []
        )
    return violations


def _column(values: Vec) -> Any:
    import casadi as ca

    # Structural zeros are outputs, too: rows keep their numbers.
    return ca.densify(ca.vertcat(*values)) if values else ca.SX(0, 1)
