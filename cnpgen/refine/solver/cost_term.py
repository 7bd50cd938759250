"""Cost terms in addition to the duration: the terms of an objective, as residuals with derivatives."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState, time_derivatives
from cnpgen.problems.objectives import Centrifugal, ObjectiveTerm, read_objective
from cnpgen.problems.problem import Problem, resolved
from cnpgen.robots.robot import Robot
from cnpgen.schema import registry
from cnpgen.schema.catalogue import read_kind
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import stored_values

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CostTerm:
    """Sum of the terms of an objective in addition to the duration."""

    terms: tuple[ObjectiveTerm, ...]  # the terms, of positive weight

    @property
    def tables(self) -> list[dict[str, Any]]:
        """The kinds of the terms with their keys except the weight, JSON-able."""
        return [{key: value for key, value in resolved(term).items() if key != "weight"} for term in self.terms]

    def groups(self, counts: Iterable[int]) -> Array:
        """Return number of residuals, smoothing and weight of every term, shape (terms, 3)."""
        rows = [(count, term.smoothing, term.weight) for count, term in zip(counts, self.terms, strict=True)]
        return np.array(rows, float)

    def rate(self, e: Array, counts: Iterable[int]) -> tuple[Array, Array]:
        """Evaluate the weighted size rho of the residuals e, shape (m, K), and its curvature.

        ``counts`` are the numbers of residuals of every term. The result is ``(rho, weight)``, shapes (K,) and (m, K):
        ``weight * e`` is the gradient of rho in e, and the diagonal matrix of ``weight`` bounds its Hessian from above.
        """
        rho, weights, first = np.zeros(e.shape[1]), np.empty(e.shape), 0
        for count, smoothing, weight in self.groups(counts).tolist():
            part = slice(first, first := first + int(count))
            squares = np.sum(e[part] * e[part], axis=0)
            size = np.sqrt(squares + smoothing**2)
            rho += weight * (size - smoothing if smoothing > 0 else squares)
            weights[part] = weight / size if smoothing > 0 else 2.0 * weight
        return rho, weights


def choose_cost_term(problem: Problem, objective: str = "time", weight: float | None = None) -> CostTerm | None:
    """Return the cost term of an objective (``read_objective``), or None if its weight is 0.

    "time" is the problem's own objective. A weight replaces that of each term in ``objective``; of the problem's own
    objective, that of the centrifugal acceleration.
    """
    terms = read_objective(objective)
    if terms is None:
        terms = problem.objective.terms
        if weight is not None:
            terms = (Centrifugal(weight=weight), *problem.objective.term)
    elif weight is not None:
        terms = tuple(replace(term, weight=weight) for term in terms)
    terms = tuple(term for term in terms if term.weight > 0)
    return CostTerm(terms) if terms else None


def cost_term_residuals(robot: Robot, terms: list[dict[str, Any]]) -> Any:
    """Build ``w -> (e, de/dw)`` of ``CostTerm.tables``, column by column, with ``w = (p, ..., p''', r, r', r'')``."""
    import casadi as ca

    w_sx, state = _state(robot)
    residuals = ca.vertcat(*(e for term in _restored(terms) for e in term.residuals(state)))
    jacobian = ca.densify(ca.jacobian(residuals, w_sx))
    return ca.Function("cost_term", [w_sx], ca.cse([residuals, ca.vec(jacobian)]))


def residual_counts(robot: Robot, cost_term: CostTerm) -> tuple[int, ...]:
    """Return the number of residuals of every term."""
    _, state = _state(robot)
    return tuple(len(term.residuals(state)) for term in cost_term.terms)


def _state(robot: Robot) -> tuple[Any, SymbolicState]:
    n = robot.n
    w_sx, w = symbols("w", 4 * n + 3)
    p, *path = (w[order * n : (order + 1) * n] for order in range(4))
    dq, ddq, jerk = time_derivatives(path, w[4 * n :])
    return w_sx, SymbolicState(robot, p, dq, ddq, [], (), None, jerk)


def _restored(tables: list[dict[str, Any]]) -> list[ObjectiveTerm]:
    """Return the terms of ``CostTerm.tables``, of weight 1."""
    keys = [{key: value for key, value in table.items() if key not in {"source", "package"}} for table in tables]
    mistakes: list[str] = []
    with stored_values():
        return [read_kind(registry.OBJECTIVES, table, RecipeLocation(table["use"]), mistakes) for table in keys]
