"""Lower bound of the tip's position along a direction for all joint positions in a box.

The projection ``c . p(q)`` is expanded to second order at the center of the box. For a
chain of revolute and prismatic joints the lengths of the links bound its third
derivatives. A joint along which the derivative keeps its sign moves to the end of its
interval where ``c . p`` is smaller; boxes that are not yet above the threshold are
split. Every step gives a lower bound, so the result is a proof up to rounding.
"""

from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.robot import Robot

MAX_BOXES = 4000


@dataclass(frozen=True)
class TipKinematics:
    """The tip at one configuration."""

    position: Array  # position [m], shape (3,)
    jacobian: Array  # derivative of the position [m/rad], shape (3, n)
    # Axes of revolute joints in the world, zero for prismatic ones, shape (3, n).
    axes: Array

    def curvature(self, direction: Array) -> Array:
        """Return second derivatives along a direction, shape (n, n): ``c . (axis_i x J_j)`` for i <= j."""
        # c . (axis_i x J_j) = axis_i . (J_j x c)
        upper = np.triu(self.axes.T @ np.cross(self.jacobian.T, direction).T)
        return np.asarray(upper + np.triu(upper, 1).T)


class ArmKinematics:
    """Positions of the tip by Pinocchio."""

    def __init__(self, robot: Robot) -> None:
        self._model = robot.model
        self._data = robot.model.createData()
        self._frame = robot.tip_frame
        joints = robot.chain.joints
        strokes = (
            np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
            * 1.01
        )
        lengths = [
            float(np.linalg.norm(joint.translation))
            + (stroke if joint.prismatic else 0.0)
            for joint, stroke in zip(joints[1:], strokes[1:], strict=True)
        ]
        lengths.append(float(np.linalg.norm(robot.chain.tip_translation)))
        # Joint i turns the tip at a radius of at most the lengths of all links after
        # it.
        outer = np.cumsum(lengths[::-1])[::-1]
        # upper bounds of the derivatives of the tip's position by each joint, of any
        # order, shape (n,)
        self.reach = np.array(
            [1.0 if joint.prismatic else outer[i] for i, joint in enumerate(joints)]
        )

    def at(self, q: Array) -> TipKinematics:
        """Evaluate the tip at q, shape (n,)."""
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        pin.computeJointJacobians(self._model, self._data, q)
        position = np.array(
            pin.updateFramePlacement(self._model, self._data, self._frame).translation
        )
        jacobian = np.array(
            pin.getFrameJacobian(self._model, self._data, self._frame, frame)
        )
        return TipKinematics(position, jacobian[:3], jacobian[3:])


def bound_projection(
    arm: ArmKinematics, direction: Array, lower: Array, upper: Array, *, above: float
) -> float | None:
    """Return a lower bound of ``direction . tip`` over a box of joint positions, or None below a threshold.

    The direction has shape (3,), the lower and upper ends of the box [rad] shape (n,),
    the threshold is ``above`` [m].
    """
    boxes = [(lower, upper)]
    bound = np.inf
    for _ in range(MAX_BOXES):
        low, high = boxes.pop()
        low, high, box_bound, loss = _bound_box(arm, direction, low, high)
        if box_bound > above:
            bound = min(bound, box_bound)
            if not boxes:
                return float(bound)
            continue
        joint = int(np.argmax(loss))
        center = (low[joint] + high[joint]) / 2
        # A position at or below the threshold disproves the bound.
        if direction @ arm.at((low + high) / 2).position <= above or loss[joint] == 0:
            return None
        left = high.copy()
        right = low.copy()
        left[joint] = right[joint] = center
        boxes += [(low, left), (right, high)]
    return None


def _bound_box(
    arm: ArmKinematics, direction: Array, low: Array, high: Array
) -> tuple[Array, Array, float, Array]:
    """Shrink a box to the minimum.

    Return it, its lower bound, and each joint's loss in that bound.
    """
    while True:
        half = (high - low) / 2
        # Taylor series about the center of the box: value, gradient, curvature, and a
        # bound of the rest.
        tip = arm.at((low + high) / 2)
        gradient = direction @ tip.jacobian
        curvature = np.abs(tip.curvature(direction))
        second, third = _remainders(arm.reach * float(np.linalg.norm(direction)), half)
        change = curvature @ half + second
        # A gradient that keeps its sign in the whole box puts the minimum on one of its
        # sides.
        rising = (half > 0) & (gradient > change)
        falling = (half > 0) & (-gradient > change)
        if not (rising | falling).any():
            # The joint with the largest contribution is split next.
            joint_loss = half * (np.abs(gradient) + change)
            loss = np.abs(gradient) @ half + half @ curvature @ half / 2 + third
            return low, high, float(direction @ tip.position - loss), joint_loss
        low, high = np.where(falling, high, low), np.where(rising, low, high)


def _remainders(reach: Array, half: Array) -> tuple[Array, float]:
    """Bound the contributions of third derivatives to each first derivative, shape (n,), and to the value.

    The derivative by joints i <= j <= k is at most ``reach[k]``, that of the outermost.
    The triples of joints with outermost k have the weight ``W_k^3 - W_(k-1)^3`` with
    ``W_k`` the sum of ``half`` up to k.
    """
    total = np.cumsum(half)
    pairs = reach * np.diff(total**2, prepend=0.0)
    outer = pairs.sum() - np.cumsum(pairs)
    triples = float(reach @ np.diff(total**3, prepend=0.0))
    return (reach * total**2 + outer) / 2, triples / 6
