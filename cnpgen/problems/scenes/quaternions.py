"""Quaternions of scene files as rotation matrices and as roll, pitch and yaw."""

import math

import numpy as np

from cnpgen.arrays import Array, Vector3
from cnpgen.robots.scene import rotation_matrices

MAX_NORM_ERROR = 0.01  # of a quaternion that is accepted and normalized


def quaternion_error(quaternion: Array) -> str:
    """Return an error message for a quaternion, shape (4,), that is not of unit length; empty for a valid one."""
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) <= MAX_NORM_ERROR:
        return ""
    kind = "zero" if norm == 0 else f"of length {norm:.3g}"
    return f"quaternion {np.round(quaternion, 6).tolist()} is {kind}, expected length 1"


def rotation_matrix(wxyz: Array) -> Array:
    """Return the rotation matrix of a quaternion (w, x, y, z), which is normalized first, shape (3, 3)."""
    return rotation_matrices(np.asarray(wxyz, float) / np.linalg.norm(wxyz))


def quaternion_of(rotation: Array) -> Array:
    """Return the quaternion (w, x, y, z) with w >= 0 of a rotation matrix, shape (4,).

    The eigenvector of the largest eigenvalue is exact for all rotations (Bar-Itzhack
    2000).
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation
    # K = 3 times Bar-Itzhack's matrix: for a rotation its largest eigenvalue is 3, with
    # the eigenvector (w, x, y, z).
    symmetric = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    wxyz: Array = np.linalg.eigh(symmetric)[1][:, -1]
    # q and -q are the same rotation.
    return wxyz if wxyz[0] >= 0 else -wxyz


def roll_pitch_yaw(rotation: Array) -> Vector3:
    """Return roll, pitch and yaw about fixed axes [rad] of a rotation matrix, as ``<origin rpy>`` of a URDF."""
    # R = Rz(yaw) Ry(pitch) Rx(roll): R_20 = -sin(pitch), and (R_00, R_10) has the
    # length |cos(pitch)|.
    sine = -rotation[2, 0]
    cosine = math.hypot(rotation[0, 0], rotation[1, 0])
    if cosine < 1e-9:
        # Pitch of 90 degrees: roll and yaw turn about the same axis.
        return (
            math.atan2(-rotation[1, 2], rotation[1, 1]),
            math.atan2(sine, cosine),
            0.0,
        )
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    return roll, math.atan2(sine, cosine), yaw
