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
        sin, cos = np.sin(q), np.cos(q)
        axes = np.empty((len(q) + 1, 3, 3, count))  # of every joint its x, y and z axis in the world
        origins = np.zeros((len(q) + 1, 3, count))
        axes[0] = np.eye(3)[..., None]
        found = np.empty((11, 3 * count))  # the same memory for all joints: new pages take longer than all else
        still, turned, back, (offset, slide) = np.split(found.reshape(-1, 3, count), (3, 6, 9))
        for joint, (parent, parts) in enumerate(zip(self._parents, self._parts, strict=True), 1):
            np.matmul(parts, axes[parent].reshape(3, -1), out=found)
            turned *= sin[joint - 1]
            back *= cos[joint - 1]
            slide *= q[joint - 1]
            np.add(still, turned, out=axes[joint])
            axes[joint] += back
            origins[joint] = origins[parent] + offset + slide
        rotations = axes.transpose(0, 2, 1, 3)
        self._check(q, rotations, origins)
        return rotations, origins

    def reach(self, spread: Array, furthest: Array) -> Array:
        """Bound how far a unit of each joint's speed moves any point of what it carries, seen from before it [m].

        Args:
            spread: How far from the origins of the base and of every joint what they move reaches [m], shape (n + 1,).
            furthest: Largest absolute joint positions, shape (n,).

        Returns:
            Shape (n,): the length of the way to the furthest point; 1 for joints that slide.
        """
        sizes = [np.linalg.norm(parts[9:], axis=1) for parts in self._parts]
        lengths = np.array([offset + slide * q for (offset, slide), q in zip(sizes, furthest, strict=True)])
        found = spread[1:].copy()
        for joint in range(len(found), 1, -1):
            found[joint - 2] = max(found[joint - 2], lengths[joint - 1] + found[joint - 1])
        if self._parents != list(range(len(found))):  # it branches: links see each other across the whole of it
            found[:] = lengths.sum() + 2 * spread.max()
        return np.where([slide > 0 for _, slide in sizes], 1.0, found)

    def _check(self, q: Array, rotations: Array, positions: Array) -> None:
        """Compare the first, the middle and the last state with Pinocchio's."""
        import pinocchio as pin

        for k in (0, q.shape[1] // 2, -1):
            state = q[:, k].copy()
            pin.forwardKinematics(self._model, self._data, state)
            pose, near = self._data.oMi[len(q)], VOUCHED * (1 + float(np.abs(state).max()))
            turned, moved = pose.rotation - rotations[-1, ..., k], pose.translation - positions[-1, :, k]
            off = max(float(np.abs(turned).max()), float(np.abs(moved).max()))
            if off > near:
                raise MachineError(f"forward kinematics differ from Pinocchio's by {off:.2g} at {state.tolist()}")


def _parts(model: "pin.Model", joint: int) -> Array:
    """Return a joint's pose in its parent's frame as rows of numbers, shape (11, 3).

    Its axes are those of the first three rows, the next three times sin q, and the next three times cos q, added; its
    origin is the last but one and the last times q.
    """
    data = model.joints[joint].createData()
    model.joints[joint].calc(data, np.zeros(model.nq), np.zeros(model.nv))
    motion = np.array(data.S).reshape(6)
    x, y, z = motion[3:]
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    place = model.jointPlacements[joint]
    turn = [np.eye(3) + across @ across, across, -across @ across]  # Rodrigues' formula
    axes = [(place.rotation @ each).T for each in turn]
    return np.concatenate([*axes, [place.translation], [place.rotation @ motion[:3]]])
