"""The hitting configuration: the joint positions at the puck from which the mallet can move fastest along the hit.

Maximise ``f(q) = |J(q)^T d|^2 - |(q0 - q) / L|^2`` subject to ``FK(q) = p`` (reference 2, section on hitting): ``d``
is the unit hitting direction in the table plane, ``J`` the translational Jacobian of the tip, ``q0`` the
configuration that the search stays close to, ``L`` the rated joint velocities. Solved by Newton's method on the
optimality conditions, in closed form: ``d^2 p / dq_j dq_k = z_min(j,k) x J_max(j,k)``, hence gradient ``2 A a`` with
``a = J^T d`` and ``A_jk = d . (z_min x J_max)``, and Hessian ``2 A A + 2 d . (dz_min x J_max + z_min x dJ_max)`` with
``dz``, ``dJ`` the derivatives along ``a``. The constraint is eliminated through three basic joints, so that each step
factorizes only a (n - 3) x (n - 3) matrix.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.fields import Field
from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stage import Array, Batch, Run, Stage
from cnpgen.robots.linalg import Scalar, add, cross, dot, factorize, inverse3, scale, substitute, subtract
from cnpgen.robots.symbolic import Kinematics, Vec, forward_kinematics, symbols
from cnpgen.schema import field

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

MAX_STEP = 0.6  # rad, Euclidean norm of one Newton step
MIN_PIVOT = 1e-3  # smallest |pivot| of the reduced Hessian: keeps every step an ascent direction
TOLERANCE = 1e-6  # rad, length of the last step taken; the next one would be its square
MAX_STEPS = 40


@dataclass(frozen=True, kw_only=True)
class HittingConfiguration(Stage):
    """Joint positions of the goal with maximal manipulability along the hit, close to the start or to the base."""

    needs = ("goal_xyz", "hit_angle")
    near: str = field("the configuration that the search starts from and stays close to", choices=("base", "start"))

    def describe(self) -> str:
        """Say near what."""
        where = "the base" if self.near == "base" else "the start"
        return f"find the goal configuration from which the tip moves fastest along the hit, near {where} configuration"

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The goal configuration."""
        return (context.joint_field("goal_q", "rad", "joint positions at the goal", "target"),)

    def prepare(self, context: Context) -> Run:
        """Load the kernels: inverse kinematics for a first guess, then Newton."""
        from cnpgen.pipelines import ik

        robot = context.robot
        if robot.n < 3 or any(joint.prismatic for joint in robot.chain.joints):
            raise RecipeError(["hitting-configuration needs three or more joints, all of them revolute"])
        first = context.kernels.load(ik.ik_step, Loop(ik.TOLERANCE, ik.MAX_STEPS), vertical=False, max_step=0.4)
        newton = context.kernels.load(newton_step, Loop(TOLERANCE, MAX_STEPS))
        value = context.kernels.load(objective)
        basic = basic_joints(robot)
        free = [j for j in range(robot.n) if j not in basic]
        low, high = robot.position_lower[:, None], robot.position_upper[:, None]

        def climb(start: Array, batch: Batch, direction: Array, home: Array) -> tuple[Array, Array, Array]:
            q, step = newton(start, batch["goal_xyz"], direction, home)
            (f,) = value(q, direction, home)
            solved = step[0] < TOLERANCE
            return q, np.where(solved & ((low <= q) & (q <= high)).all(0), f[0], -np.inf), solved

        def run(batch: Batch, _random: np.random.Generator) -> None:
            home = (
                batch["start_q"] if self.near == "start" else np.repeat(robot.base[:, None], len(batch.alive), axis=1)
            )
            direction = np.concatenate([np.cos(batch["hit_angle"]), np.sin(batch["hit_angle"])])
            guess, _ = first(home, batch["goal_xyz"])
            q, best, solved = climb(guess, batch, direction, home)
            mirrored = q.copy()  # a second optimum, where there is one, has the elbow on the other side of home
            mirrored[free] = 2 * home[free] - q[free]
            mirrored, _ = first(mirrored, batch["goal_xyz"])
            other, second, solved_too = climb(mirrored, batch, direction, home)
            batch["goal_q"] = np.where(second > best, other, q)
            batch.reject(np.where(second > best, solved_too, solved), "no hitting configuration")
            q = batch["goal_q"]
            batch.reject(((low <= q) & (q <= high)).all(0), "joint position limit at the goal")

        return run


def objective(robot: "Robot") -> Any:
    """Build ``(q, d, q0) -> f``: the squared manipulability along d less the penalty on the distance from q0."""
    import casadi as ca

    (q_sx, q), (d_sx, d), (home_sx, home) = symbols("q", robot.n), symbols("d", 2), symbols("q0", robot.n)
    jacobian = forward_kinematics(robot.chain, q).jacobian
    gain = [d[0] * column[0] + d[1] * column[1] for column in jacobian]
    away = [(b - a) / float(rated) for a, b, rated in zip(q, home, robot.rated_velocity, strict=True)]
    return ca.Function("objective", [q_sx, d_sx, home_sx], [dot(gain, gain) - dot(away, away)])


def newton_step(robot: "Robot") -> Any:
    """Build one Newton step as an SX function ``(q, p, d, q0) -> (next q, |step|)``.

    Args:
        robot: The robot; every joint must be revolute.

    Returns:
        A ``casadi.Function`` with arguments of width n, 3, 2, n.
    """
    import casadi as ca

    (q_sx, q), (p_sx, p), (d_sx, d), (home_sx, home) = (
        symbols(name, width) for name, width in (("q", robot.n), ("p", 3), ("d", 2), ("q0", robot.n))
    )
    basic = basic_joints(robot)
    free = [j for j in range(robot.n) if j not in basic]
    kin = forward_kinematics(robot.chain, q)
    weight = [1.0 / float(value) ** 2 for value in robot.rated_velocity]
    direction = [d[0], d[1], 0.0]
    gain = [d[0] * column[0] + d[1] * column[1] for column in kin.jacobian]
    second = _second_derivatives(kin)
    slope = [[d[0] * second[j][k][0] + d[1] * second[j][k][1] for k in range(robot.n)] for j in range(robot.n)]
    gradient = [2.0 * dot(slope[j], gain) + 2.0 * weight[j] * (home[j] - q[j]) for j in range(robot.n)]
    inverse = inverse3([kin.jacobian[j] for j in basic])
    multiplier = [dot([inverse[b][row] for b in range(3)], [gradient[j] for j in basic]) for row in range(3)]
    hessian = _lagrangian_hessian(
        kin, gain, direction, slope=slope, multiplier=multiplier, weight=weight, second=second
    )
    step = _null_space_step(kin, gradient, hessian, inverse=inverse, miss=subtract(p, kin.tip), basic=basic, free=free)
    length = ca.sqrt(dot(step, step))
    factor = ca.fmin(1.0, MAX_STEP / ca.fmax(length, 1e-12))
    following = ca.vertcat(*add(q, scale(step, factor)))
    return ca.Function("hitting_configuration", [q_sx, p_sx, d_sx, home_sx], [following, length])


def basic_joints(robot: "Robot") -> tuple[int, int, int]:
    """Choose the joints through which the tip position is eliminated.

    The three whose Jacobian is typically the best part of the arm's: the largest median over configurations near the
    base of ``|det J_B| / sqrt(det J J^T)``. (The largest least value would be decided by a few odd configurations.)
    """
    import pinocchio as pin

    random = np.random.default_rng(0)
    low, high = np.maximum(robot.base - 0.7, robot.position_lower), np.minimum(robot.base + 0.7, robot.position_upper)
    data, tip = robot.model.createData(), robot.model.getFrameId(robot.tip)
    frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    jacobians = np.array(
        [pin.computeFrameJacobian(robot.model, data, random.uniform(low, high), tip, frame)[:3] for _ in range(64)]
    )
    volume = np.sqrt(np.linalg.det(jacobians @ jacobians.transpose(0, 2, 1)))

    def share(joints: tuple[int, ...]) -> float:
        return float(np.median(np.abs(np.linalg.det(jacobians[:, :, list(joints)])) / volume))

    best = max(combinations(range(robot.n), 3), key=share)
    return best[0], best[1], best[2]


def _second_derivatives(kin: Kinematics) -> list[list[Vec]]:
    """d^2 p / dq_j dq_k = z_min x J_max, symmetric, n x n lists of 3."""
    n = len(kin.axes)
    upper = {(j, k): cross(kin.axes[j], kin.jacobian[k]) for j in range(n) for k in range(j, n)}
    return [[upper[min(j, k), max(j, k)] for k in range(n)] for j in range(n)]


def _lagrangian_hessian(
    kin: Kinematics,
    gain: Vec,
    direction: Vec,
    *,
    slope: list[Vec],
    multiplier: Vec,
    weight: Vec,
    second: list[list[Vec]],
) -> list[list[Scalar]]:
    """Hessian of ``f - multiplier . FK``, full symmetric n x n."""
    n = len(kin.axes)
    turning: Vec = [0.0, 0.0, 0.0]
    origin_rate: Vec = [0.0, 0.0, 0.0]
    previous: Vec = [0.0, 0.0, 0.0]
    tip_rate = [dot([column[row] for column in kin.jacobian], gain) for row in range(3)]
    axis_rates, column_rates = [], []
    for j in range(n):
        origin_rate = add(origin_rate, cross(turning, subtract(kin.origins[j], previous)))
        previous = kin.origins[j]
        rate = cross(turning, kin.axes[j])
        axis_rates.append(rate)
        column_rates.append(
            add(cross(rate, subtract(kin.tip, kin.origins[j])), cross(kin.axes[j], subtract(tip_rate, origin_rate)))
        )
        turning = add(turning, scale(kin.axes[j], gain[j]))
    across = [cross(direction, axis) for axis in kin.axes]
    across_rate = [cross(direction, rate) for rate in axis_rates]
    hessian: list[list[Scalar]] = [[0.0] * n for _ in range(n)]
    for j in range(n):
        for k in range(j, n):
            third = dot(across_rate[j], kin.jacobian[k]) + dot(across[j], column_rates[k])
            value = 2.0 * (dot(slope[j], slope[k]) + third) - dot(multiplier, second[j][k])
            hessian[j][k] = hessian[k][j] = value - 2.0 * weight[j] if j == k else value
    return hessian


def _null_space_step(
    kin: Kinematics,
    gradient: Vec,
    hessian: list[list[Scalar]],
    *,
    inverse: list[Vec],
    miss: Vec,
    basic: tuple[int, ...],
    free: list[int],
) -> Vec:
    """Newton step: basic joints close the miss, free joints climb the reduced gradient."""
    import casadi as ca

    n, m = len(gradient), len(free)
    null = []  # column of Z for each free joint: moving it alone, with the basic joints keeping the tip in place
    for j in free:
        column: Vec = [0.0] * n
        column[j] = 1.0
        for b, joint in enumerate(basic):
            column[joint] = -dot(inverse[b], kin.jacobian[j])
        null.append(column)
    normal: Vec = [0.0] * n
    for b, joint in enumerate(basic):
        normal[joint] = dot(inverse[b], miss)
    curved = [[dot(row, column) for row in hessian] for column in null]  # H Z
    lower = [[-dot(null[i], curved[j]) for j in range(i + 1)] for i in range(m)]
    bent = [dot(curved[i], normal) for i in range(m)]
    right = [dot(null[i], gradient) + bent[i] for i in range(m)]
    factor, pivots = factorize(lower, lambda pivot: ca.fmax(ca.fabs(pivot), MIN_PIVOT))
    climb = substitute(factor, pivots, right)
    step = normal
    for amount, column in zip(climb, null, strict=True):
        step = add(step, scale(column, amount))
    return [ca.SX(value) for value in step]
