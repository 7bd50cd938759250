"""Air-hockey table in the robot's frame, its puck, and the contact parameters.

Sizes are those of the real table (references, 15). Mallet and puck are two discs. They
touch if the mallet's axis enters a disc with the sum of both radii around the puck,
which is the shape for MuJoCo.
"""

from math import atan2, exp, pi, sqrt

import numpy as np

from cnpgen.arrays import Array

HOME_M, LENGTH_M, WIDTH_M = 0.53, 1.948, 1.038  # home edge along x; playing field
GOAL_LINE_M = HOME_M + LENGTH_M
GOAL_WIDTH_M = 0.25
BAND_M = 0.045  # half the width of a band
PUCK_RADIUS_M = 0.03165
PUCK_MASS_KG = 0.01
PUCK_DRAG_N_S_M = 0.005
# Height: from the tip down to the table.
MALLET_RADIUS_M = 0.04815
MALLET_HEIGHT_M = 0.0645
PUCK_HEIGHT_M = 0.006
PUCK_OFFSET_M = 0.07  # distance of the tip from the puck's centre at the end of a hit
# Of the path left when both discs meet.
PATH_LEFT_AT_CONTACT_M = MALLET_RADIUS_M + PUCK_RADIUS_M - PUCK_OFFSET_M
RESTITUTION = 0.75  # of mallet and puck, and of puck and bands
CONTACT_TIME_S = 2.5e-3  # of a bounce; ten steps of the simulation


def bounce(restitution: float = RESTITUTION) -> tuple[float, float]:
    """Compute stiffness [1/s^2] and damping [1/s] of a contact, per unit of the colliding mass, from the restitution.

    A contact ``x'' = -k x - b x'`` that can push but not pull ends when its force does.
    With ``b = 2 zeta sqrt(k)`` and ``a = pi - atan2(2 zeta sqrt(1 - zeta^2), 1 - 2
    zeta^2)`` this is after ``a / sqrt(k (1 - zeta^2))``. The bodies separate with
    ``exp(-a zeta / sqrt(1 - zeta^2))`` times the initial speed (Schwager and Poeschel,
    2007). The restitution, speed after over speed before, is from 0.22 to below 1.
    """
    from scipy.optimize import brentq

    def angle(zeta: float) -> float:
        return pi - atan2(2 * zeta * sqrt(1 - zeta**2), 1 - 2 * zeta**2)

    def residual(zeta: float) -> float:
        return exp(-angle(zeta) * zeta / sqrt(1 - zeta**2)) - restitution

    zeta = float(brentq(residual, 0.0, 0.7, xtol=1e-12))
    k = (angle(zeta) / CONTACT_TIME_S) ** 2 / (1 - zeta**2)
    return k, 2 * zeta * sqrt(k)


def puck_of(goal_xyz: Array, tip_velocity: Array) -> Array | None:
    """Place the puck of a hit: ``PUCK_OFFSET_M`` ahead of the tip [m], along its velocity at the goal [m/s].

    Return its centre over the table [m], shape (2,); None if the motion ends at rest
    and is not a hit.
    """
    speed = float(np.linalg.norm(tip_velocity[:2]))
    return (
        goal_xyz[:2] + PUCK_OFFSET_M * tip_velocity[:2] / speed
        if speed > 1e-3
        else None
    )
