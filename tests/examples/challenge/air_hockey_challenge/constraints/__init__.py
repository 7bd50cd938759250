"""Constraints of the stand-in: a limit of velocities that hits exceed, and others that they do not."""

import numpy as np


class JointVelocityConstraint:
    """Limit of the observed velocities [rad/s]."""

    name, limit = "joint_vel_constr", 0.2

    def __init__(self, env_info: dict) -> None:
        assert "robot" in env_info

    def fun(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        assert q.shape == dq.shape == (7,)
        return np.abs(dq) - self.limit


class JointPositionConstraint(JointVelocityConstraint):
    name, limit = "joint_pos_constr", np.inf


class EndEffectorConstraint(JointVelocityConstraint):
    name, limit = "ee_constr", np.inf


class LinkConstraint(JointVelocityConstraint):
    name, limit = "link_constr", np.inf
