"""Measured torques of drives at one or at K states: rotor inertia, and an upper and a lower envelope of friction.

With ``certain`` friction ``h (b v + c F(v))`` and ``uncertain`` friction between 0 and
``(1 - h) (b v + c F(v))``, each is bounded by a function whose second derivative is
continuous; see ``cnpgen.robots.drive`` for the symbols.
"""

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.drive import Drive


def linear_torque(drive: Drive, torque: Array, dq: Array, ddq: Array) -> Array:
    """Return the torques at the motors without dry friction [N m], shape (n,) or (n, K)."""
    inertia, viscous, _ = _terms(drive, dq)
    return np.asarray(torque + inertia * ddq + viscous * dq)


def motor_torque(
    drive: Drive, torque: Array, dq: Array, ddq: Array
) -> tuple[Array, Array]:
    """Return the lowest and the highest torques at the motors over all friction that may act [N m].

    All arrays have shape (n,) or (n, K). ``torque`` is that of the rigid body.
    """
    inertia = _terms(drive, dq)[0]
    low, high = friction_bounds(drive, dq)
    return torque + inertia * ddq + low, torque + inertia * ddq + high


def friction_bounds(drive: Drive, dq: Array) -> tuple[Array, Array]:
    """Return the lowest and the highest friction [N m] at velocities [rad/s], shape (n,) or (n, K)."""
    return -_highest_friction(drive, -dq), _highest_friction(drive, dq)


def _highest_friction(drive: Drive, dq: Array) -> Array:
    _, viscous, dry = _terms(drive, dq)
    width = drive.reversal_speed
    share = drive.friction_help
    x = np.clip(dq / width + 1, 0.0, 1.0)
    # Quintic step S from 0 to 1 over [-w, 0], and its bounds of the friction of either
    # sign.
    forward = x**3 * (10 - 15 * x + 6 * x**2)
    certain = viscous * dq + dry * (2 * forward - 1)
    uncertain = (dry + viscous * (dq + width)) * forward
    return np.asarray(share * certain + (1 - share) * uncertain)


def _terms(drive: Drive, dq: Array) -> tuple[Array, Array, Array]:
    """Return rotor inertia, viscous and dry friction with the number of axes of the velocities."""
    shape = (-1, *[1] * (np.ndim(dq) - 1))
    armature, viscous, coulomb = (
        each.reshape(shape) for each in (drive.armature, drive.viscous, drive.coulomb)
    )
    return armature, viscous, coulomb
