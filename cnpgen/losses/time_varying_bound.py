"""Time-varying bounds at the nodes, for motions that may start outside a constraint."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.losses.integrand import has_time_varying_bound, penalized_conditions
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

Array = NDArray[Any]


@dataclass(frozen=True)
class TimeVaryingBound:
    """The conditions of a problem with time-varying bounds.

    Attributes:
        conditions: Conditions with their constraints, in the order of the argument of the loss kernels.
    """

    conditions: tuple[tuple[Constraint, Condition], ...]

    def relaxation(self, s: NDArray[np.float64], start_tip: Array) -> Array:
        """Return the relaxation of the bounds of every value, in its unit.

        Args:
            s: Phases, shape (K,).
            start_tip: Positions of the tip at the start [m], shape (N, 3).

        Returns:
            Shape (values, K, N).

        Raises:
            UsageError: ``bound_relaxation`` of a constraint returns another shape than its contract states.
        """
        rows = []
        for constraint, condition in self.conditions:
            relaxation = constraint.bound_relaxation(condition, s, start_tip)
            if relaxation.shape != (expected := (len(start_tip), len(s))):
                raise UsageError(
                    f"{type(constraint).__name__}.bound_relaxation must return an array of shape {expected}"
                    f" for {len(start_tip)} motions and {len(s)} phases, got {relaxation.shape}"
                )
            rows += [relaxation.T] * len(condition.g)
        return np.stack(rows) if rows else np.zeros((0, len(s), len(start_tip)))


def make_time_varying_bound(problem: Problem, robot: Robot, form: str) -> TimeVaryingBound:
    """Collect the conditions of a problem with time-varying bounds."""
    _, state = SymbolicState.of_symbols(robot, problem.obstacle, problem.object_size, problem.scene_width)
    pairs = penalized_conditions(filter(has_time_varying_bound, problem.constraint), state, form)
    flat = ((constraint, condition) for constraint, conditions in pairs for condition in conditions)
    return TimeVaryingBound(tuple(flat))
