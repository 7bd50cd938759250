"""Pinocchio's forward kinematics of many states, with little between one state and the next."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import MachineError

if TYPE_CHECKING:
    import pinocchio as pin

Array = NDArray[np.float64]


def trace(
    model: "pin.Model", data: "pin.Data", q: Array, joints: list[int], *, n_turned: int = 1
) -> tuple[Array, Array]:
    """Run the forward kinematics of K states.

    Poses are read through arrays that share Pinocchio's memory, as bytes: that takes as long as the kinematics
    themselves, asking for every pose four times as long.

    Args:
        model: The model.
        data: Its memory.
        q: Joint positions [rad], shape (n, K).
        joints: The joints that are wanted.
        n_turned: Of how many of them, the first ones, the rotations are wanted.

    Returns:
        ``(rotations, positions)``: rotation matrices in the world frame, shape (n_turned, 3, 3, K), and positions of
        all joints [m], shape (joints, 3, K).

    Raises:
        MachineError: Pinocchio's arrays are copies.
    """
    import pinocchio as pin

    move, poses = pin.forwardKinematics, [data.oMi[joint] for joint in joints]
    shared = [*(pose.rotation for pose in poses[:n_turned]), *(pose.translation for pose in poses)]
    read, found = [array.tobytes for array in shared], []
    for state in np.ascontiguousarray(q.T):
        move(model, data, state)
        for part in read:
            found.append(part())  # noqa: PERF401 - a list of the parts of each state takes longer
    if not np.array_equal(shared[0], poses[0].rotation, equal_nan=True):
        raise MachineError("Pinocchio's arrays are copies of its memory: leave eigenpy.sharedMemory(True) as it is")
    numbers = np.frombuffer(b"".join(found)).reshape(q.shape[1], -1, 3).transpose(1, 2, 0).copy()
    turned = 3 * n_turned
    return numbers[:turned].reshape(n_turned, 3, 3, -1), numbers[turned:]
