"""Inverse kinematics of tip poses as a kernel: damped Gauss-Newton steps from given joint positions."""

from typing import Any

from cnpgen.kernels.symbolic.kinematics import forward_kinematics
from cnpgen.kernels.symbolic.linalg import add, dot, scale, subtract, symbols
from cnpgen.pipelines.stages.ik import clipped_step
from cnpgen.robots.robot import Robot

METERS_PER_RADIAN = 0.3  # weight of an angle against a distance
POSE_TOLERANCE = 1e-9  # m and weighted rad, before the last step
MAX_POSE_IK_STEPS = 30
MAX_POSE_IK_STEP_RAD = 0.5  # of any joint
POSE_DAMPING = 1e-3  # relative to the squared error (Sugihara 2011)
MIN_DAMPING = 1e-12


def pose_ik_step(robot: Robot) -> Any:
    """Build ``(q, position, rotation by rows) -> (next q, |error|)``; steps end at the joint limits.

    The error is the distance from the position, and the rotation vector to the rotation times ``METERS_PER_RADIAN``,
    stretched to twice the tangent of half the angle, so that rotations by 180 degrees are no fixed point.
    """
    import casadi as ca

    (q_sx, q), (p_sx, p), (r_sx, r) = symbols("q", robot.n), symbols("p", 3), symbols("r", 9)
    kin = forward_kinematics(robot.chain, q)
    target = [r[0:3], r[3:6], r[6:9]]
    relative = [[dot(a, b) for b in kin.rotation] for a in target]  # target times the transposed rotation
    trace = relative[0][0] + relative[1][1] + relative[2][2]
    stretch = METERS_PER_RADIAN * 2.0 / ca.fmax(1.0 + trace, 1e-2)
    turn = [relative[2][1] - relative[1][2], relative[0][2] - relative[2][0], relative[1][0] - relative[0][1]]
    error = [*subtract(p, kin.tip), *scale(turn, stretch)]
    axes = [axis if turns else [0.0] * 3 for axis, turns in zip(kin.axes, kin.turning, strict=True)]
    rows = [[column[row] for column in kin.jacobian] for row in range(3)]
    rows += [[METERS_PER_RADIAN * axis[row] for axis in axes] for row in range(3)]
    square = dot(error, error)
    step, _ = clipped_step(rows, error, MAX_POSE_IK_STEP_RAD, POSE_DAMPING * square + MIN_DAMPING)
    moved = add(q, step)
    following = [
        ca.fmin(ca.fmax(x, float(low)), float(high))
        for x, low, high in zip(moved, robot.position_lower, robot.position_upper, strict=True)
    ]
    return ca.Function("pose_ik", [q_sx, p_sx, r_sx], [ca.vertcat(*following), ca.sqrt(square)])
