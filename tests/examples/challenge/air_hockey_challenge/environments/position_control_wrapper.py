"""The controller of positions: feed-forward by MuJoCo's own mass matrix, gains in proportion to it."""

import mujoco
import numpy as np

GAIN = 60.0  # rad/s
TICK_S = 1e-3


class PositionControlIIWA:
    """Without interpolation an action is 20 positions, velocities and accelerations."""

    def __init__(self, interpolation_order: object) -> None:
        assert interpolation_order is None
        super().__init__()

    def _step_init(self, action: np.ndarray) -> None:
        self._trajectory = iter(action)

    def _compute_action(self, obs: object, action: np.ndarray) -> np.ndarray:
        q, dq, ddq = (part[:6] for part in next(self._trajectory))
        q, dq = (
            q - TICK_S * dq,
            dq - TICK_S * ddq,
        )  # from the end of the tick to its beginning
        towards = (
            ddq
            + GAIN**2 * (q - self._data.qpos[:6])
            + 2 * GAIN * (dq - self._data.qvel[:6])
        )
        mass = np.zeros((self._model.nv, self._model.nv))
        mujoco.mj_fullM(self._model, self._data, mass)
        return np.append(mass[:6, :6] @ towards + self._data.qfrc_bias[:6], 0.0)
