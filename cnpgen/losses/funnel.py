"""How much wider than their bounds conditions are at the nodes, for motions that begin outside of a constraint."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.kernels.symbolic.state import SymbolicState
from cnpgen.losses.integrand import has_funnel, stated
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import count_numbers

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[Any]


@dataclass(frozen=True)
class Funnel:
    """The conditions of a problem that motions may begin outside of.

    Attributes:
        conditions: With their constraints, in the order of the loss kernels' argument.
    """

    conditions: tuple[tuple[Constraint, Condition], ...]

    def width(self, s: NDArray[np.float64], start_tip: Array) -> Array:
        """Compute how much wider every value's bounds are, in its unit.

        Args:
            s: Phases, shape (K,).
            start_tip: Positions of the tip at the start [m], shape (N, 3).

        Returns:
            Shape (values, K, N).

        Raises:
            UsageError: A constraint's funnel has another shape than its contract says.
        """
        rows = []
        for constraint, condition in self.conditions:
            wider = constraint.funnel(condition, s, start_tip)
            if wider.shape != (len(start_tip), len(s)):
                raise UsageError(
                    f"{type(constraint).__name__}.funnel must return an array of shape {(len(start_tip), len(s))}"
                    f" for {len(start_tip)} motions and {len(s)} phases, got {wider.shape}"
                )
            rows += [wider.T] * len(condition.g)
        return np.stack(rows) if rows else np.zeros((0, len(s), len(start_tip)))


def make_funnel(problem: Problem, robot: "Robot", form: str) -> Funnel:
    """Collect the conditions of a problem that motions may begin outside of."""
    import casadi as ca

    q, dq, ddq = (ca.vertsplit(ca.SX.sym(name, robot.n)) for name in ("q", "dq", "ddq"))
    tops = ca.vertsplit(ca.SX.sym("tops", count_numbers(problem.obstacle)))
    size = problem.object_size
    state = SymbolicState(robot, q, dq, ddq, tops, problem.obstacle, size)
    chosen = stated(filter(has_funnel, problem.constraint), state, form)
    return Funnel(tuple((constraint, condition) for constraint, conditions in chosen for condition in conditions))
