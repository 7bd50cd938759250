"""Residuals of a problem, and of a cost term in addition to the duration, at one phase, as SX functions of splines."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.documents import JsonObject
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import (
    FrozenState,
    SymbolicState,
    time_derivatives,
)
from cnpgen.problems.constraints.constraint import MIN_TOLERANCE
from cnpgen.problems.objectives import Centrifugal, ObjectiveTerm, read_objective
from cnpgen.problems.problem import Problem, resolved
from cnpgen.robots.robot import Robot
from cnpgen.schema import registry
from cnpgen.schema.catalogue import read_kind
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import stored_values

DISTANCE_SCALE_M = 0.1  # size of a residual of 1
# Tolerances; with fewer the merit function rejects steps for equalities that are met
# well enough.
EQUALITY_SCALE = 20


def stage_values(robot: Robot, problem: Problem) -> Any:
    """Build the function ``(w, obstacle_poses) -> g`` of all residuals at one phase, with ``w = (p, p', p'', r, r')``.

    With constraints of the jerk, ``w = (p, p', p'', p''', r, r', r'')``.
    """
    import casadi as ca

    columns, state, g = _stage(robot, problem)
    return ca.Function("stage_values", columns, state.unfrozen([ca.vertcat(*g)]))


def stage_jacobian(robot: Robot, problem: Problem) -> Any:
    """Build the function ``(w, obstacle_poses) -> (g, dg/dw)``, the Jacobian column by column."""
    import casadi as ca

    columns, state, g = _stage(robot, problem)
    residuals = ca.vertcat(*g)
    jacobian = ca.densify(ca.jacobian(residuals, columns[0]))
    outputs = ca.cse(state.unfrozen([residuals, ca.vec(jacobian)]))
    return ca.Function("stage_jacobian", columns, outputs)


def _stage(robot: Robot, problem: Problem) -> tuple[list[Any], FrozenState, list[Any]]:
    poses_sx, obstacle_poses = symbols("obstacle_poses", problem.scene_width)
    w_sx, (q, dq, ddq, jerk) = _motion(robot.n, problem.path_orders)
    state = FrozenState(
        robot, q, dq, ddq, obstacle_poses, problem.obstacle, problem.object_size, jerk
    )
    g = []
    for constraint in problem.constraint:
        for condition in constraint.symbolic(state):
            scales = residual_scale(
                condition.lower,
                condition.upper,
                constraint.tolerance,
                condition.tolerance_kind,
            )
            g += [
                value / float(scale)
                for value, scale in zip(condition.g, scales, strict=True)
            ]
    return [w_sx, poses_sx], state, g


def residual_scale(lower: Array, upper: Array, tolerance: float, kind: str) -> Array:
    """Return the scale of residuals: the limit itself, 20 tolerances of an equality, or 0.1 m of a distance."""
    if kind == "limit":
        return np.maximum(np.abs(lower), np.abs(upper))
    return np.where(
        lower == upper, EQUALITY_SCALE * max(tolerance, MIN_TOLERANCE), DISTANCE_SCALE_M
    )


def _motion(n: int, orders: int) -> tuple[Any, tuple[Any, ...]]:
    """Return w = (p, p', ..., r, r', ...) with so many orders of p, and the positions and their derivatives by time."""
    w_sx, w = symbols("w", orders * n + orders - 1)
    p, *path = (w[order * n : (order + 1) * n] for order in range(orders))
    return w_sx, (p, *time_derivatives(path, w[orders * n :]))


# Cost term


@dataclass(frozen=True)
class CostTerm:
    """Sum of the terms of an objective in addition to the duration."""

    terms: tuple[ObjectiveTerm, ...]  # of positive weight

    @property
    def tables(self) -> list[JsonObject]:
        """The kinds of the terms with their keys except the weight, JSON-able."""
        return [
            {key: value for key, value in resolved(term).items() if key != "weight"}
            for term in self.terms
        ]

    def groups(self, counts: Iterable[int]) -> Array:
        """Return number of residuals, smoothing and weight of every term, shape (terms, 3)."""
        rows = [
            (count, term.smoothing, term.weight)
            for count, term in zip(counts, self.terms, strict=True)
        ]
        return np.array(rows, float)

    def rate(self, e: Array, counts: Iterable[int]) -> Array:
        """Evaluate the weighted size rho of the residuals e, shape (m, K): shape (K,).

        ``counts`` are the numbers of residuals of every term.
        """
        rho = np.zeros(e.shape[1])
        first = 0
        for count, smoothing, weight in self.groups(counts).tolist():
            part = slice(first, first := first + int(count))
            squares = np.sum(e[part] * e[part], axis=0)
            # rho = w (sqrt(e.e + s^2) - s) or w e.e
            size = np.sqrt(squares + smoothing**2)
            rho += weight * (size - smoothing if smoothing > 0 else squares)
        return rho


def choose_cost_term(
    problem: Problem, objective: str = "time", weight: float | None = None
) -> CostTerm | None:
    """Return the cost term of an objective (``read_objective``), or None if its weight is 0.

    "time" is the problem's own objective. A weight replaces that of each term in
    ``objective``; of the problem's own objective, that of the centrifugal acceleration.
    """
    terms = read_objective(objective)
    if terms is None:
        terms = problem.objective.terms
        # The weight of the command replaces that of the centrifugal term; further terms
        # stay.
        if weight is not None:
            terms = (Centrifugal(weight=weight), *problem.objective.term)
    elif weight is not None:
        terms = tuple(replace(term, weight=weight) for term in terms)
    terms = tuple(term for term in terms if term.weight > 0)
    return CostTerm(terms) if terms else None


def cost_term_residuals(robot: Robot, terms: list[JsonObject]) -> Any:
    """Build ``w -> (e, de/dw)`` of ``CostTerm.tables``, column by column, with ``w = (p, ..., p''', r, r', r'')``."""
    import casadi as ca

    w_sx, state = _state(robot)
    residuals = ca.vertcat(
        *(e for term in _restored(terms) for e in term.residuals(state))
    )
    jacobian = ca.densify(ca.jacobian(residuals, w_sx))
    return ca.Function("cost_term", [w_sx], ca.cse([residuals, ca.vec(jacobian)]))


def residual_counts(robot: Robot, cost_term: CostTerm) -> tuple[int, ...]:
    """Return the number of residuals of every term."""
    _, state = _state(robot)
    return tuple(len(term.residuals(state)) for term in cost_term.terms)


def _state(robot: Robot) -> tuple[Any, SymbolicState]:
    w_sx, (q, dq, ddq, jerk) = _motion(robot.n, 4)
    return w_sx, SymbolicState(robot, q, dq, ddq, [], (), None, jerk)


def _restored(tables: list[JsonObject]) -> list[ObjectiveTerm]:
    """Return the terms of ``CostTerm.tables``, of weight 1."""
    keys = [
        {key: value for key, value in table.items() if key not in {"source", "package"}}
        for table in tables
    ]
    errors: list[str] = []
    with stored_values():
        return [
            read_kind(registry.OBJECTIVES, table, RecipeLocation(table["use"]), errors)
            for table in keys
        ]
