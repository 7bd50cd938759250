"""Newton's method for the hitting configuration: steps as SX functions.

Maximize ``f(q) = |J(q)^T d|^2 - |(q0 - q) / L|^2`` subject to ``FK(q) = p`` (reference
2, section on hitting): ``d`` is the unit hitting direction in the table plane, ``J``
the translational Jacobian of the tip, ``q0`` the home configuration, ``L`` the rated
joint velocities. The optimality conditions are solved in closed form: ``d^2 p / dq_j
dq_k = z_min(j,k) x J_max(j,k)``, hence gradient ``2 A a`` with ``a = J^T d`` and ``A_jk
= d . (z_min x J_max)``, and Hessian ``2 A A + 2 d . (dz_min x J_max + z_min x dJ_max)``
with ``dz``, ``dJ`` the derivatives along ``a``. The constraint is eliminated through
three basic joints, so that each step factorizes only a (n - 3) x (n - 3) matrix.

These joints must be free to move. If joints are held on their limits, the step is
computed in all joints. With ``J_F`` the Jacobian without the columns of held joints,
maximize ``g . s + s^T H s / 2`` subject to ``J_F s = p - FK(q)``. Adding a large
multiple of ``J_F^T J_F`` to ``-H`` changes no solution and makes it positive definite
near a solution. Two symmetric solves without pivoting then suffice.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.kinematics import Kinematics, forward_kinematics
from cnpgen.kernels.symbolic.linalg import (
    Scalar,
    Vec,
    add,
    cross,
    dot,
    factorize,
    gram,
    inverse3,
    scale,
    solve,
    substitute,
    subtract,
    symbols,
)
from cnpgen.robots.robot import Robot

MAX_NEWTON_STEP_RAD = 0.6  # Euclidean norm of one Newton step
# Minimum |pivot| of the reduced Hessian: every step is an ascent direction.
MIN_PIVOT = 1e-3
NEWTON_TOLERANCE_RAD = 1e-6  # length of the last step; convergence is quadratic
MAX_NEWTON_STEPS = 40
# Weight of J_F^T J_F relative to -H: both are in m^2/rad^2, and of order 1.
CONSTRAINT_WEIGHT = 1e3


def objective(robot: Robot) -> Any:
    """Build ``(q, d, q0) -> f``: the squared manipulability along d minus the penalty on the distance from q0."""
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    d_sx, d = direction_symbols(robot)
    home_sx, home = symbols("q0", robot.n)
    jacobian = forward_kinematics(robot.chain, q).jacobian
    # J^T d, the tip's velocity along d per joint velocity.
    gain = [along(d, column) for column in jacobian]
    away = [
        (b - a) / float(rated)
        for a, b, rated in zip(q, home, robot.rated_velocity, strict=True)
    ]
    return ca.Function(
        "objective", [q_sx, d_sx, home_sx], [dot(gain, gain) - dot(away, away)]
    )


def direction_symbols(robot: Robot) -> tuple[Any, Vec]:
    """Return the symbols of a hitting direction: x and y, and z if samples tilt the table."""
    return symbols("d", 3 if robot.parameters.tilts_table else 2)


def along(direction: Vec, vector: Vec) -> Scalar:
    """Return the component of a vector along a direction of 2 or 3 components."""
    return dot(direction, vector[: len(direction)])


@dataclass(frozen=True)
class Expansion:
    """Objective and constraint near a configuration.

    Attributes:
        kin: Positions and Jacobian there.
        gradient: Of f, n.
        direction: d, 3.
        gain: ``J^T d``, n.
        second: ``d^2 p / dq_j dq_k``, symmetric, n x n lists of 3.
        gain_gradient: ``A_jk = d . d^2 p / dq_j dq_k``, symmetric, n x n.
        weight: ``1 / L^2``, n.
    """

    kin: Kinematics
    gradient: Vec
    direction: Vec
    gain: Vec
    second: list[list[Vec]]
    gain_gradient: list[Vec]
    weight: list[float]

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.gain)

    def hessian(self, multiplier: Vec) -> list[list[Scalar]]:
        """Hessian of ``f - multiplier . FK``, full symmetric n x n."""
        kin = self.kin
        gain_gradient = self.gain_gradient
        axis_rates, column_rates = _rates(kin, self.gain)
        across = [cross(self.direction, axis) for axis in kin.axes]
        across_rate = [cross(self.direction, rate) for rate in axis_rates]
        hessian: list[list[Scalar]] = [[0.0] * self.n for _ in range(self.n)]
        # H_jk = 2 (A A)_jk + 2 d . (dz_j x J_k + z_j x dJ_k) - multiplier . d2p/dq_j dq_k,
        # with d . (u x v) = (d x u) . v, so that the cross products with d are shared.
        for j in range(self.n):
            for k in range(j, self.n):
                third = dot(across_rate[j], kin.jacobian[k]) + dot(
                    across[j], column_rates[k]
                )
                value = 2.0 * (dot(gain_gradient[j], gain_gradient[k]) + third) - dot(
                    multiplier, self.second[j][k]
                )
                hessian[j][k] = hessian[k][j] = (
                    value - 2.0 * self.weight[j] if j == k else value
                )
        return hessian


def expand(robot: Robot, q: Vec, d: Vec, home: Vec) -> Expansion:
    """Expand objective and constraint of an arm of revolute joints at q [rad], near home [rad], for a direction d."""
    kin = forward_kinematics(robot.chain, q)
    direction = [*d, 0.0] if len(d) == 2 else d
    weight = [1.0 / float(value) ** 2 for value in robot.rated_velocity]
    gain = [along(d, column) for column in kin.jacobian]
    pairs = range(robot.n)
    # z_min x J_max
    upper = {
        (j, k): cross(kin.axes[j], kin.jacobian[k])
        for j in pairs
        for k in pairs
        if j <= k
    }
    second = [[upper[min(j, k), max(j, k)] for k in pairs] for j in pairs]
    gain_gradient = [[along(d, entry) for entry in row] for row in second]
    gradient = [
        2.0 * dot(gain_gradient[j], gain) + 2.0 * weight[j] * (home[j] - q[j])
        for j in range(robot.n)
    ]
    return Expansion(kin, gradient, direction, gain, second, gain_gradient, weight)


def _rates(kin: Kinematics, rate: Vec) -> tuple[list[Vec], list[Vec]]:
    """Return the time derivatives of the joint axes and of the Jacobian's columns at given joint rates."""
    turning: Vec = [0.0, 0.0, 0.0]
    origin_rate: Vec = [0.0, 0.0, 0.0]
    previous: Vec = [0.0, 0.0, 0.0]
    # Forward recursion: joint j moves its origin with the angular velocity of the joints
    # before it, and dz/dt = omega x z, dJ/dt = dz/dt x (tip - o) + z x (d tip - d o).
    # Velocities of the tip and of the joint origins if the joints move at the rates.
    tip_rate = [dot([column[row] for column in kin.jacobian], rate) for row in range(3)]
    axis_rates = []
    column_rates = []
    for axis, origin, speed in zip(kin.axes, kin.origins, rate, strict=True):
        origin_rate = add(origin_rate, cross(turning, subtract(origin, previous)))
        previous = origin
        axis_rate = cross(turning, axis)
        axis_rates.append(axis_rate)
        lever = cross(axis_rate, subtract(kin.tip, origin))
        column_rates.append(add(lever, cross(axis, subtract(tip_rate, origin_rate))))
        turning = add(turning, scale(axis, speed))
    return axis_rates, column_rates


def newton_step(robot: Robot) -> Any:
    """Build one Newton step of an arm of revolute joints as an SX function ``(q, p, d, q0) -> (next q, |step|)``."""
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    p_sx, p = symbols("p", 3)
    home_sx, home = symbols("q0", robot.n)
    d_sx, d = direction_symbols(robot)
    here = expand(robot, q, d, home)
    following, length = shortened(
        q, _reduced_step(here, subtract(p, here.kin.tip), basic_joints(robot))
    )
    return ca.Function(
        "hitting_configuration", [q_sx, p_sx, d_sx, home_sx], [following, length]
    )


def shortened(q: Vec, step: Vec) -> tuple[Any, Scalar]:
    """Return ``q + step`` with the step shortened to ``MAX_NEWTON_STEP_RAD``, and the full length of the step."""
    import casadi as ca

    # A long step leaves the region in which the quadratic model holds.
    length = ca.sqrt(dot(step, step))
    factor = ca.fmin(1.0, MAX_NEWTON_STEP_RAD / ca.fmax(length, 1e-12))
    return ca.vertcat(*add(q, scale(step, factor))), length


def safeguard(pivot: Scalar) -> Scalar:
    """Return a positive pivot of the negative Hessian, at least ``MIN_PIVOT``."""
    import casadi as ca

    # |pivot| instead of pivot: where f is convex, the step goes uphill all the same.
    return ca.fmax(ca.fabs(pivot), MIN_PIVOT)


def _reduced_step(here: Expansion, miss: Vec, basic: tuple[int, int, int]) -> Vec:
    """Return the Newton step: basic joints correct the position, free joints follow the reduced Newton direction."""
    import casadi as ca

    n = here.n
    jacobian = here.kin.jacobian
    # Basic joints B solve the constraint: J_B s_B = miss - J_F s_F.
    inverse = inverse3([jacobian[j] for j in basic])
    # Multiplier of the constraint from the basic joints: J_B^T lambda = g_B.
    multiplier = [
        dot([inverse[b][row] for b in range(3)], [here.gradient[j] for j in basic])
        for row in range(3)
    ]
    null = _null_space(jacobian, inverse, basic)
    # Normal step: the basic joints alone remove the miss.
    normal: Vec = [0.0] * n
    for b, joint in enumerate(basic):
        normal[joint] = dot(inverse[b], miss)
    hessian = here.hessian(multiplier)
    curved = [[dot(row, column) for row in hessian] for column in null]  # H Z
    lower = [[-dot(null[i], curved[j]) for j in range(i + 1)] for i in range(len(null))]
    # Reduced system Z^T (-H) Z y = Z^T (g + H normal), of size n - 3.
    right = [
        dot(column, here.gradient) + dot(projected, normal)
        for column, projected in zip(null, curved, strict=True)
    ]
    climb = substitute(*factorize(lower, safeguard), right)
    step = normal
    for amount, column in zip(climb, null, strict=True):
        step = add(step, scale(column, amount))
    return [ca.SX(value) for value in step]


def _null_space(
    jacobian: list[Vec], inverse: list[Vec], basic: tuple[int, int, int]
) -> list[Vec]:
    """Return the columns of Z, one per free joint: it moves alone, and the basic joints keep the tip in place."""
    columns = []
    for j in range(len(jacobian)):
        if j not in basic:
            column: Vec = [0.0] * len(jacobian)
            # J z = 0: joint j moves by 1, and J_B z_B = -J_j.
            column[j] = 1.0
            for b, joint in enumerate(basic):
                column[joint] = -dot(inverse[b], jacobian[j])
            columns.append(column)
    return columns


def held_step(robot: Robot) -> Any:
    """Build one Newton step in the joints that are not held: ``((q, pull), p, d, q0, held) -> (next, |step|)``.

    ``held`` is 1 for joints that stay constant. ``pull`` is the gradient of the
    Lagrangian, an output that the step does not use.
    """
    import casadi as ca

    n = robot.n
    widths = (("state", 2 * n), ("p", 3), ("q0", n), ("held", n))
    (state_sx, state), (p_sx, p), (home_sx, home), (held_sx, held) = (
        symbols(*item) for item in widths
    )
    d_sx, d = direction_symbols(robot)
    q = state[:n]
    here = expand(robot, q, d, home)
    step, pull = _held_step(here, subtract(p, here.kin.tip), [1.0 - x for x in held])
    moved, length = shortened(q, step)
    following = ca.vertcat(moved, *pull)
    return ca.Function(
        "hitting_limits", [state_sx, p_sx, d_sx, home_sx, held_sx], [following, length]
    )


def _held_step(here: Expansion, miss: Vec, free: Vec) -> tuple[Vec, Vec]:
    """Return the Newton step in the joints with ``free`` 1, 0 in the others, and the gradient of the Lagrangian."""
    n, jacobian = here.n, here.kin.jacobian
    # Columns of held joints are zero: the others must meet the constraint.
    rows = [
        [column[row] * x for column, x in zip(jacobian, free, strict=True)]
        for row in range(3)
    ]
    gradient = [g * x for g, x in zip(here.gradient, free, strict=True)]
    # Least squares: lambda minimizes |J_F^T lambda - g_F|.
    multiplier = solve(gram(rows), [dot(row, gradient) for row in rows])
    pull = [
        g - dot(column, multiplier)
        for g, column in zip(here.gradient, jacobian, strict=True)
    ]
    hessian = here.hessian(multiplier)

    def stiff(i: int, j: int) -> Scalar:
        value = (
            CONSTRAINT_WEIGHT * dot([row[i] for row in rows], [row[j] for row in rows])
            - free[i] * free[j] * hessian[i][j]
        )
        # A held joint gets the equation s_i = 0.
        return value + (1.0 - free[i]) if i == j else value

    factors = factorize(
        [[stiff(i, j) for j in range(i + 1)] for i in range(n)], safeguard
    )
    # K = w J_F^T J_F - H_F and the right side g + w J_F^T miss; then correct the
    # constraint by (J_F K^-1 J_F^T) force = J_F step - miss.
    towards = [dot([row[j] for row in rows], miss) for j in range(n)]
    step = substitute(*factors, add(gradient, scale(towards, CONSTRAINT_WEIGHT)))
    spread = [substitute(*factors, row) for row in rows]
    lower = [[dot(rows[i], spread[j]) for j in range(i + 1)] for i in range(3)]
    force = solve(
        lower, [dot(row, step) - e for row, e in zip(rows, miss, strict=True)]
    )
    for amount, column in zip(force, spread, strict=True):
        step = subtract(step, scale(column, amount))
    return step, pull


def basic_joints(robot: Robot) -> tuple[int, int, int]:
    """Choose the three joints that eliminate the tip position.

    They maximize the median of ``|det J_B| / sqrt(det J J^T)`` over configurations near
    the base. (A few unusual configurations would determine the minimum.)
    """
    import pinocchio as pin

    random = np.random.default_rng(0)
    low = np.maximum(robot.home - 0.7, robot.position_lower)
    high = np.minimum(robot.home + 0.7, robot.position_upper)
    data = robot.model.createData()
    tip = robot.tip_frame
    frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    jacobians = np.array(
        [
            pin.computeFrameJacobian(
                robot.model, data, random.uniform(low, high), tip, frame
            )[:3]
            for _ in range(64)
        ]
    )
    # Volume spanned by all columns: the shares of three columns are at most 1
    # (Cauchy-Binet).
    volume = np.sqrt(np.linalg.det(jacobians @ jacobians.transpose(0, 2, 1)))

    def share(joints: tuple[int, ...]) -> float:
        return float(
            np.median(np.abs(np.linalg.det(jacobians[:, :, list(joints)])) / volume)
        )

    best = max(combinations(range(robot.n), 3), key=share)
    return best[0], best[1], best[2]
