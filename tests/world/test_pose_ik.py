"""Inverse kinematics of poses, against Pinocchio's kinematics and SciPy's rotations."""

import numpy as np
import pinocchio as pin
import pytest
import scipy

from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.robot import Robot
from cnpgen.world.pose_ik import (
    PoseKinematics,
    PoseTolerance,
    rotation_matrices,
    rotation_vectors,
    solve_pose_ik,
)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot(load_problem("heavy-object"))


def test_rotation_vectors_agree_with_scipy() -> None:
    rotations = scipy.spatial.transform.Rotation.random(50, random_state=0)
    small = scipy.spatial.transform.Rotation.from_rotvec(1e-12 * np.eye(3))
    for each in (rotations, small):
        assert rotation_vectors(each.as_matrix()) == pytest.approx(
            each.as_rotvec(), abs=1e-9
        )
        assert rotation_matrices(each.as_rotvec()) == pytest.approx(
            each.as_matrix(), abs=1e-12
        )


def test_poses_and_jacobians_are_pinocchios(robot: Robot) -> None:
    q = np.random.default_rng(1).uniform(
        robot.position_lower, robot.position_upper, (5, robot.n)
    )
    positions, rotations, jacobians = PoseKinematics(robot).evaluate(q.T.copy())
    data = robot.model.createData()
    for state, position, rotation, J in zip(
        q, positions, rotations, jacobians, strict=True
    ):
        pin.framesForwardKinematics(robot.model, data, state)
        assert position == pytest.approx(
            data.oMf[robot.tip_frame].translation, abs=1e-12
        )
        assert rotation == pytest.approx(data.oMf[robot.tip_frame].rotation, abs=1e-12)
        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        assert (
            pytest.approx(
                pin.computeFrameJacobian(
                    robot.model, data, state, robot.tip_frame, frame
                ),
                abs=1e-12,
            )
            == J
        )


def test_reachable_poses_are_found_within_the_joint_limits(robot: Robot) -> None:
    random = np.random.default_rng(2)
    span = robot.position_upper - robot.position_lower
    kinematics, solved = PoseKinematics(robot), 0
    for _ in range(20):
        goal = robot.position_lower + span * random.uniform(0.1, 0.9, robot.n)
        positions, rotations, _ = kinematics.evaluate(
            np.repeat(goal[:, None], 32, axis=1)
        )
        seeds = robot.position_lower[:, None] + span[:, None] * random.uniform(
            size=(robot.n, 32)
        )
        q, met = solve_pose_ik(kinematics, positions, rotations, seeds)
        solved += bool(met.any())
        assert (
            (q >= robot.position_lower[:, None]) & (q <= robot.position_upper[:, None])
        ).all()
        for state in q.T[met]:
            data = robot.model.createData()
            pin.framesForwardKinematics(robot.model, data, state)
            assert data.oMf[robot.tip_frame].translation == pytest.approx(
                positions[0], abs=1e-5
            )
            assert data.oMf[robot.tip_frame].rotation == pytest.approx(
                rotations[0], abs=1e-5
            )
    assert solved == 20


def test_unreachable_poses_are_not_reported_as_met(robot: Robot) -> None:
    seeds = np.zeros((robot.n, 4))
    _, met = solve_pose_ik(
        PoseKinematics(robot),
        np.full((4, 3), 3.0),
        np.repeat(np.eye(3)[None], 4, axis=0),
        seeds,
    )
    assert not met.any()


def test_tolerances_and_free_axes_accept_more_poses(robot: Robot) -> None:
    random, count = np.random.default_rng(3), 64
    kinematics, span = (
        PoseKinematics(robot),
        robot.position_upper - robot.position_lower,
    )
    goal = robot.position_lower + span * random.uniform(0.2, 0.8, robot.n)
    positions, rotations, _ = kinematics.evaluate(
        np.repeat(goal[:, None], count, axis=1)
    )
    seeds = robot.position_lower[:, None] + span[:, None] * random.uniform(
        size=(robot.n, count)
    )
    limits = np.array([[0.02, 0.0, 0.1], [0.0, 0.3, np.pi]])
    tolerance = PoseTolerance(*np.repeat(limits[:, None], count, axis=1))
    q, met = solve_pose_ik(kinematics, positions, rotations, seeds, tolerance=tolerance)
    reached, turned, _ = kinematics.evaluate(q)
    back = scipy.spatial.transform.Rotation.from_matrix(rotations).inv()
    shift = np.abs(back.apply(reached - positions))[met]
    turn = np.abs(
        (back * scipy.spatial.transform.Rotation.from_matrix(turned)).as_rotvec()
    )[met]
    assert met.sum() > solve_pose_ik(kinematics, positions, rotations, seeds)[1].sum()
    assert (shift <= limits[0] + 1e-6).all()
    assert (turn <= limits[1] + 1e-6).all()
    assert turn[:, 2].max() > 0.35  # any rotation about z
    assert shift[:, 0].max() > 0.01
