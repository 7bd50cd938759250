"""Air-hockey table in the robot's frame, its puck, and the contact parameters.

Sizes are those of the real table (docs/references.md). Mallet and puck are two discs. They touch if the mallet's axis
enters a disc with the sum of both radii around the puck, which is the shape for MuJoCo.
"""

from math import atan2, exp, pi, sqrt

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HOME, LENGTH, WIDTH = 0.53, 1.948, 1.038  # m: home edge along x, and the playing field
GOAL_LINE_M = HOME + LENGTH
GOAL_WIDTH = 0.25  # m
BAND = 0.045  # m: half the width of a band
PUCK_RADIUS, PUCK_MASS, PUCK_DRAG = 0.03165, 0.01, 0.005  # m, kg, N s/m
MALLET_RADIUS, MALLET_HEIGHT = 0.04815, 0.0645  # m: from the tip down to the table
PUCK_HEIGHT = 0.006  # m
BEHIND = 0.07  # m: distance of the tip from the puck's centre at the end of a hit
RESTITUTION = 0.75  # of mallet and puck, and of puck and bands
CONTACT_TIME = 2.5e-3  # s: a bounce; ten steps of the simulation


def bounce(restitution: float = RESTITUTION, contact_time: float = CONTACT_TIME) -> tuple[float, float]:
    """Compute stiffness and damping of a contact, per unit of the colliding mass, from restitution and contact time.

    A contact ``x'' = -k x - b x'`` that can push but not pull ends when its force does. With ``b = 2 zeta sqrt(k)`` and
    ``a = pi - atan2(2 zeta sqrt(1 - zeta^2), 1 - 2 zeta^2)`` this is after ``a / sqrt(k (1 - zeta^2))``, and the bodies
    separate with ``exp(-a zeta / sqrt(1 - zeta^2))`` times the initial speed (Schwager and Poeschel, 2007).

    Args:
        restitution: Speed after over speed before, from 0.22 to below 1.
        contact_time: Duration of the contact [s].

    Returns:
        ``(k, b)`` [1/s^2] and [1/s].
    """
    from scipy.optimize import brentq

    def angle(zeta: float) -> float:
        return pi - atan2(2 * zeta * sqrt(1 - zeta**2), 1 - 2 * zeta**2)

    def residual(zeta: float) -> float:
        return exp(-angle(zeta) * zeta / sqrt(1 - zeta**2)) - restitution

    zeta = float(brentq(residual, 0.0, 0.7, xtol=1e-12))
    k = (angle(zeta) / contact_time) ** 2 / (1 - zeta**2)
    return k, 2 * zeta * sqrt(k)


def puck_of(goal_xyz: Array, tip_velocity: Array) -> Array | None:
    """Place the puck of a hit: ``BEHIND`` ahead of the tip, along its velocity at the goal.

    Args:
        goal_xyz: Tip position at the goal [m], shape (3,).
        tip_velocity: Tip velocity at the goal [m/s], shape (3,).

    Returns:
        Its centre over the table [m], shape (2,); None if the motion ends at rest and is not a hit.
    """
    speed = float(np.linalg.norm(tip_velocity[:2]))
    return goal_xyz[:2] + BEHIND * tip_velocity[:2] / speed if speed > 1e-3 else None
