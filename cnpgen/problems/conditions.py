"""Conditions of a problem at a state, their derivative orders, and the residuals of those that are projected.

The derivative order is the highest derivative of q that a condition depends on, derived
from its forms. It is 0 for positions, 1 for velocities, 2 for accelerations and 3 for
jerks.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.problems.constraints.constraint import Condition
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import place_obstacles

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.world.world import World

_SHARES = (0.1, 0.9, 10.0)  # fractions of the limits
_MIXED = np.cos(np.arange(64.0))  # both signs and distinct magnitudes
# (structure of a problem, form, whether jerks count) -> result of ``condition_orders``.
_ORDERS: dict[tuple[str, str, bool], list[int]] = {}


def symbolic_needs(condition: Condition, *derivatives: Any) -> int:
    """Return the derivative order of a condition, from SX columns of velocities, accelerations and maybe jerks."""
    import casadi as ca

    g = ca.SX(ca.vertcat(*condition.g))
    # From the highest derivative down: the first that g depends on is its order.
    orders = range(len(derivatives), 0, -1)
    return next(
        (order for order in orders if ca.depends_on(g, derivatives[order - 1])), 0
    )


def measured_needs(
    forms: "Iterable[Callable[[World], Iterable[Condition]]]",
    world: "World",
    *,
    jerk: bool = False,
) -> list[int]:
    """Return the derivative orders of conditions in measured form: which of dq, ddq and the jerk change their values.

    The conditions are evaluated with one of these nan and, since a form may ignore nan,
    far below, near and far above its limit. The world is left at rest in the base
    configuration. Boundary states have no jerk.
    """
    robot = world.robot
    forms = list(forms)
    limits = [
        robot.velocity_limit,
        robot.acceleration_limit,
        *([robot.jerk_limit] if jerk else []),
    ]
    rest = [np.zeros(robot.n) for _ in limits]
    changed = []
    for order, limit in enumerate(limits):
        # All other derivatives stay zero, so that a change belongs to this order.
        moving = [
            limit + np.nan,
            *(share * limit * _MIXED[: robot.n] for share in _SHARES),
        ]
        changed.append(
            _changed(
                forms,
                world,
                [[*rest[:order], each, *rest[order + 1 :]] for each in moving],
            )
        )
    return [
        max(order for order, yes in enumerate((True, *each)) if yes)
        for each in zip(*changed, strict=True)
    ]


def condition_orders(
    problem: Problem, world: "World", form: str, *, jerk: bool = False
) -> list[int]:
    """Return the derivative orders of the conditions of a problem, in the form "solved" or "judged".

    Problems that differ only in poses and sizes of obstacles share the result, see
    ``measured_needs``. The world is left at rest in the base configuration.
    """
    structure = problem.structure
    key = None if structure is None else (structure, form, jerk)
    if key not in _ORDERS:
        forms = [getattr(constraint, form) for constraint in problem.constraint]
        orders = measured_needs(forms, world, jerk=jerk)
        if key is None:
            return orders
        _ORDERS[key] = orders
    rest = [np.zeros(world.robot.n)] * (3 if jerk else 2)
    poses = place_obstacles(world.obstacles)
    world.set_state(world.robot.home, rest[0], rest[1], poses, *rest[2:])
    return _ORDERS[key]


def _changed(
    forms: "Sequence[Callable[[World], Iterable[Condition]]]",
    world: "World",
    states: Sequence[Sequence[Array]],
) -> list[bool]:
    """Return which conditions differ between one of the states and rest.

    The world is left at rest.
    """
    obstacle_poses = place_obstacles(world.obstacles)
    rest = [np.zeros(world.robot.n) for _ in states[0]]

    def values(dq: Array, ddq: Array, jerk: Array | None = None) -> list[Array]:
        world.set_state(world.robot.home, dq, ddq, obstacle_poses, jerk)
        return [np.array(each.g, float) for form in forms for each in form(world)]

    moving = [values(*state) for state in states]
    still = values(*rest)
    return [
        any(not np.array_equal(one[index], known, equal_nan=True) for one in moving)
        for index, known in enumerate(still)
    ]


def equality_residuals(robot: Robot, problem: Problem) -> Any:
    """Build ``(q, obstacle_poses) -> (r, dr/dq)``: residuals of the equalities, Jacobian column by column.

    Projected inequalities have their signed violation as residual, which is 0 inside.
    """
    import casadi as ca

    columns, state = state_of_symbols(robot, problem)
    rows = [
        _violation(value, float(low), float(high))
        for condition, needs in conditions_with_needs(problem, state, columns[1:-1])
        # Only conditions of positions can be met by a change of q.
        if needs == 0 and (condition.is_equality or condition.projected)
        for value, low, high in zip(
            condition.g, condition.lower, condition.upper, strict=True
        )
    ]
    residual = ca.vertcat(*rows) if rows else ca.SX(0, 1)
    jacobian = ca.densify(ca.jacobian(residual, columns[0]))
    return ca.Function(
        "equality_residuals",
        [columns[0], columns[-1]],
        ca.cse([residual, ca.vec(jacobian)]),
    )


def _violation(value: Any, low: float, high: float) -> Any:
    """Return the signed violation of ``low <= value <= high``, or the error of an equality."""
    import casadi as ca

    if low == high:
        return value - low
    # min(g - low, 0) + max(g - high, 0); an infinite bound adds no term.
    below = ca.fmin(value - low, 0) if np.isfinite(low) else 0.0
    return below + (ca.fmax(value - high, 0) if np.isfinite(high) else 0.0)


def state_of_symbols(
    robot: Robot, problem: Problem
) -> tuple[list[Any], "SymbolicState"]:
    """Return the columns q, dq, ddq, the jerk if it is constrained, and obstacle poses, and their state."""
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState

    scene = problem.obstacle, problem.object_size, problem.scene_width
    return SymbolicState.of_symbols(robot, *scene, uses_jerk=problem.uses_jerk)


def conditions_with_needs(
    problem: Problem, state: "SymbolicState", moving: Sequence[Any]
) -> list[tuple[Condition, int]]:
    """Return all constraints at a state, each with the highest derivative of q, of ``moving``, that it depends on."""
    conditions = [
        condition
        for constraint in problem.constraint
        for condition in constraint.symbolic(state)
    ]
    return [(condition, symbolic_needs(condition, *moving)) for condition in conditions]
