"""The highest derivative of q that a condition depends on: found out from its forms, so that nobody declares it.

0 is a condition on positions, 1 one on velocities, too, 2 one on accelerations.
"""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.problems.constraints.constraint import Condition

if TYPE_CHECKING:
    from cnpgen.world.state import World


def symbolic_needs(condition: Condition, dq: Any, ddq: Any) -> int:
    """Say what a condition in symbolic form depends on.

    Args:
        condition: The condition.
        dq: SX column of the symbols that are in the velocities.
        ddq: Likewise of those that are in the accelerations alone.
    """
    import casadi as ca

    g = ca.SX(ca.vertcat(*condition.g))
    return next((order for order, column in ((2, ddq), (1, dq)) if ca.depends_on(g, column)), 0)


def measured_needs(forms: "Iterable[Callable[[World], Iterable[Condition]]]", world: "World") -> list[int]:
    """Say what conditions in measured form depend on, in their order: where dq is not a number, g is none, either.

    Args:
        forms: What evaluates them: ``measured`` of every constraint, or ``measured_at`` for an end.
        world: Where they are evaluated; it is left at rest in the base configuration.
    """
    n, tops = world.robot.n, np.zeros(len(world.obstacles))
    zero, unknown = np.zeros(n), np.full(n, np.nan)
    forms, lost = list(forms), []
    for dq, ddq in ((zero, unknown), (unknown, zero), (zero, zero)):
        world.set_state(world.robot.base, dq, ddq, tops)
        lost.append([int(np.isnan(np.array(each.g, float)).sum()) for form in forms for each in form(world)])
    return [2 if by_ddq > known else 1 if by_dq > known else 0 for by_ddq, by_dq, known in zip(*lost, strict=True)]
