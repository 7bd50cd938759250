"""Forward kinematics of many states: what Pinocchio says of each."""

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import MachineError
from cnpgen.problems.load import load_problem
from cnpgen.problems.robot import load_robot
from cnpgen.world import trace as module
from cnpgen.world.trace import trace


@pytest.mark.parametrize("name", ["airhockey", "heavy-object"])
def test_poses_are_those_of_every_single_state(name: str) -> None:
    robot = load_robot(load_problem(name))
    model, data, other = robot.model, robot.model.createData(), robot.model.createData()
    q = np.random.default_rng(0).uniform(-2, 2, (robot.n, 40))
    joints = [robot.n, 1, 4]
    rotations, positions = trace(model, data, q, joints, n_turned=2)
    for k, state in enumerate(q.T):
        pin.forwardKinematics(model, other, state.copy())
        for joint, rotation in zip(joints, rotations, strict=False):
            np.testing.assert_array_equal(rotation[..., k], other.oMi[joint].rotation)
        for joint, position in zip(joints, positions, strict=True):
            np.testing.assert_array_equal(position[:, k], other.oMi[joint].translation)


def test_arrays_that_are_copies_are_noticed() -> None:
    robot = load_robot(load_problem("airhockey"))
    import eigenpy

    before = eigenpy.sharedMemory()
    eigenpy.sharedMemory(False)
    try:
        with pytest.raises(MachineError, match="sharedMemory"):
            module.trace(robot.model, robot.model.createData(), np.ones((robot.n, 3)), [robot.n])
    finally:
        eigenpy.sharedMemory(before)
