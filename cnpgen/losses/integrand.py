"""The integrand: the step losses of one phase of one plan and their gradient, as SX.

Terms are the task loss and one per constraint of the problem, all times ``dt/ds = 1 / r`` (paper, section on loss
functions) and the quadrature weight of the node.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.kernels.symbolic.symbolic_state import FrozenState, SymbolicState, time_derivatives
from cnpgen.kernels.tape import Axes, GridSpec
from cnpgen.losses.published_conditions import published_conditions
from cnpgen.losses.terms import Term, constraint_term, task_term
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

Array = NDArray[Any]


def grid_specs(problem: Problem) -> tuple[GridSpec, GridSpec]:
    """Return the axes of the arguments and results of ``loss_values`` and ``loss_gradient``."""
    point: Axes = "point"
    splines = (point,) * (problem.path_orders + 1)
    arguments: tuple[Axes, ...] = (*splines, "lane", "point", "node", "fixed", "fixed")
    return GridSpec(arguments, ("lane",)), GridSpec(arguments, ("lane", *splines))


def relaxation_argument(problem: Problem) -> int:
    """Return the index of the kernel argument with the relaxation of time-varying bounds."""
    return problem.path_orders + 2


@dataclass(frozen=True)
class Inputs:
    """The arguments of the kernels as SX columns, in order, with the axes of ``grid_specs``.

    Attributes:
        path: p, p' and p'' [rad], n each, and p''' if the jerk is constrained.
        rate: r and r' [1/s], and r'' if the jerk is constrained.
        obstacle_poses: Poses and sizes of the obstacles.
        relaxation: Relaxation of the conditions with time-varying bounds, in their units.
        node: Quadrature weight.
        tightening: Factors of the limits of all constraints, then insets of the other bounds of all constraints.
        weights: Weight of every constraint (the paper's e^alpha).
    """

    path: tuple[Any, ...]
    rate: Any
    obstacle_poses: Any
    relaxation: Any
    node: Any
    tightening: Any
    weights: Any

    @property
    def columns(self) -> list[Any]:
        """All arguments."""
        return [*self.path, *(column for name, column in vars(self).items() if name != "path")]


def loss_values(robot: Robot, problem: Problem, *, form: str) -> Any:
    """Build ``inputs -> terms``: the summands of the quadrature, without the weights of constraints."""
    import casadi as ca

    inputs, state, terms = _stage(robot, problem, form)
    return ca.Function("loss_values", inputs.columns, ca.cse(state.unfrozen([_stacked(inputs, terms)])))


def loss_gradient(robot: Robot, problem: Problem, *, form: str) -> Any:
    """Build ``inputs -> (terms, d/dp, d/dp', ..., d/d(r, r', ...))`` of the weighted sum by reverse-mode AD."""
    import casadi as ca

    inputs, state, terms = _stage(robot, problem, form)
    n, step, weights = robot.n, inputs.node / inputs.rate[0], [1.0, *ca.vertsplit(inputs.weights)]
    g = [part for term in terms for part, _ in term.parts]
    seeds = [step * weight * partial for weight, term in zip(weights, terms, strict=True) for _, partial in term.parts]
    states, width = ca.vertcat(*inputs.path, inputs.rate), len(inputs.path) * n
    gradient = ca.densify(ca.jtimes(ca.vertcat(*g), states, ca.vertcat(*seeds), True))
    total = sum(weight * term.value for weight, term in zip(weights, terms, strict=True))
    gradient[width] -= step / inputs.rate[0] * total  # the factor 1 / r
    parts = [gradient[first : first + n] for first in range(0, width, n)]
    results = state.unfrozen([_stacked(inputs, terms), *parts, gradient[width:]])
    return ca.Function("loss_gradient", inputs.columns, ca.cse(results))


def penalized_conditions(
    constraints: Iterable[Constraint], state: SymbolicState, form: str
) -> list[tuple[Constraint, tuple[Condition, ...]]]:
    """Return every constraint with the conditions that the loss penalizes."""
    if form == "paper":
        return [(constraint, published_conditions(constraint, state)) for constraint in constraints]
    return [(constraint, constraint.penalized(state)) for constraint in constraints]


def has_time_varying_bound(constraint: Constraint) -> bool:
    """Return whether the bounds of a constraint depend on the phase."""
    return type(constraint).bound_relaxation is not Constraint.bound_relaxation


def time_varying_conditions(problem: Problem, robot: Robot, form: str) -> list[tuple[Constraint, Condition]]:
    """Return the conditions with time-varying bounds, in the order of the kernel argument, with their constraints."""
    _, state = SymbolicState.of_symbols(robot, problem.obstacle, problem.object_size, problem.scene_width)
    pairs = penalized_conditions(filter(has_time_varying_bound, problem.constraint), state, form)
    return [(constraint, condition) for constraint, conditions in pairs for condition in conditions]


def relaxation_of(
    time_varying: Sequence[tuple[Constraint, Condition]], s: NDArray[np.float64], start_tip: Array
) -> Array:
    """Return the relaxation of time-varying bounds, of motions that may start outside a constraint.

    Args:
        time_varying: The conditions of ``time_varying_conditions``.
        s: Phases, shape (K,).
        start_tip: Positions of the tip at the start [m], shape (N, 3).

    Returns:
        Relaxation of every value in its unit, shape (values, K, N).

    Raises:
        UsageError: ``bound_relaxation`` of a constraint returns another shape than its contract states.
    """
    rows = []
    for constraint, condition in time_varying:
        relaxation = constraint.bound_relaxation(condition, s, start_tip)
        if relaxation.shape != (expected := (len(start_tip), len(s))):
            raise UsageError(
                f"{type(constraint).__name__}.bound_relaxation must return an array of shape {expected}"
                f" for {len(start_tip)} motions and {len(s)} phases, got {relaxation.shape}"
            )
        rows += [relaxation.T] * len(condition.g)
    return np.stack(rows)


def _stage(robot: Robot, problem: Problem, form: str) -> tuple[Inputs, FrozenState, list[Term]]:
    """Return the inputs, the state as a function of them, and the terms of the task and the constraints."""
    import casadi as ca

    sym, n, m = ca.SX.sym, robot.n, len(problem.constraint)
    orders = problem.path_orders
    path = tuple(sym("d" * order + "p", n) for order in range(orders))
    rate = sym("rate", orders - 1)
    obstacle_poses, size = sym("obstacle_poses", problem.scene_width), problem.object_size
    q, *derivatives = (ca.vertsplit(column) for column in path)
    dq, ddq, jerk = time_derivatives(derivatives, ca.vertsplit(rate))
    state = FrozenState(robot, q, dq, ddq, ca.vertsplit(obstacle_poses), problem.obstacle, size, jerk)
    pairs = penalized_conditions(problem.constraint, state, form)
    sizes = [sum(len(condition.g) for condition in conditions) for _, conditions in pairs]
    varying = [has_time_varying_bound(constraint) for constraint, _ in pairs]
    relaxation = sym("relaxation", sum(size for size, varies in zip(sizes, varying, strict=True) if varies))
    tightening = sym("tightening", 2 * m)
    inputs = Inputs(path, rate, obstacle_poses, relaxation, sym("node"), tightening, sym("weights", m))
    unused = iter(ca.vertsplit(relaxation))
    terms = [task_term(state, problem.objective.terms)]
    for index, (_, conditions) in enumerate(pairs):
        values = [next(unused) if varying[index] else None for _ in range(sizes[index])]
        terms.append(constraint_term(conditions, tightening[index], tightening[m + index], values))
    return inputs, state, terms


def _stacked(inputs: Inputs, terms: list[Term]) -> Any:
    import casadi as ca

    return ca.vertcat(*[inputs.node / inputs.rate[0] * term.value for term in terms])
