"""How far the tip is at least along a direction while the joints are anywhere in a box: a bound, not a search.

With ``c . p(q)`` expanded to second order at the middle of a box, the third derivatives of a chain of revolute and
prismatic joints are bounded by the lengths of its links. A joint along which the derivative keeps its sign is put to
the end of its interval where ``c . p`` is smaller; what is then not yet above the threshold is split. Every step
bounds from below, so the answer is a proof up to rounding.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
BOXES = 4000  # looked at before giving up


@dataclass(frozen=True)
class Tip:
    """The tip at one configuration.

    Attributes:
        position: Position [m], shape (3,).
        jacobian: Its derivative [m/rad], shape (3, n).
        axes: Axes of revolute joints in the world, zero for prismatic ones, shape (3, n).
    """

    position: Array
    jacobian: Array
    axes: Array

    def curvature(self, direction: Array) -> Array:
        """Second derivatives of the position along a direction, shape (n, n): ``c . (axis_i x J_j)`` for i <= j."""
        upper = np.triu(self.axes.T @ np.cross(self.jacobian.T, direction).T)
        return np.asarray(upper + np.triu(upper, 1).T)


class Arm:
    """Positions of the tip as Pinocchio computes them.

    Args:
        robot: The robot.

    Attributes:
        reach: Upper bounds of the derivatives of the tip's position by each joint, of any order, shape (n,).
    """

    def __init__(self, robot: Robot) -> None:
        self._model, self._data = robot.model, robot.model.createData()
        self._frame = robot.tip_frame
        joints = robot.chain.joints
        slides = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper)) * 1.01
        lengths = [
            float(np.linalg.norm(joint.translation)) + (slide if joint.prismatic else 0.0)
            for joint, slide in zip(joints[1:], slides[1:], strict=True)
        ]
        lengths.append(float(np.linalg.norm(robot.chain.tip_translation)))
        beyond = np.cumsum(lengths[::-1])[::-1]
        self.reach = np.array([1.0 if joint.prismatic else beyond[i] for i, joint in enumerate(joints)])

    def at(self, q: Array) -> Tip:
        """Evaluate the tip at q, shape (n,)."""
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        pin.computeJointJacobians(self._model, self._data, q)
        position = np.array(pin.updateFramePlacement(self._model, self._data, self._frame).translation)
        jacobian = np.array(pin.getFrameJacobian(self._model, self._data, self._frame, frame))
        return Tip(position, jacobian[:3], jacobian[3:])


def bound_projection(arm: Arm, direction: Array, lower: Array, upper: Array, *, above: float) -> float | None:
    """Bound ``direction . tip`` over a box of joint positions from below.

    Args:
        arm: The arm.
        direction: Shape (3,).
        lower: Lower ends of the box [rad], shape (n,).
        upper: Upper ends.
        above: What the bound must exceed [m].

    Returns:
        A number above ``above`` that ``direction . tip`` is nowhere below, or None where none was found.
    """
    waiting, bound = [(lower, upper)], np.inf
    for _ in range(BOXES):
        low, high = waiting.pop()
        low, high, least, share = _bound_box(arm, direction, low, high)
        if least > above:
            bound = min(bound, least)
            if not waiting:
                return float(bound)
            continue
        joint = int(np.argmax(share))
        middle = (low[joint] + high[joint]) / 2
        if direction @ arm.at((low + high) / 2).position <= above or share[joint] == 0:
            return None
        left, right = high.copy(), low.copy()
        left[joint] = right[joint] = middle
        waiting += [(low, left), (right, high)]
    return None


def _bound_box(arm: Arm, direction: Array, low: Array, high: Array) -> tuple[Array, Array, float, Array]:
    """Shrink a box to where the minimum is; return it, a lower bound, and what each joint takes away from it."""
    while True:
        half = (high - low) / 2
        tip = arm.at((low + high) / 2)
        slope, bend = direction @ tip.jacobian, np.abs(tip.curvature(direction))
        twice, thrice = _remainders(arm.reach * float(np.linalg.norm(direction)), half)
        change = bend @ half + twice
        rising, falling = (half > 0) & (slope > change), (half > 0) & (-slope > change)
        if not (rising | falling).any():
            share = half * (np.abs(slope) + change)
            loss = np.abs(slope) @ half + half @ bend @ half / 2 + thrice
            return low, high, float(direction @ tip.position - loss), share
        low, high = np.where(falling, high, low), np.where(rising, low, high)


def _remainders(reach: Array, half: Array) -> tuple[Array, float]:
    """Bound what third derivatives add to each first derivative, shape (n,), and to the value.

    The derivative by joints i <= j <= k is at most ``reach[k]``, that of the outermost. So among the triples of joints
    those with outermost k weigh ``W_k^3 - W_(k-1)^3`` with ``W_k`` the sum of ``half`` up to k.
    """
    total = np.cumsum(half)
    pairs = reach * np.diff(total**2, prepend=0.0)
    beyond = pairs.sum() - np.cumsum(pairs)
    triples = float(reach @ np.diff(total**3, prepend=0.0))
    return (reach * total**2 + beyond) / 2, triples / 6
