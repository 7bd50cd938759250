"""What is integrated: the step losses of one phase of one plan and their gradient, as SX.

Terms are the task loss and one per constraint of the problem, all times ``dt/ds = 1 / r`` (paper, section on loss
functions) and the quadrature weight of the node.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cnpgen.kernels.symbolic.state import HeldState, SymbolicState, jerk_along
from cnpgen.kernels.tape import Axes, GridSpec
from cnpgen.losses.published import published
from cnpgen.losses.terms import Term, constraint_term, task_term
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import count_numbers

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot


def grid_specs(problem: Problem) -> tuple[GridSpec, GridSpec]:
    """Say what the arguments and results of ``loss_values`` and ``loss_gradient`` vary over."""
    point: Axes = "point"
    splines = (point,) * (problem.path_orders + 1)
    arguments: tuple[Axes, ...] = (*splines, "lane", "point", "node", "fixed", "fixed")
    return GridSpec(arguments, ("lane",)), GridSpec(arguments, ("lane", *splines))


def wider_argument(problem: Problem) -> int:
    """Say which argument of the kernels is the funnel."""
    return problem.path_orders + 2


@dataclass(frozen=True)
class Inputs:
    """The arguments of the kernels as SX columns, in order; ``grid_specs`` says what they vary over.

    Attributes:
        path: p, p' and p'' [rad], n each; p''', too, where the jerk is constrained.
        rate: r and r' [1/s], and r'' where the jerk is constrained.
        tops: The numbers of the obstacles.
        wider: How much wider than their bounds the conditions of constraints with a funnel are, in their units.
        node: The quadrature weight.
        tightening: For every constraint the factor of its limits, then for every one the inset of its other bounds.
        weights: The weight of every constraint (the paper's e^alpha).
    """

    path: tuple[Any, ...]
    rate: Any
    tops: Any
    wider: Any
    node: Any
    tightening: Any
    weights: Any

    @property
    def columns(self) -> list[Any]:
        """All of them."""
        return [*self.path, *(column for name, column in vars(self).items() if name != "path")]


def loss_values(robot: "Robot", problem: Problem, *, form: str) -> Any:
    """Build ``inputs -> terms``: what is summed over the nodes, without weights."""
    import casadi as ca

    inputs, state, terms = _stage(robot, problem, form)
    return ca.Function("loss_values", inputs.columns, ca.cse(state.released([_stacked(inputs, terms)])))


def loss_gradient(robot: "Robot", problem: Problem, *, form: str) -> Any:
    """Build ``inputs -> (terms, d/dp, d/dp', ..., d/d(r, r', ...))`` of the weighted sum, by the reverse mode."""
    import casadi as ca

    inputs, state, terms = _stage(robot, problem, form)
    n, step, weights = robot.n, inputs.node / inputs.rate[0], [1.0, *ca.vertsplit(inputs.weights)]
    g = [part for term in terms for part, _ in term.parts]
    seeds = [step * weight * slope for weight, term in zip(weights, terms, strict=True) for _, slope in term.parts]
    states, width = ca.vertcat(*inputs.path, inputs.rate), len(inputs.path) * n
    back = ca.densify(ca.jtimes(ca.vertcat(*g), states, ca.vertcat(*seeds), True))
    total = sum(weight * term.value for weight, term in zip(weights, terms, strict=True))
    back[width] -= step / inputs.rate[0] * total  # the factor 1 / r
    parts = [back[first : first + n] for first in range(0, width, n)]
    results = state.released([_stacked(inputs, terms), *parts, back[width:]])
    return ca.Function("loss_gradient", inputs.columns, ca.cse(results))


def stated(
    constraints: Iterable[Constraint], state: SymbolicState, form: str
) -> list[tuple[Constraint, tuple[Condition, ...]]]:
    """State what is penalised, constraint by constraint."""
    return [(each, published(each, state) if form == "paper" else each.penalised(state)) for each in constraints]


def has_funnel(constraint: Constraint) -> bool:
    """Whether motions may begin outside of a constraint."""
    return type(constraint).funnel is not Constraint.funnel


def _stage(robot: "Robot", problem: Problem, form: str) -> tuple[Inputs, HeldState, list[Term]]:
    """Return the inputs, the state at them, and the terms: task and constraints."""
    import casadi as ca

    sym, n, m = ca.SX.sym, robot.n, len(problem.constraint)
    orders = problem.path_orders
    p, dp, ddp, *_ = path = tuple(sym("d" * order + "p", n) for order in range(orders))
    rate = sym("rate", orders - 1)
    dq, ddq = dp * rate[0], ddp * (rate[0] * rate[0]) + dp * (rate[0] * rate[1])
    tops, size = sym("tops", count_numbers(problem.obstacle)), problem.object_size
    q_sx, dq_sx, ddq_sx, tops_sx = (ca.vertsplit(column) for column in (p, dq, ddq, tops))
    jerk = jerk_along([ca.vertsplit(column) for column in path[1:]], ca.vertsplit(rate))
    state = HeldState(robot, q_sx, dq_sx, ddq_sx, tops_sx, problem.obstacle, size, jerk)
    pairs = stated(problem.constraint, state, form)
    count = sum(len(condition.g) for each, conditions in pairs if has_funnel(each) for condition in conditions)
    wider, tightening = sym("wider", count), sym("tightening", 2 * m)
    inputs = Inputs(path, rate, tops, wider, sym("node"), tightening, sym("weights", m))
    free = iter(ca.vertsplit(wider))
    terms = [task_term(state, problem.objective.centrifugal)]
    for index, (each, conditions) in enumerate(pairs):
        funnel = [next(free) if has_funnel(each) else None for condition in conditions for _ in condition.g]
        terms.append(constraint_term(conditions, tightening[index], tightening[m + index], funnel))
    return inputs, state, terms


def _stacked(inputs: Inputs, terms: list[Term]) -> Any:
    import casadi as ca

    return ca.vertcat(*[inputs.node / inputs.rate[0] * term.value for term in terms])
