"""Forward kinematics of many states at once, from the joint placements of Pinocchio's model.

One call of Pinocchio per state takes twice as long. Three states of every call are
compared with Pinocchio's own forward kinematics.
"""

from typing import TYPE_CHECKING

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import MachineError

if TYPE_CHECKING:
    import pinocchio as pin

# Rows of a joint's coefficients: its origin, and its direction if it slides.
_ORIGIN = 3
_SLIDE = 7
# Between our poses and Pinocchio's, relative to 1 + the largest joint position.
MAX_POSE_ERROR = 1e-9


class ForwardKinematics:
    """The forward kinematics of a model with revolute and prismatic joints only."""

    def __init__(self, model: "pin.Model") -> None:
        self._model = model
        self._data = model.createData()
        self._parents = list(model.parents)[1:]
        self._coefficients = [
            _coefficients(model, joint) for joint in range(1, model.njoints)
        ]
        lengths = [
            np.linalg.norm(rows[[_ORIGIN, _SLIDE], :3], axis=1)
            for rows in self._coefficients
        ]
        self._lengths = np.array(lengths)
        self._slides = self._lengths[:, 1] > 0

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Compute the poses of all joints at K > 0 states q [rad], shape (n, K).

        Returns:
            ``(rotations, positions)``: rotation matrices in the world frame, that of
            the base first, shape (n + 1, 3, 3, K), and positions [m], shape (n + 1, 3,
            K).

        Raises:
            MachineError: The poses differ from Pinocchio's.
        """
        count = q.shape[1]
        factors = np.empty((len(q), 2, count))
        np.sin(q, out=factors[:, 0])
        np.cos(q, out=factors[:, 1])
        factors[self._slides, 0] = q[self._slides]
        # x, y and z axis and origin of every joint in the world frame
        frames = np.empty((len(q) + 1, 4, 3, count))
        frames[0] = np.eye(4, 3)[..., None]
        # Reused for all joints: allocating new pages dominates the run time.
        products = np.empty((12, 3 * count))
        constant = products[:4].reshape(4, 3, count)
        moving = products[4:].reshape(2, 4, 3, count)
        for joint, (parent, coefficients) in enumerate(
            zip(self._parents, self._coefficients, strict=True), 1
        ):
            # One product for all three terms of all states: parent's frame times the
            # coefficients.
            np.matmul(coefficients, frames[parent].reshape(4, -1), out=products)
            moving *= factors[joint - 1, :, None, None]
            np.add(constant, moving[0], out=frames[joint])
            frames[joint] += moving[1]
        self._check(q, frames)
        return frames[:, :3].swapaxes(1, 2), frames[:, 3]

    def motion_bounds(self, extents: Array, max_positions: Array) -> Array:
        """Bound the displacement of any point of the robot per unit of motion of each joint [m], shape (n,).

        It is the maximum distance along the chain to a point that the joint moves; 1
        for prismatic joints. Extents are the largest distances of points of the links
        from the origin of the base or of their joint [m], shape (n + 1,).
        """
        # Distance of the joint from its parent; a prismatic one adds its largest
        # position.
        lengths = self._lengths[:, 0] + self._lengths[:, 1] * max_positions
        # From the tip to the base: the farthest point that a joint moves is at the next
        # joint's distance plus that joint's bound.
        bounds = extents[1:].copy()
        for joint in range(len(bounds), 1, -1):
            bounds[joint - 2] = max(
                bounds[joint - 2], lengths[joint - 1] + bounds[joint - 1]
            )
        if self._parents != list(range(len(bounds))):
            # A tree: two links can move across the whole of it.
            bounds[:] = lengths.sum() + 2 * extents.max()
        return np.where(self._slides, 1.0, bounds)

    def _check(self, q: Array, frames: Array) -> None:
        """Compare the first, the central and the last state with Pinocchio."""
        import pinocchio as pin

        # An error of the model would show at any state; three are enough.
        checked = [0, q.shape[1] // 2, -1]
        states = q[:, checked].T.copy()
        poses = frames[-1][..., checked]
        expected = np.empty((len(states), 3, 4))
        for pose, state in zip(expected, states, strict=True):
            pin.forwardKinematics(self._model, self._data, state)
            pose[:] = self._data.oMi[len(self._coefficients)].homogeneous[:3]
        error = float(np.abs(poses - expected.T).max())
        if error > MAX_POSE_ERROR * (1 + np.abs(states).max()):
            raise MachineError(
                f"forward kinematics differ from Pinocchio's by {error:.2g} at one of {states.tolist()}"
            )


def joint_motion(model: "pin.Model", joint: int) -> Array:
    """Return the linear and the angular velocity per unit velocity of a joint in its own frame, shape (6,)."""
    data = model.joints[joint].createData()
    model.joints[joint].calc(data, np.zeros(model.nq), np.zeros(model.nv))
    return np.array(data.S).reshape(6)


def _coefficients(model: "pin.Model", joint: int) -> Array:
    """Return the coefficients of a joint's pose in the frame of its parent, shape (12, 4).

    Each four rows are its x, y and z axis and origin: constants, factors of sin q, or
    of q of a prismatic joint, and of cos q. A point is (x, y, z, 1), a vector (x, y, z,
    0).
    """
    motion = joint_motion(model, joint)
    x, y, z = motion[3:]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # Rodrigues' formula R = I + [a]x^2 + sin(q) [a]x - cos(q) [a]x^2 for a unit axis a.
    placement = model.jointPlacements[joint]
    rows = np.zeros((12, 4))
    terms = [np.eye(3) + cross @ cross, cross, -cross @ cross]  # Rodrigues' formula
    rows.reshape(3, 4, 4)[:, :3, :3] = [(placement.rotation @ term).T for term in terms]
    rows[_ORIGIN] = [*placement.translation, 1.0]
    rows[_SLIDE, :3] = placement.rotation @ motion[:3]
    return rows
