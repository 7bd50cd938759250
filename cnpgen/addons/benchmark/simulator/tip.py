"""Position, orientation and Jacobian of the tip, with Pinocchio."""

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.robot import Robot


class Tip:
    """Kinematics of the tip; not thread-safe, because Pinocchio's data are reused."""

    def __init__(self, robot: Robot) -> None:
        self._model = robot.model
        self._data = robot.model.createData()
        self._frame = robot.tip_frame

    def at(self, q: Array) -> tuple[Array, Array, Array]:
        """Return position [m], shape (3,), rotation, shape (3, 3), and Jacobian, shape (6, n), at q [rad], shape (n,).

        The Jacobian is in world axes, translation first.
        """
        import pinocchio as pin

        J = pin.computeFrameJacobian(
            self._model,
            self._data,
            q,
            self._frame,
            pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
        )
        pose = pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(pose.translation), np.array(pose.rotation), np.array(J)
