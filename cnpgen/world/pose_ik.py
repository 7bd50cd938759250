"""Inverse kinematics of tip poses for many seeds at once: damped Gauss-Newton steps within the joint limits.

The damping follows the error (Levenberg-Marquardt; Sugihara 2011). The tip may be
another frame that the same joint carries. With tolerances, every step aims for the
nearest pose within them, and directions without an error are free.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.robots.robot import Robot
from cnpgen.world.forward_kinematics import ForwardKinematics, joint_motion

MAX_POSE_STEPS = 60
MAX_POSE_STEP_RAD = 0.4  # rad or m, of any joint
METERS_PER_RADIAN = 0.3  # weight of an angle against a distance
POSE_DAMPING = 1e-3  # relative to the squared error
POSE_POSITION_TOLERANCE_M = 1e-6
POSE_ROTATION_TOLERANCE_RAD = 1e-6
# M and rad, from the end of a tolerance, so that solutions are within it.
TOLERANCE_INSET = 1e-5


@dataclass(frozen=True, eq=False)
class PoseTolerance:
    """Tolerances of K poses along and about the axes of the wanted poses.

    Attributes:
        position: Accepted displacements along the axes [m], shape (K, 3).
        rotation: Accepted components of the rotation vector [rad], shape (K, 3); about
            an axis with pi or more any rotation is accepted.
    """

    position: Array
    rotation: Array

    def nearest(
        self, positions: Array, rotations: Array, at: tuple[Array, Array]
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return the nearest poses within the tolerances.

        Args:
            positions: Wanted positions [m], shape (K, 3).
            rotations: Wanted rotation matrices, shape (K, 3, 3).
            at: Present positions and rotation matrices.

        Returns:
            Positions; rotation matrices; and the mask of the three displacements and
            three rotations that are within their tolerances, shape (K, 6).
        """
        back = rotations.swapaxes(1, 2)
        # Shift and rotation from the wanted pose, in its own axes: tolerances are given
        # in these.
        shift = (back @ (at[0] - positions)[..., None])[..., 0]
        turn = rotation_vectors(back @ at[1])
        error = np.concatenate([shift, turn], axis=1)
        limit = np.concatenate(
            [self.position, np.where(self.rotation >= np.pi, np.inf, self.rotation)],
            axis=1,
        )
        # Aim slightly inside, so that the rounded solution is within the tolerance.
        inner = np.maximum(limit - TOLERANCE_INSET, 0.0)
        nearest = np.clip(error, -inner, inner)
        place = positions + (rotations @ nearest[:, :3, None])[..., 0]
        return (
            place,
            rotations @ rotation_matrices(nearest[:, 3:]),
            (error == nearest) & (limit > 0),
        )


class PoseKinematics:
    """Poses and Jacobians of a frame of a robot at many states: of a frame of Pinocchio's model, by default the tip."""

    def __init__(self, robot: Robot, frame: int | None = None) -> None:
        model = robot.model
        placed = model.frames[robot.tip_frame if frame is None else frame]
        self.robot = robot
        self._carrier = placed.parentJoint
        self._turn = np.array(placed.placement.rotation)
        self._offset = np.array(placed.placement.translation)
        self._kinematics = ForwardKinematics(model)
        self._joints = list(model.supports[self._carrier])[1:]
        self._motions = [
            joint_motion(model, joint) for joint in range(1, model.njoints)
        ]

    def evaluate(self, q: Array) -> tuple[Array, Array, Array]:
        """Compute poses and Jacobians at joint positions q [rad], shape (n, K).

        Returns:
            Positions [m], shape (K, 3); rotation matrices, shape (K, 3, 3); and
            Jacobians of linear and angular velocity in world axes, shape (K, 6, n).
        """
        rotations, origins = self._kinematics.poses(q)
        # (K, n + 1, 3, 3)
        turns = rotations.transpose(3, 0, 1, 2)
        points = origins.transpose(2, 0, 1)
        position = points[:, self._carrier] + turns[:, self._carrier] @ self._offset
        J = np.zeros((q.shape[1], 6, len(q)))
        for joint in self._joints:
            linear, angular = (
                turns[:, joint] @ part for part in np.split(self._motions[joint - 1], 2)
            )
            # v = v_joint + w x (p - o), and w itself, per unit of joint velocity.
            J[:, :3, joint - 1] = linear + np.cross(
                angular, position - points[:, joint]
            )
            J[:, 3:, joint - 1] = angular
        return position, turns[:, self._carrier] @ self._turn, J


def solve_pose_ik(
    kinematics: PoseKinematics,
    positions: Array,
    rotations: Array,
    seeds: Array,
    *,
    tolerance: PoseTolerance | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Search joint positions with given poses, one for each seed.

    Positions [m] have shape (K, 3), rotation matrices (K, 3, 3), and the seeds, joint
    positions at which the iteration starts [rad], (n, K). By default no differences
    from the poses are accepted.

    Returns:
        Joint positions within their limits [rad], shape (n, K), and the mask of those
        that have their pose, shape (K,).
    """
    robot = kinematics.robot
    low = robot.position_lower[:, None]
    high = robot.position_upper[:, None]
    q = np.clip(seeds, low, high)
    for step in range(MAX_POSE_STEPS + 1):
        position, rotation, J = kinematics.evaluate(q)
        place = positions
        facing = rotations
        free = None
        if tolerance is not None:
            place, facing, free = tolerance.nearest(
                positions, rotations, (position, rotation)
            )
        shift = place - position
        turn = rotation_vectors(facing @ rotation.swapaxes(1, 2))
        # Both parts of the pose must be met; the search of the other states goes on.
        met = np.linalg.norm(shift, axis=1) <= POSE_POSITION_TOLERANCE_M
        met &= np.linalg.norm(turn, axis=1) <= POSE_ROTATION_TOLERANCE_RAD
        if step == MAX_POSE_STEPS or met.all():
            break
        error = np.concatenate([shift, METERS_PER_RADIAN * turn], axis=1)
        # Weighted rows: an angle of 1 rad counts as ``METERS_PER_RADIAN``.
        J = J * np.repeat([1.0, METERS_PER_RADIAN], 3)[:, None]
        if free is not None:
            error, J = _without_free(error, J, rotations, free)
        q = np.where(met, q, np.clip(q + _damped_step(error, J), low, high))
    return q, met


def _damped_step(error: Array, J: Array) -> Array:
    """Return one step of Levenberg and Marquardt from errors (K, 6) and Jacobians (K, 6, n), shape (n, K)."""
    # dq = J^T (J J^T + lambda I)^-1 e with lambda relative to |e|^2.
    damping = POSE_DAMPING * np.square(error).sum(axis=1) + 1e-9
    square = J @ J.swapaxes(1, 2) + damping[:, None, None] * np.eye(6)
    move = (J.swapaxes(1, 2) @ np.linalg.solve(square, error[..., None]))[..., 0].T
    # The whole step is shortened, so that its direction stays.
    move *= np.minimum(
        1.0, MAX_POSE_STEP_RAD / np.maximum(np.abs(move).max(axis=0), 1e-12)
    )
    return move


def _without_free(
    error: Array, J: Array, rotations: Array, free: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return errors (K, 6) and Jacobians in the axes of the wanted poses, zero in free directions (K, 6)."""
    back = rotations.swapaxes(1, 2)[:, None]
    count = len(error)
    turned = (back @ error.reshape(count, 2, 3, 1)).reshape(count, 6)
    rows = (back @ J.reshape(count, 2, 3, -1)).reshape(J.shape)
    return np.where(free, 0.0, turned), np.where(free[..., None], 0.0, rows)


def rotation_matrices(vectors: Array) -> Array:
    """Return the rotation matrices of rotation vectors [rad], shape (K, 3, 3) (Rodrigues' formula)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    # sinc avoids 0 / 0: sin(a) / a and (1 - cos(a)) / a^2 = 2 sin(a / 2)^2 / a^2.
    # sin(angle / 2) / (angle / 2)
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * cross + half**2 / 2 * cross @ cross
    )


def rotation_vectors(rotations: Array) -> Array:
    """Return the rotation vectors of rotation matrices [rad], shape (K, 3)."""
    # Skew part 2 sin(a) u and trace 1 + 2 cos(a): atan2 is accurate at all angles below
    # pi.
    skew = rotations[:, [2, 0, 1], [1, 2, 0]] - rotations[:, [1, 2, 0], [2, 0, 1]]
    sine = np.linalg.norm(skew, axis=1) / 2
    angle = np.arctan2(sine, (np.trace(rotations, axis1=1, axis2=2) - 1) / 2)
    # For small angles a / (2 sin a) is 1/2.
    factor = np.where(sine > 1e-9, angle / np.maximum(2 * sine, 1e-12), 0.5)
    return skew * factor[:, None]
