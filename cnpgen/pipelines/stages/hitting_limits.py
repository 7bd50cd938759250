"""Hitting configurations on joint limits, computed by an active-set method.

The step of ``hitting_newton`` eliminates the constraint through three joints that must be free to move. Here any joint
may be held on its limit, so the step is computed in all joints. With ``J_F`` the Jacobian without the columns of held
joints, maximize ``g . s + s^T H s / 2`` subject to ``J_F s = p - FK(q)``. Adding a large multiple of ``J_F^T J_F`` to
``-H`` changes no solution and makes it positive definite near a solution. Two symmetric solves without pivoting then
suffice.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.symbolic.linalg import (
    Scalar,
    Vec,
    add,
    dot,
    factorize,
    gram,
    scale,
    solve,
    substitute,
    subtract,
    symbols,
)
from cnpgen.pipelines.stages.hitting_newton import (
    NEWTON_TOLERANCE_RAD,
    Expansion,
    direction_symbols,
    expand,
    safeguard,
    shortened,
)
from cnpgen.pipelines.stages.stage import Array
from cnpgen.robots.robot import Robot

CONSTRAINT_WEIGHT = 1e3  # weight of J_F^T J_F relative to -H: both are in m^2/rad^2, and of order 1


def within_limits(robot: Robot, kernel: Kernel, q: Array, *parameters: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Move optima outside joint limits to nearby optima within, by an active-set method with ``held_step``.

    Joints outside their limits are set to the limit and held. Joints that leave their limits after a solve for the
    others are held, too. Of the held joints with an inward gradient, the one with the largest is released. The optima q
    have shape (n, N) [rad]; positions, directions and homes are further arguments of the kernel.

    Returns:
        ``(q, found)``: configurations within the limits [rad], shape (n, N), and a mask of the optima, shape (N,).
    """
    low, high = robot.position_lower[:, None], robot.position_upper[:, None]
    side = np.where(q > high, 1.0, np.where(q < low, -1.0, 0.0))  # sign of the limit on which a joint is held, else 0
    q, left = np.clip(q, low, high), np.arange(q.shape[1])
    for _ in range(2 * robot.n):
        held = np.take(side, left, axis=1)
        state = np.concatenate([np.take(q, left, axis=1), np.zeros_like(held)])
        arguments = [np.take(values, left, axis=1) for values in parameters]
        state, step = kernel(state, *arguments, np.abs(held))
        moved, pull = np.split(state, 2)
        q[:, left] = np.clip(moved, low, high)
        change = _change(held, np.where(moved > high, 1.0, np.where(moved < low, -1.0, 0.0)), pull)
        side[:, left] = held + change
        left = left[(change != 0).any(0) | ~(step[0] < NEWTON_TOLERANCE_RAD)]
        if len(left) == 0:
            break
    found = np.ones(q.shape[1], bool)
    found[left] = False
    return q, found


def _change(held: Array, outside: Array, pull: Array) -> Array:
    """Return the change of the held sides: the side of a new hold, minus the side of a released hold, otherwise 0."""
    inwards = -held * pull
    released = (inwards == inwards.max(axis=0)) & (inwards > 0) & ~outside.any(axis=0)
    return np.where(released, -held, np.where(held == 0, outside, 0.0))


def held_step(robot: Robot) -> Any:
    """Build one Newton step in the joints that are not held: ``((q, pull), p, d, q0, held) -> (next, |step|)``.

    ``held`` is 1 for joints that stay constant. ``pull`` is the gradient of the Lagrangian, an output that the step
    does not use.
    """
    import casadi as ca

    n = robot.n
    widths = (("state", 2 * n), ("p", 3), ("q0", n), ("held", n))
    (state_sx, state), (p_sx, p), (home_sx, home), (held_sx, held) = (symbols(*item) for item in widths)
    d_sx, d = direction_symbols(robot)
    q = state[:n]
    here = expand(robot, q, d, home)
    step, pull = _step(here, subtract(p, here.kin.tip), [1.0 - x for x in held])
    moved, length = shortened(q, step)
    following = ca.vertcat(moved, *pull)
    return ca.Function("hitting_limits", [state_sx, p_sx, d_sx, home_sx, held_sx], [following, length])


def _step(here: Expansion, miss: Vec, free: Vec) -> tuple[Vec, Vec]:
    """Return the Newton step in the joints with ``free`` 1, 0 in the others, and the gradient of the Lagrangian."""
    n, jacobian = here.n, here.kin.jacobian
    rows = [[column[row] * x for column, x in zip(jacobian, free, strict=True)] for row in range(3)]
    gradient = [g * x for g, x in zip(here.gradient, free, strict=True)]
    multiplier = solve(gram(rows), [dot(row, gradient) for row in rows])
    pull = [g - dot(column, multiplier) for g, column in zip(here.gradient, jacobian, strict=True)]
    hessian = here.hessian(multiplier)

    def stiff(i: int, j: int) -> Scalar:
        value = (
            CONSTRAINT_WEIGHT * dot([row[i] for row in rows], [row[j] for row in rows])
            - free[i] * free[j] * hessian[i][j]
        )
        return value + (1.0 - free[i]) if i == j else value

    factors = factorize([[stiff(i, j) for j in range(i + 1)] for i in range(n)], safeguard)
    towards = [dot([row[j] for row in rows], miss) for j in range(n)]
    step = substitute(*factors, add(gradient, scale(towards, CONSTRAINT_WEIGHT)))
    spread = [substitute(*factors, row) for row in rows]
    lower = [[dot(rows[i], spread[j]) for j in range(i + 1)] for i in range(3)]
    force = solve(lower, [dot(row, step) - e for row, e in zip(rows, miss, strict=True)])
    for amount, column in zip(force, spread, strict=True):
        step = subtract(step, scale(column, amount))
    return step, pull
