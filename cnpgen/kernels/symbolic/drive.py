"""Torques of drives as CasADi SX: rotor inertia, and an upper and a lower envelope of friction that are C2."""

from typing import Any

from cnpgen.kernels.symbolic.linalg import Scalar, Vec
from cnpgen.robots.drive import Drive

# A time parametrization may reduce speeds by this factor; friction keeps both
# directions below so many reversal speeds.
MAX_SPEED_REDUCTION = 3.0


def linear_torque(drive: Drive, torque: Vec, dq: Vec, ddq: Vec) -> Vec:
    """Return the torque at the motor without dry friction [N m]: ``tau + J ddq + b dq``."""
    rows: Vec = []
    for tau, v, a, inertia, b in zip(
        torque, dq, ddq, drive.armature.tolist(), drive.viscous.tolist(), strict=True
    ):
        with_rotor = tau + inertia * a if inertia else tau
        rows.append(with_rotor + b * v if b else with_rotor)
    return rows


def motor_torque(
    drive: Drive, torque: Vec, dq: Vec, ddq: Vec, friction_rates: Vec | None = None
) -> tuple[Vec, Vec]:
    """Return the lowest and the highest torque at the motor [N m] over all friction that may act.

    With a certain fraction h of the friction, the highest is

        tau + J ddq + h (b dq + c (2 S+ - 1)) + (1 - h) (c + b (dq + w)) S+

    with ``S+ = S(dq / w + 1)``, where S is the quintic step from 0 to 1. The first part
    bounds ``h (b dq + c F)``, the second what else lies between 0 and ``(1 - h) (b dq +
    c F)``. The lowest is the same for the reversed motion, reversed.

    Args:
        drive: The drives.
        torque: Torque of the rigid body [N m].
        dq: Velocities [rad/s].
        ddq: Accelerations [rad/s^2].
        friction_rates: Velocities that determine the direction of friction in place of
            ``dq``: S+ is then 1 unless they are far below zero, a constant bound, and
            the torque is linear in ``dq``.
    """
    low: Vec = []
    high: Vec = []
    rates = dq if friction_rates is None else friction_rates
    for joint, (tau, v, a) in enumerate(zip(torque, dq, ddq, strict=True)):
        inertia = float(drive.armature[joint])
        with_rotor = tau + inertia * a if inertia else tau
        steps = _steps(drive, rates[joint], is_constant=friction_rates is not None)
        high.append(with_rotor + _upper_friction(drive, joint, v, steps[0]))
        low.append(with_rotor - _upper_friction(drive, joint, -v, steps[1]))
    return low, high


def _upper_friction(drive: Drive, joint: int, v: Scalar, step: Scalar) -> Scalar:
    """Return the upper envelope of the friction of one joint [N m], see ``motor_torque``."""
    b = float(drive.viscous[joint])
    c = float(drive.coulomb[joint])
    h = drive.friction_help
    w = drive.reversal_speed
    if not (b or c):
        return 0.0
    # b v + c F(v) is certain for the fraction h. F is replaced by 2 S+ - 1, which is
    # never below the sign of v, also while the drive reverses.
    certain = h * (b * v + c * (2 * step - 1)) if h else 0.0
    return certain + ((1 - h) * (c + b * (v + w)) * step if h < 1 else 0.0)


def _steps(drive: Drive, rate: Any, *, is_constant: bool) -> tuple[Scalar, Scalar]:
    """Return S(v / w + 1) and S(-v / w + 1) of one joint."""
    import casadi as ca

    # In units of the reversal speed; the steps rise over [-1, 0] and fall over [0, 1].
    x = rate * (1 / drive.reversal_speed)
    if not is_constant:
        return _quintic(x + 1), _quintic(1 - x)
    return ca.if_else(x > -MAX_SPEED_REDUCTION, 1.0, 0.0), ca.if_else(
        x < MAX_SPEED_REDUCTION, 1.0, 0.0
    )


def _quintic(x: Any) -> Any:
    """Return 6 x^5 - 15 x^4 + 10 x^3 clipped to [0, 1], whose second derivative is continuous."""
    import casadi as ca

    x = ca.fmin(ca.fmax(x, 0), 1)
    return x * x * x * (x * (x * 6 - 15) + 10)
