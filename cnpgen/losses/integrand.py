"""The integrand: the step losses of one phase of one plan and their gradient, as SX.

Terms are the task loss and one per constraint of the problem, all times ``dt/ds = 1 /
r`` (paper, section on loss functions) and the quadrature weight of the node. A
condition ``lower <= g <= upper`` has the violation ``e = g - min(max(g, lower),
upper)``. ``Huber(e)`` is the paper's ``Huber(ReLU(.))`` of an inequality and its
``Huber(d)`` of an equality. Its derivative is e clipped to [-1, 1].
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import AnyArray
from cnpgen.errors import UsageError
from cnpgen.kernels.symbolic.linalg import dot
from cnpgen.kernels.symbolic.symbolic_state import (
    FrozenState,
    SymbolicState,
    time_derivatives,
)
from cnpgen.kernels.tape import Axes, GridSpec
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.objectives import ObjectiveTerm
from cnpgen.problems.problem import Problem
from cnpgen.problems.published_rules import load_rules
from cnpgen.robots.robot import Robot


@dataclass(frozen=True)
class Term:
    """A step loss."""

    value: Any  # an SX scalar
    # SX scalars with the derivatives of the loss with respect to them
    parts: list[tuple[Any, Any]]


def task_term(state: SymbolicState, objective: Sequence[ObjectiveTerm]) -> Term:
    """Return the step loss of the objective: ``1 + sum of weight_i size_i``.

    ``1 + eta kappa v^2`` in the paper.
    """
    import casadi as ca

    value = ca.SX(1)
    parts = []
    for term in objective:
        residuals = term.training_residuals(state)
        squares = dot(residuals, residuals)
        smoothing = (
            term.smoothing
            if term.training_smoothing is None
            else term.training_smoothing
        )
        # Smoothed norm sqrt(|e|^2 + s^2) - s, whose derivative by itself is the weight; a
        # square without smoothing, whose derivative by e is 2 weight e.
        if smoothing > 0:
            size = ca.sqrt(squares + smoothing**2) - smoothing
            parts.append((size, term.weight))
        else:
            size = squares
            parts += [(e, 2 * term.weight * e) for e in residuals]
        value += term.weight * size
    return Term(value, parts)


def constraint_term(
    conditions: Sequence[Condition], factor: Any, inset: Any, relaxation: Sequence[Any]
) -> Term:
    """Return the sum of Huber's losses of all conditions of a constraint.

    Limits shrink by a factor, toward their center if they are not symmetric to zero.
    Other bounds are moved inwards by an inset; equalities are unchanged. The bounds of
    every value are moved outwards by its relaxation, or None.
    """
    import casadi as ca

    value = ca.SX(0)
    parts = []
    for (g, lower, upper), width in zip(
        _bounded(conditions, factor, inset), relaxation, strict=True
    ):
        # e = g - nearest, the violation; 0 inside the bounds
        nearest = g
        if lower is not None:
            nearest = ca.fmax(nearest, lower if width is None else lower - width)
        if upper is not None:
            nearest = ca.fmin(nearest, upper if width is None else upper + width)
        # Huber(e) = h e - h^2 / 2 with h = clip(e, -1, 1): e^2 / 2, or |e| - 1/2 beyond 1
        derivative = ca.fmin(ca.fmax(g - nearest, -1), 1)
        value += derivative * (g - nearest - 0.5 * derivative)
        parts.append((g, derivative))
    return Term(value, parts)


def _bounded(
    conditions: Sequence[Condition], factor: Any, inset: Any
) -> Iterator[tuple[Any, Any, Any]]:
    """Yield values with their tightened bounds, None for a missing bound."""
    for condition in conditions:
        for g, low, high in zip(
            condition.g, condition.lower.tolist(), condition.upper.tolist(), strict=True
        ):
            if low == high:
                yield g, low, high
            elif condition.tolerance_kind != "limit":
                yield (
                    g,
                    low + inset if np.isfinite(low) else None,
                    high - inset if np.isfinite(high) else None,
                )
            elif np.isfinite(low) and np.isfinite(high):
                # Two-sided limits shrink toward their center: |g - c| <= factor h.
                center = (low + high) / 2
                half = (high - low) / 2
                yield g, center - half * factor, center + half * factor
            else:
                # A one-sided limit moves towards zero by the fraction (1 - factor) of
                # its size.
                reduction = 1 - factor
                yield (
                    g,
                    low + abs(low) * reduction if np.isfinite(low) else None,
                    high - abs(high) * reduction if np.isfinite(high) else None,
                )


# Kernels


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
    """The arguments of the kernels as SX columns, in order, with the axes of ``grid_specs``."""

    # p, p' and p'' [rad], n each, and p''' if the jerk is constrained
    path: tuple[Any, ...]
    rate: Any  # r and r' [1/s], and r'' if the jerk is constrained
    obstacle_poses: Any  # poses and sizes of the obstacles
    # Relaxation of the conditions with time-varying bounds, in their units.
    relaxation: Any
    node: Any  # quadrature weight
    # Factors of the limits of all constraints, then insets of the other bounds of all
    # constraints.
    tightening: Any
    weights: Any  # weight of every constraint (the paper's e^alpha)

    @property
    def columns(self) -> list[Any]:
        """All arguments."""
        return [
            *self.path,
            *(column for name, column in vars(self).items() if name != "path"),
        ]


def loss_values(robot: Robot, problem: Problem, *, form: str) -> Any:
    """Build ``inputs -> terms``: the summands of the quadrature, without the weights of constraints."""
    import casadi as ca

    inputs, state, terms = _stage(robot, problem, form)
    return ca.Function(
        "loss_values", inputs.columns, ca.cse(state.unfrozen([_stacked(inputs, terms)]))
    )


def loss_gradient(robot: Robot, problem: Problem, *, form: str) -> Any:
    """Build ``inputs -> (terms, d/dp, d/dp', ..., d/d(r, r', ...))`` of the weighted sum by reverse-mode AD."""
    import casadi as ca

    inputs, state, terms = _stage(robot, problem, form)
    n = robot.n
    step = inputs.node / inputs.rate[0]
    weights = [1.0, *ca.vertsplit(inputs.weights)]
    g = [part for term in terms for part, _ in term.parts]
    # Reverse mode: seeds are d(sum of weighted terms)/d(part), so that one product with
    # the transposed Jacobian of all parts gives the gradient in (p, p', ..., r, r', ...).
    seeds = [
        step * weight * partial
        for weight, term in zip(weights, terms, strict=True)
        for _, partial in term.parts
    ]
    # Densify: the gradient with respect to an argument that does not occur is zero, not
    # absent.
    states = ca.vertcat(*inputs.path, inputs.rate)
    width = len(inputs.path) * n
    gradient = ca.densify(ca.jtimes(ca.vertcat(*g), states, ca.vertcat(*seeds), True))
    total = sum(
        weight * term.value for weight, term in zip(weights, terms, strict=True)
    )
    # The factor dt/ds = 1 / r is no part: d(1 / r)/dr = -1 / r^2 times all terms.
    gradient[width] -= step / inputs.rate[0] * total
    parts = [gradient[first : first + n] for first in range(0, width, n)]
    results = state.unfrozen([_stacked(inputs, terms), *parts, gradient[width:]])
    return ca.Function("loss_gradient", inputs.columns, ca.cse(results))


def penalized_conditions(
    constraints: Iterable[Constraint], state: SymbolicState, form: str
) -> list[tuple[Constraint, tuple[Condition, ...]]]:
    """Return every constraint with the conditions that the loss penalizes."""
    if form == "paper":
        rules = load_rules(form)
        return [
            (constraint, rules.conditions(constraint, state))
            for constraint in constraints
        ]
    return [(constraint, constraint.penalized(state)) for constraint in constraints]


def has_time_varying_bound(constraint: Constraint) -> bool:
    """Return whether the bounds of a constraint depend on the phase."""
    return type(constraint).bound_relaxation is not Constraint.bound_relaxation


def time_varying_conditions(
    problem: Problem, robot: Robot, form: str
) -> list[tuple[Constraint, Condition]]:
    """Return the conditions with time-varying bounds, in the order of the kernel argument, with their constraints."""
    _, state = SymbolicState.of_symbols(
        robot, problem.obstacle, problem.object_size, problem.scene_width
    )
    pairs = penalized_conditions(
        filter(has_time_varying_bound, problem.constraint), state, form
    )
    return [
        (constraint, condition)
        for constraint, conditions in pairs
        for condition in conditions
    ]


def relaxation_of(
    time_varying: Sequence[tuple[Constraint, Condition]],
    s: NDArray[np.float64],
    start_tip: AnyArray,
) -> AnyArray:
    """Return the relaxation of the conditions of ``time_varying_conditions``, each in its unit, shape (values, K, N).

    It is that of motions that may start outside a constraint: at phases s, shape (K,),
    with positions of the tip at the start [m], shape (N, 3).

    Raises:
        UsageError: ``bound_relaxation`` of a constraint returns another shape than its
            contract states.
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


def _stage(
    robot: Robot, problem: Problem, form: str
) -> tuple[Inputs, FrozenState, list[Term]]:
    """Return the inputs, the state as a function of them, and the terms of the task and the constraints."""
    import casadi as ca

    sym = ca.SX.sym
    m = len(problem.constraint)
    path, rate, obstacle_poses, state = _state_on_path(robot, problem)
    pairs = penalized_conditions(problem.constraint, state, form)
    # Conditions in the order of the constraints; those with time-varying bounds take
    # the next entries of the argument ``relaxation``.
    sizes = [
        sum(len(condition.g) for condition in conditions) for _, conditions in pairs
    ]
    varying = [has_time_varying_bound(constraint) for constraint, _ in pairs]
    width = sum(size for size, varies in zip(sizes, varying, strict=True) if varies)
    relaxation = sym("relaxation", width)
    tightening = sym("tightening", 2 * m)
    inputs = Inputs(
        path,
        rate,
        obstacle_poses,
        relaxation,
        sym("node"),
        tightening,
        sym("weights", m),
    )
    unused = iter(ca.vertsplit(relaxation))
    terms = [task_term(state, problem.objective.terms)]
    for index, (_, conditions) in enumerate(pairs):
        values = [next(unused) if varying[index] else None for _ in range(sizes[index])]
        terms.append(
            constraint_term(
                conditions, tightening[index], tightening[m + index], values
            )
        )
    return inputs, state, terms


def _state_on_path(
    robot: Robot, problem: Problem
) -> tuple[tuple[Any, ...], Any, Any, FrozenState]:
    """Return the columns of path, rate and obstacle poses, and the state at one phase as a function of them."""
    import casadi as ca

    sym = ca.SX.sym
    n = robot.n
    orders = problem.path_orders
    path = tuple(sym("d" * order + "p", n) for order in range(orders))
    rate = sym("rate", orders - 1)
    obstacle_poses = sym("obstacle_poses", problem.scene_width)
    q, *derivatives = (ca.vertsplit(column) for column in path)
    dq, ddq, jerk = time_derivatives(derivatives, ca.vertsplit(rate))
    poses = ca.vertsplit(obstacle_poses)
    size = problem.object_size
    state = FrozenState(robot, q, dq, ddq, poses, problem.obstacle, size, jerk)
    return path, rate, obstacle_poses, state


def _stacked(inputs: Inputs, terms: list[Term]) -> Any:
    import casadi as ca

    return ca.vertcat(*[inputs.node / inputs.rate[0] * term.value for term in terms])
