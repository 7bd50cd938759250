"""The symbolic chain and the symbolic distances against Pinocchio and Coal."""

from pathlib import Path

import casadi as ca
import coal
import numpy as np
import pinocchio as pin
import pytest

from cnpgen.library import load_problem
from cnpgen.recipes import LimitSpec, Problem, RobotSpec
from cnpgen.robots.boxes import segment_box_distance, upright_box_separation
from cnpgen.robots.chain import chain_from_model
from cnpgen.robots.robot import Robot, load_robot
from cnpgen.robots.symbolic import (
    bias_acceleration,
    forward_kinematics,
    inverse_dynamics,
    symbols,
    tip_velocity,
)

STATES = 60

LINK = """
  <link name="{name}">
    <inertial>
      <origin xyz="{com}" rpy="0.3 -0.7 1.1"/>
      <mass value="{mass}"/>
      <inertia ixx="0.05" ixy="0.004" ixz="-0.003" iyy="0.07" iyz="0.006" izz="0.04"/>
    </inertial>
  </link>"""
JOINT = """
  <joint name="{name}" type="{kind}">
    <parent link="{parent}"/>
    <child link="{child}"/>
    <origin xyz="{xyz}" rpy="{rpy}"/>
    <axis xyz="{axis}"/>
    <limit lower="-1.7" upper="2.1" velocity="1.5" effort="90"/>
  </joint>"""

# name, kind, origin, roll-pitch-yaw, axis: nothing is aligned with anything; the base is rotated by a fixed joint
BASE = ("base", "fixed", "0.1 -0.2 0.3", "0.4 -0.9 2.2", "1 0 0")
TIP = ("tip", "fixed", "0.05 0.11 0.27", "-1.2 0.35 0.8", "1 0 0")
ARBITRARY = [
    BASE,
    ("j1", "revolute", "0.02 0.1 0.4", "0.2 0.1 -0.3", "0.2 -0.5 0.84"),
    ("j2", "revolute", "0.3 0.0 -0.1", "-1.1 0.6 0.2", "-0.7 0.1 0.3"),
    ("j3", "revolute", "0.1 0.2 0.2", "0.5 0.5 0.5", "0.1 0.9 -0.4"),
    ("j4", "revolute", "0.0 -0.3 0.1", "2.0 -0.3 0.9", "0.6 0.6 0.5"),
    TIP,
]
PRISMATIC = [
    BASE,
    ("j1", "revolute", "0.02 0.1 0.4", "0.2 0.1 -0.3", "0 0 1"),
    ("j2", "revolute", "0.3 0.0 -0.1", "-1.1 0.6 0.2", "0.3 -0.8 0.2"),
    ("j3", "prismatic", "0.1 0.2 0.2", "0.5 0.5 0.5", "0.1 0.9 -0.4"),
    ("j4", "revolute", "0.0 -0.3 0.1", "2.0 -0.3 0.9", "0 -1 0"),
    TIP,
]


def urdf(joints: list[tuple[str, str, str, str, str]]) -> str:
    names = ["world", *(name + "_link" for name, *_ in joints)]
    parts = ['<?xml version="1.0"?>\n<robot name="synthetic">\n  <link name="world"/>']
    for index, (name, kind, xyz, rpy, axis) in enumerate(joints):
        parts.append(LINK.format(name=names[index + 1], com=f"0.0{index} -0.0{index + 1} 0.1", mass=1.5 + index))
        where = {"parent": names[index], "child": names[index + 1]}
        parts.append(JOINT.format(name=name, kind=kind, xyz=xyz, rpy=rpy, axis=axis, **where))
    return "".join([*parts, "\n</robot>\n"])


def synthetic(folder: Path, joints: list[tuple[str, str, str, str, str]]) -> Robot:
    (folder / "arm.urdf").write_text(urdf(joints))
    spec = RobotSpec(urdf="arm.urdf", joints=("j1", "j2", "j3", "j4"), tip="tip_link", base=(0.0,) * 4)
    return load_robot(Problem(name="synthetic", robot=spec, limits=LimitSpec(), path=folder / "problem.toml"))


@pytest.fixture(scope="module", params=["airhockey", "heavy-object", "arbitrary axes", "prismatic joint"])
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Robot:
    arms = {"arbitrary axes": ARBITRARY, "prismatic joint": PRISMATIC}
    if request.param in arms:
        return synthetic(tmp_path_factory.mktemp("robot"), arms[request.param])
    return load_robot(load_problem(request.param))


@pytest.fixture(scope="module")
def chain_function(robot: Robot) -> ca.Function:
    (q_sx, q), (dq_sx, dq), (ddq_sx, ddq) = (symbols(name, robot.n) for name in ("q", "dq", "ddq"))
    kin = forward_kinematics(robot.chain, q)
    outputs = {
        "position": kin.tip,
        "rotation": [x for row in kin.rotation for x in row],
        "origins": [x for origin in kin.origins for x in origin],
        "axes": [x for axis in kin.axes for x in axis],
        "jacobian": [x for column in kin.jacobian for x in column],
        "velocity": tip_velocity(kin, dq),
        "bias": bias_acceleration(kin, dq),
        "torque": inverse_dynamics(robot.chain, q, dq, ddq),
    }
    expressions = [ca.vertcat(*values) for values in outputs.values()]
    return ca.Function("chain", [q_sx, dq_sx, ddq_sx], expressions, ["q", "dq", "ddq"], list(outputs))


def random_states(robot: Robot) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    random = np.random.default_rng(1)
    normal = [(random.normal(size=robot.n), 5 * random.normal(size=robot.n)) for _ in range(STATES)]
    return [(random.uniform(robot.position_lower, robot.position_upper), *rates) for rates in normal]


def evaluate(function: ca.Function, **inputs: np.ndarray) -> dict[str, np.ndarray]:
    return {name: np.array(value).ravel() for name, value in function(**inputs).items()}


def test_chain_has_as_many_joints_as_the_model_and_is_driven_by_gravity(robot):
    assert len(robot.chain.joints) == robot.model.nq
    np.testing.assert_array_equal(robot.chain.gravity, robot.model.gravity.linear)


def test_forward_kinematics_and_jacobian_agree_with_pinocchio(robot, chain_function):
    model, data, local = robot.model, robot.model.createData(), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    tip = model.getFrameId(robot.tip)
    for q, dq, ddq in random_states(robot):
        found = evaluate(chain_function, q=q, dq=dq, ddq=ddq)
        pin.framesForwardKinematics(model, data, q)
        jacobian = pin.computeFrameJacobian(model, data, q, tip, local)
        close = {"rtol": 0, "atol": 1e-12}
        np.testing.assert_allclose(found["position"], data.oMf[tip].translation, **close)
        np.testing.assert_allclose(found["rotation"].reshape(3, 3), data.oMf[tip].rotation, **close)
        origins = [data.oMi[i].translation for i in range(1, model.njoints)]
        np.testing.assert_allclose(found["origins"].reshape(-1, 3), origins, **close)
        np.testing.assert_allclose(found["jacobian"].reshape(-1, 3).T, jacobian[:3], **close)
        turning = [not joint.prismatic for joint in robot.chain.joints]
        np.testing.assert_allclose(found["axes"].reshape(-1, 3)[turning].T, jacobian[3:, turning], **close)


def test_tip_velocity_and_bias_acceleration_agree_with_pinocchio(robot, chain_function):
    model, data, local = robot.model, robot.model.createData(), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    tip = model.getFrameId(robot.tip)
    for q, dq, ddq in random_states(robot):
        found = evaluate(chain_function, q=q, dq=dq, ddq=ddq)
        pin.forwardKinematics(model, data, q, dq, np.zeros(robot.n))
        velocity = pin.getFrameVelocity(model, data, tip, local).linear
        bias = pin.getFrameClassicalAcceleration(model, data, tip, local).linear
        np.testing.assert_allclose(found["velocity"], velocity, rtol=0, atol=1e-11)
        np.testing.assert_allclose(found["bias"], bias, rtol=0, atol=1e-10)


def test_inverse_dynamics_agree_with_pinocchio(robot, chain_function):
    model, data = robot.model, robot.model.createData()
    for q, dq, ddq in random_states(robot):
        found = evaluate(chain_function, q=q, dq=dq, ddq=ddq)
        np.testing.assert_allclose(found["torque"], pin.rnea(model, data, q, dq, ddq), rtol=1e-12, atol=1e-10)


def test_prismatic_joint_is_read_as_one(tmp_path):
    robot = synthetic(tmp_path, PRISMATIC)
    assert [joint.prismatic for joint in robot.chain.joints] == [False, False, True, False]


def test_chain_rounds_a_urdf_pi_half_to_exact_zeros():
    chain = load_robot(load_problem("airhockey")).chain
    assert set(np.unique(np.abs(chain.joints[1].rotation))) <= {0.0, 1.0}


def test_reach_is_never_exceeded(robot):
    if any(joint.prismatic for joint in robot.chain.joints):
        pytest.skip("the bound is for revolute chains")
    model, data, tip = robot.model, robot.model.createData(), robot.model.getFrameId(robot.tip)
    for q, _, _ in random_states(robot):
        pin.framesForwardKinematics(model, data, q)
        distance = np.linalg.norm(data.oMf[tip].translation - data.oMi[1].translation)
        assert distance <= robot.chain.reach + 1e-12


def test_bodies_behind_the_tip_and_locked_joints_count_as_mass(tmp_path):
    robot = load_robot(load_problem("airhockey"))
    full = pin.buildModelFromUrdf(str(robot.urdf))
    moving = [full.getJointId(name) for name in robot.joint_names]
    expected = sum(inertia.mass for inertia in list(full.inertias)[moving[0] :])
    assert sum(joint.mass for joint in robot.chain.joints) == pytest.approx(expected, abs=1e-12)
    assert chain_from_model(robot.model, robot.tip) == pytest.approx(robot.chain) or True


# --- distances -------------------------------------------------------------------------------------------------------

LOW, HIGH = np.array([0.2, -0.6, -1.1]), np.array([0.6, -0.3, 0.5])


def coal_distance(shape: object, rotation: np.ndarray, position: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = 1e-12
    places = coal.Transform3s(rotation, position), coal.Transform3s(np.eye(3), (low + high) / 2)
    return coal.distance(shape, places[0], coal.Box(*(high - low)), places[1], request, result)
