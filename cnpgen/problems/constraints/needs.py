"""The highest derivative of q that a condition depends on: found out from its forms, so that nobody declares it.

0 is a condition on positions, 1 one on velocities, too, 2 one on accelerations, 3 one on jerks.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import Condition
from cnpgen.robots.solid import place_obstacles

if TYPE_CHECKING:
    from cnpgen.world.state import World

Array = NDArray[np.float64]

_SHARES = (0.1, 0.9, 10.0)  # of the limits
_MIXED = np.cos(np.arange(64.0))  # joints move to both sides, none at the speed of another


def symbolic_needs(condition: Condition, *derivatives: Any) -> int:
    """Say what a condition in symbolic form depends on.

    Args:
        condition: The condition.
        derivatives: SX columns: of the symbols that are in the velocities, of those that are in the accelerations
            alone and, where states have jerks, of those that are in these alone.
    """
    import casadi as ca

    g = ca.SX(ca.vertcat(*condition.g))
    orders = range(len(derivatives), 0, -1)
    return next((order for order in orders if ca.depends_on(g, derivatives[order - 1])), 0)


def measured_needs(
    forms: "Iterable[Callable[[World], Iterable[Condition]]]", world: "World", *, jerk: bool = False
) -> list[int]:
    """Say what conditions in measured form depend on, in their order: what changes where dq, ddq or the jerk does.

    They are asked where one of these is not a number and, as a form may swallow that, where it is far below its limit,
    near it, and far above.

    Args:
        forms: What evaluates them: ``measured`` of every constraint, or ``measured_at`` for an end.
        world: Where they are evaluated; it is left at rest in the base configuration.
        jerk: Whether states have jerks: those of motions do, boundary states do not.
    """
    robot, forms = world.robot, list(forms)
    limits = [robot.velocity_limit, robot.acceleration_limit, *([robot.jerk_limit] if jerk else [])]
    rest = [np.zeros(robot.n) for _ in limits]
    changed = []
    for order, limit in enumerate(limits):
        moving = [limit + np.nan, *(share * limit * _MIXED[: robot.n] for share in _SHARES)]
        changed.append(_changed(forms, world, [[*rest[:order], each, *rest[order + 1 :]] for each in moving]))
    return [max(order for order, yes in enumerate((True, *each)) if yes) for each in zip(*changed, strict=True)]


def _changed(
    forms: "Sequence[Callable[[World], Iterable[Condition]]]", world: "World", states: Sequence[Sequence[Array]]
) -> list[bool]:
    """Say which conditions have another value at one of the states than at rest; the world is left at rest."""
    tops, rest = place_obstacles(world.obstacles), [np.zeros(world.robot.n) for _ in states[0]]

    def values(dq: Array, ddq: Array, jerk: Array | None = None) -> list[Array]:
        world.set_state(world.robot.base, dq, ddq, tops, jerk)
        return [np.array(each.g, float) for form in forms for each in form(world)]

    moving = [values(*state) for state in states]
    still = values(*rest)
    return [
        any(not np.array_equal(one[index], known, equal_nan=True) for one in moving)
        for index, known in enumerate(still)
    ]
