"""The highest derivative of q that a condition depends on: found out from its forms, so that nobody declares it.

0 is a condition on positions, 1 one on velocities, too, 2 one on accelerations.
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
    """Say what conditions in measured form depend on, in their order: what changes where dq or ddq does.

    They are asked where dq or ddq is not a number and, as a form may swallow that, where it is far below its limit,
    near it, and far above.

    Args:
        forms: What evaluates them: ``measured`` of every constraint, or ``measured_at`` for an end.
        world: Where they are evaluated; it is left at rest in the base configuration.
    """
    robot, forms = world.robot, list(forms)
    rest = np.zeros(robot.n)
    velocities = [rest + np.nan, *(share * robot.velocity_limit * _MIXED[: robot.n] for share in _SHARES)]
    accelerations = [rest + np.nan, *(share * robot.acceleration_limit * _MIXED[: robot.n] for share in _SHARES)]
    by_ddq = _changed(forms, world, [(rest, ddq) for ddq in accelerations])
    by_dq = _changed(forms, world, [(dq, rest) for dq in velocities])
    return [2 if second else 1 if first else 0 for first, second in zip(by_dq, by_ddq, strict=True)]


def _changed(
    forms: "Sequence[Callable[[World], Iterable[Condition]]]", world: "World", states: Iterable[tuple[Array, Array]]
) -> list[bool]:
    """Say which conditions have another value at one of the states than at rest; the world is left at rest."""
    tops, rest = place_obstacles(world.obstacles), np.zeros(world.robot.n)

    def values(dq: Array, ddq: Array) -> list[Array]:
        world.set_state(world.robot.base, dq, ddq, tops)
        return [np.array(each.g, float) for form in forms for each in form(world)]

    moving = [values(*state) for state in states]
    still = values(rest, rest)
    return [
        any(not np.array_equal(one[index], known, equal_nan=True) for one in moving)
        for index, known in enumerate(still)
    ]
