"""Values of objectives of plans: the duration and the integrals of the terms, without their weights."""

from dataclasses import replace

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.solver.grid import make_grid
from cnpgen.refine.solver.residuals import (
    CostTerm,
    choose_cost_term,
    cost_term_residuals,
    residual_counts,
)
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments

CONSTRAINT_POINTS = 8  # of the grid, whose nodes of the cost are used only


@checked_arguments
def objective_values(plans: Plans, objective: str = "time") -> dict[str, Array]:
    """Evaluate an objective of plans.

    The integrals use the nodes of the refiner; their error is up to a few tenths of a
    percent.

    Args:
        plans: N plans.
        objective: See ``cnpgen.problems.objectives.read_objective``; "time" for the
            objective of the problem.

    Returns:
        ``time`` [s], and for every term its integral without the weight, shape (N,)
        each, in the unit of the term.

    Raises:
        UsageError: The objective is invalid.
    """
    values = {"time": np.asarray(plans.duration, float)}
    problem, robot = open_problem(plans.problem)
    cost_term = choose_cost_term(problem, objective)
    if cost_term is None:
        return values
    kernels = problem_kernels(problem, robot, *choose_backend("numpy"))
    residuals = kernels.load(cost_term_residuals, terms=cost_term.tables)
    counts = residual_counts(robot, cost_term)
    grid = make_grid(plans.motion.spec, CONSTRAINT_POINTS)
    control_points = zip(
        plans.path_control_points, plans.rate_control_points, strict=True
    )
    states = [grid.cost_bases.states(path, rate) for path, rate in control_points]
    e, _ = residuals(np.concatenate(states, axis=1))
    # Rows of w: p and three derivatives, n rows each, then r.
    rates = np.array([w[4 * robot.n] for w in states])
    first = 0
    for count, term in zip(counts, cost_term.terms, strict=True):
        # The integral over time is that over the phase, ds / r.
        size = CostTerm((replace(term, weight=1.0),)).rate(
            e[first : first + count], [count]
        )
        name = registry.name_of(registry.OBJECTIVES, type(term))
        number = sum(key.partition(" ")[0] == name for key in values)
        values[f"{name} {number + 1}" if number else name] = (
            size.reshape(rates.shape) / rates
        ) @ grid.cost_weights
        first += count
    return values
