"""Forward kinematics of many states at once: the placements of Pinocchio's model, multiplied for all states together.

Asking Pinocchio for one state after the other takes twice as long. It is asked for a few of them, so that its own
forward kinematics vouch for the others.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import MachineError

if TYPE_CHECKING:
    import pinocchio as pin

Array = NDArray[np.float64]

_ORIGIN, _SLIDE = 3, 7  # rows of what a joint's pose is made of: its origin, and how it slides
VOUCHED = 1e-9  # how far poses may be from Pinocchio's, beside 1 + the largest joint position


class Trace:
    """The forward kinematics of a model.

    Args:
        model: The model; all of its joints turn about an axis or slide along one.
    """

    def __init__(self, model: "pin.Model") -> None:
        self._model, self._data = model, model.createData()
        self._parents = list(model.parents)[1:]
        self._parts = [_parts(model, joint) for joint in range(1, model.njoints)]
        self._lengths = np.array([np.linalg.norm(parts[[_ORIGIN, _SLIDE], :3], axis=1) for parts in self._parts])
        self._slides = self._lengths[:, 1] > 0

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Compute the poses of all joints at K states.

        Args:
            q: Joint positions [rad], shape (n, K), K > 0.

        Returns:
            ``(rotations, positions)``: rotation matrices in the world frame, that of the base first, shape
            (n + 1, 3, 3, K), and positions [m], shape (n + 1, 3, K).

        Raises:
            MachineError: They are not what Pinocchio says.
        """
        count = q.shape[1]
        turns = np.empty((len(q), 2, count))
        np.sin(q, out=turns[:, 0])
        np.cos(q, out=turns[:, 1])
        turns[self._slides, 0] = q[self._slides]
        frames = np.empty((len(q) + 1, 4, 3, count))  # of every joint its x, y and z axis and its origin in the world
        frames[0] = np.eye(4, 3)[..., None]
        found = np.empty((12, 3 * count))  # the same memory for all joints: new pages take longer than all else
        still, moved = found[:4].reshape(4, 3, count), found[4:].reshape(2, 4, 3, count)
        for joint, (parent, parts) in enumerate(zip(self._parents, self._parts, strict=True), 1):
            np.matmul(parts, frames[parent].reshape(4, -1), out=found)
            moved *= turns[joint - 1, :, None, None]
            np.add(still, moved[0], out=frames[joint])
            frames[joint] += moved[1]
        self._check(q, frames)
        return frames[:, :3].swapaxes(1, 2), frames[:, 3]

    def reach(self, spread: Array, furthest: Array) -> Array:
        """Bound how far a unit of each joint's speed moves any point of what it carries, seen from before it [m].

        Args:
            spread: How far from the origins of the base and of every joint what they move reaches [m], shape (n + 1,).
            furthest: Largest absolute joint positions, shape (n,).

        Returns:
            Shape (n,): the length of the way to the furthest point; 1 for joints that slide.
        """
        lengths = self._lengths[:, 0] + self._lengths[:, 1] * furthest
        found = spread[1:].copy()
        for joint in range(len(found), 1, -1):
            found[joint - 2] = max(found[joint - 2], lengths[joint - 1] + found[joint - 1])
        if self._parents != list(range(len(found))):  # it branches: links see each other across the whole of it
            found[:] = lengths.sum() + 2 * spread.max()
        return np.where(self._slides, 1.0, found)

    def _check(self, q: Array, frames: Array) -> None:
        """Compare the first, the middle and the last state with Pinocchio's."""
        looked = [0, q.shape[1] // 2, -1]
        states, poses = q[:, looked].T.copy(), frames[-1][..., looked]
        off = float(np.abs(poses - np.array([self._tell(state) for state in states]).T).max())
        if off > VOUCHED * (1 + np.abs(states).max()):
            raise MachineError(f"forward kinematics differ from Pinocchio's by {off:.2g} at one of {states.tolist()}")

    def _tell(self, state: Array) -> Array:
        """Return the last joint's pose as Pinocchio says it, shape (3, 4)."""
        import pinocchio as pin

        pin.forwardKinematics(self._model, self._data, state)
        return np.asarray(self._data.oMi[len(self._parts)].homogeneous[:3])


def _parts(model: "pin.Model", joint: int) -> Array:
    """Return what a joint's pose is made of, in its parent's frame, shape (12, 4).

    Its x, y and z axis and its origin are the first four rows, the next four times sin q, and the last four times cos
    q, added; of a joint that slides they are the first four, and the next four times q. A point (x, y, z) is (x, y, z,
    1), a vector (x, y, z, 0).
    """
    data = model.joints[joint].createData()
    model.joints[joint].calc(data, np.zeros(model.nq), np.zeros(model.nv))
    motion = np.array(data.S).reshape(6)
    x, y, z = motion[3:]
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    place, parts = model.jointPlacements[joint], np.zeros((12, 4))
    turn = [np.eye(3) + across @ across, across, -across @ across]  # Rodrigues' formula
    parts.reshape(3, 4, 4)[:, :3, :3] = [(place.rotation @ each).T for each in turn]
    parts[_ORIGIN] = [*place.translation, 1.0]
    parts[_SLIDE, :3] = place.rotation @ motion[:3]
    return parts
