"""Hitting configurations on joint limits: where the optimum lies beyond a limit, the joint is held on it.

The step of ``hitting_newton`` eliminates the constraint through three joints that must be free to move. Here any joint
may be held, so the step is taken in all of them: with ``J_F`` the Jacobian without the columns of held joints,
maximise ``g . s + s^T H s / 2`` subject to ``J_F s = p - FK(q)``. Adding ``J_F^T J_F`` with a large factor to ``-H``
changes no solution and makes it positive definite near one, so that two symmetric solves without pivoting do.
"""

from typing import TYPE_CHECKING, Any

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
from cnpgen.pipelines.stages.hitting_newton import TOLERANCE, Expansion, expand, safeguard, shortened
from cnpgen.pipelines.stages.stage import Array

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

STIFFNESS = 1e3  # of J_F^T J_F beside -H: both are in m^2/rad^2, and of order 1


def within_limits(robot: "Robot", kernel: Kernel, q: Array, *parameters: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Move optima that are beyond joint limits to the nearest ones within, by an active-set method.

    Joints beyond their limits are put on them and held; whoever is beyond after solving for the others is held, too;
    of the joints that would rather move inwards the one that pulls most is let go.

    Args:
        robot: The robot.
        kernel: Of ``held_step``, iterated.
        q: Optima of the search without limits [rad], shape (n, N).
        parameters: Positions, directions and homes, as the kernel takes them.

    Returns:
        ``(q, found)``: configurations within the limits [rad], shape (n, N); whether each is an optimum, shape (N,).
    """
    low, high = robot.position_lower[:, None], robot.position_upper[:, None]
    side = np.where(q > high, 1.0, np.where(q < low, -1.0, 0.0))  # of the limits that joints are held on, else 0
    q, left = np.clip(q, low, high), np.arange(q.shape[1])
    for _ in range(2 * robot.n):
        held = np.take(side, left, axis=1)
        state = np.concatenate([np.take(q, left, axis=1), np.zeros_like(held)])
        given = [np.take(values, left, axis=1) for values in parameters]
        state, step = kernel(state, *given, np.abs(held))
        moved, pull = np.split(state, 2)
        q[:, left] = np.clip(moved, low, high)
        change = _change(held, np.where(moved > high, 1.0, np.where(moved < low, -1.0, 0.0)), pull)
        side[:, left] = held + change
        left = left[(change != 0).any(0) | ~(step[0] < TOLERANCE)]
        if len(left) == 0:
            break
    found = np.ones(q.shape[1], bool)
    found[left] = False
    return q, found


def _change(held: Array, beyond: Array, pull: Array) -> Array:
    """Say which joints are to be held, 1 or -1, or let go: 1 on a lower and -1 on an upper limit; 0 for the others."""
    inwards = -held * pull
    least = (inwards == inwards.max(axis=0)) & (inwards > 0) & ~beyond.any(axis=0)
    return np.where(least, -held, np.where(held == 0, beyond, 0.0))


def held_step(robot: "Robot") -> Any:
    """Build one Newton step in the joints that are not held: ``((q, pull), p, d, q0, held) -> (next, |step|)``.

    ``held`` is 1 for joints that stay where they are; ``pull`` is where the objective would move them, the tip staying
    at p: the derivative of the Lagrangian. It is computed, not used.

    Args:
        robot: The robot; every joint must be revolute.

    Returns:
        A ``casadi.Function`` with arguments of width 2 n, 3, 2, n, n.
    """
    import casadi as ca

    n = robot.n
    widths = (("state", 2 * n), ("p", 3), ("d", 2), ("q0", n), ("held", n))
    (state_sx, state), (p_sx, p), (d_sx, d), (home_sx, home), (held_sx, held) = (symbols(*item) for item in widths)
    q = state[:n]
    here = expand(robot, q, d, home)
    step, pull = _step(here, subtract(p, here.kin.tip), [1.0 - x for x in held])
    moved, length = shortened(q, step)
    following = ca.vertcat(moved, *pull)
    return ca.Function("hitting_limits", [state_sx, p_sx, d_sx, home_sx, held_sx], [following, length])


def _step(here: Expansion, miss: Vec, free: Vec) -> tuple[Vec, Vec]:
    """Newton step in the joints whose ``free`` is 1, 0 in those whose is 0; and the gradient of the Lagrangian."""
    n, jacobian = here.n, here.kin.jacobian
    rows = [[column[row] * x for column, x in zip(jacobian, free, strict=True)] for row in range(3)]
    gradient = [g * x for g, x in zip(here.gradient, free, strict=True)]
    multiplier = solve(gram(rows), [dot(row, gradient) for row in rows])
    pull = [g - dot(column, multiplier) for g, column in zip(here.gradient, jacobian, strict=True)]
    hessian = here.hessian(multiplier)

    def stiff(i: int, j: int) -> Scalar:
        value = STIFFNESS * dot([row[i] for row in rows], [row[j] for row in rows]) - free[i] * free[j] * hessian[i][j]
        return value + (1.0 - free[i]) if i == j else value

    factors = factorize([[stiff(i, j) for j in range(i + 1)] for i in range(n)], safeguard)
    towards = [dot([row[j] for row in rows], miss) for j in range(n)]
    step = substitute(*factors, add(gradient, scale(towards, STIFFNESS)))
    spread = [substitute(*factors, row) for row in rows]
    lower = [[dot(rows[i], spread[j]) for j in range(i + 1)] for i in range(3)]
    force = solve(lower, [dot(row, step) - e for row, e in zip(rows, miss, strict=True)])
    for amount, column in zip(force, spread, strict=True):
        step = subtract(step, scale(column, amount))
    return step, pull
