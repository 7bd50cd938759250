"""The symbolic chain and the symbolic distances against Pinocchio and Coal."""

from collections.abc import Iterator
from pathlib import Path

import casadi as ca
import coal
import numpy as np
import pinocchio as pin
import pytest

from cnpgen.kernels.interpreted_kernel import InterpretedKernel
from cnpgen.kernels.symbolic.convex_distances import (
    segment_box_distance,
    segment_box_separation,
    upright_box_separation,
)
from cnpgen.kernels.symbolic.dynamics import inverse_dynamics
from cnpgen.kernels.symbolic.kinematics import (
    bias_acceleration,
    forward_kinematics,
    tip_velocity,
)
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.tape import tape_from_function
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.robot_spec import LimitSpec, RobotSpec
from tests.conftest import some

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

# name, kind, origin, roll-pitch-yaw, axis: no axes are aligned; a fixed joint rotates the base
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
        parts.append(
            LINK.format(
                name=names[index + 1],
                com=f"0.0{index} -0.0{index + 1} 0.1",
                mass=1.5 + index,
            )
        )
        where = {"parent": names[index], "child": names[index + 1]}
        parts.append(
            JOINT.format(name=name, kind=kind, xyz=xyz, rpy=rpy, axis=axis, **where)
        )
    return "".join([*parts, "\n</robot>\n"])


def synthetic(folder: Path, joints: list[tuple[str, str, str, str, str]]) -> Robot:
    (folder / "arm.urdf").write_text(urdf(joints))
    spec = RobotSpec(
        urdf="arm.urdf",
        joints=("j1", "j2", "j3", "j4"),
        tip="tip_link",
        base=(0.0,) * 4,
    )
    return load_robot(
        Problem(
            name="synthetic",
            robot=spec,
            limits=LimitSpec(),
            path=folder / "problem.toml",
        )
    )


@pytest.fixture(
    scope="module",
    params=["airhockey", "heavy-object", "arbitrary axes", "prismatic joint"],
)
def robot(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Robot:
    arms = {"arbitrary axes": ARBITRARY, "prismatic joint": PRISMATIC}
    if request.param in arms:
        return synthetic(tmp_path_factory.mktemp("robot"), arms[request.param])
    return load_robot(load_problem(request.param))


@pytest.fixture(scope="module")
def chain_function(robot: Robot) -> ca.Function:
    (q_sx, q), (dq_sx, dq), (ddq_sx, ddq) = (
        symbols(name, robot.n) for name in ("q", "dq", "ddq")
    )
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
    return ca.Function(
        "chain", [q_sx, dq_sx, ddq_sx], expressions, ["q", "dq", "ddq"], list(outputs)
    )


def random_states(robot: Robot) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    random = np.random.default_rng(1)
    normal = [
        (random.normal(size=robot.n), 5 * random.normal(size=robot.n))
        for _ in range(STATES)
    ]
    return [
        (random.uniform(robot.position_lower, robot.position_upper), *rates)
        for rates in normal
    ]


def evaluate(function: ca.Function, **inputs: np.ndarray) -> dict[str, np.ndarray]:
    return {name: np.array(value).ravel() for name, value in function(**inputs).items()}


def test_chain_has_as_many_joints_as_the_model_and_is_driven_by_gravity(robot):
    assert len(robot.chain.joints) == robot.model.nq
    np.testing.assert_array_equal(robot.chain.gravity, robot.model.gravity.linear)


def test_forward_kinematics_and_jacobian_agree_with_pinocchio(robot, chain_function):
    model, data, local = (
        robot.model,
        robot.model.createData(),
        pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
    )
    tip = model.getFrameId(robot.tip)
    for q, dq, ddq in random_states(robot):
        found = evaluate(chain_function, q=q, dq=dq, ddq=ddq)
        pin.framesForwardKinematics(model, data, q)
        jacobian = pin.computeFrameJacobian(model, data, q, tip, local)
        close = {"rtol": 0, "atol": 1e-12}
        np.testing.assert_allclose(
            found["position"], data.oMf[tip].translation, **close
        )
        np.testing.assert_allclose(
            found["rotation"].reshape(3, 3), data.oMf[tip].rotation, **close
        )
        origins = [data.oMi[i].translation for i in range(1, model.njoints)]
        np.testing.assert_allclose(found["origins"].reshape(-1, 3), origins, **close)
        np.testing.assert_allclose(
            found["jacobian"].reshape(-1, 3).T, jacobian[:3], **close
        )
        turning = [not joint.prismatic for joint in robot.chain.joints]
        np.testing.assert_allclose(
            found["axes"].reshape(-1, 3)[turning].T, jacobian[3:, turning], **close
        )


def test_tip_velocity_and_bias_acceleration_agree_with_pinocchio(robot, chain_function):
    model, data, local = (
        robot.model,
        robot.model.createData(),
        pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
    )
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
        np.testing.assert_allclose(
            found["torque"], pin.rnea(model, data, q, dq, ddq), rtol=1e-12, atol=1e-10
        )


def test_a_prismatic_joint_is_read_as_prismatic(tmp_path):
    robot = synthetic(tmp_path, PRISMATIC)
    assert [joint.prismatic for joint in robot.chain.joints] == [
        False,
        False,
        True,
        False,
    ]


def test_chain_rounds_a_urdf_pi_half_to_exact_zeros():
    chain = load_robot(load_problem("airhockey")).chain
    assert set(np.unique(np.abs(chain.joints[1].rotation))) <= {0.0, 1.0}


def test_reach_of_a_revolute_chain_is_never_exceeded(tmp_path):
    for robot in (
        load_robot(load_problem("heavy-object")),
        synthetic(tmp_path, ARBITRARY),
    ):
        model, data = robot.model, robot.model.createData()
        for q, _, _ in random_states(robot):
            pin.framesForwardKinematics(model, data, q)
            tip = data.oMf[model.getFrameId(robot.tip)].translation
            assert (
                np.linalg.norm(tip - data.oMi[1].translation)
                <= robot.chain.reach + 1e-12
            )


def test_every_moving_body_counts_once(robot):
    full = pin.buildModelFromUrdf(str(robot.urdf))
    first = full.getJointId(robot.joint_names[0])
    expected = sum(inertia.mass for inertia in list(full.inertias)[first:])
    assert sum(joint.mass for joint in robot.chain.joints) == pytest.approx(
        expected, abs=1e-12
    )


# --- distances: one obstacle, random and degenerate segments and cuboids against Coal ---------------------------------

LOW, HIGH = np.array([0.2, -0.6, -1.1]), np.array([0.6, -0.3, 0.5])
SIZE = (0.2, 0.2, 0.3)
FACES = np.array([LOW - 0.1, LOW, (LOW + HIGH) / 2, HIGH, HIGH + 0.1])


def coal_distance(shape: object, rotation: np.ndarray, position: np.ndarray) -> float:
    request = coal.DistanceRequest()
    request.gjk_tolerance, request.epa_tolerance = 1e-12, 1e-9
    places = (
        coal.Transform3s(rotation, position),
        coal.Transform3s(np.eye(3), (LOW + HIGH) / 2),
    )
    return coal.distance(
        shape,
        places[0],
        coal.Box(*(HIGH - LOW)),
        places[1],
        request,
        coal.DistanceResult(),
    )


def coal_segment_separation(first: np.ndarray, second: np.ndarray) -> float:
    length = float(np.linalg.norm(second - first))
    along = (second - first) / length if length else np.array([0.0, 0.0, 1.0])
    rotation = pin.Quaternion.FromTwoVectors(
        np.array([0.0, 0.0, 1.0]), along
    ).toRotationMatrix()
    return coal_distance(coal.Capsule(0.0, length), rotation, (first + second) / 2)


def segments(kind: str, count: int = 400) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    random = np.random.default_rng(2)
    for _ in range(count):
        first, second = random.uniform(LOW - 0.4, HIGH + 0.4, (2, 3))
        axis = random.integers(3)
        if kind == "parallel to two faces":
            second[axis] = first[axis]
        if kind == "parallel to an edge":
            second = np.where(np.arange(3) == axis, second, first)
        if kind == "in the plane of a face":
            first[axis] = second[axis] = random.choice([LOW[axis], HIGH[axis]])
        if kind == "between corners, edges and faces":
            first, second = (
                np.array([random.choice(FACES[:, k]) for k in range(3)])
                for _ in range(2)
            )
        if kind == "inside":
            first, second = random.uniform(LOW, HIGH, (2, 3))
        if kind == "touching the top":
            first, second = (
                np.append(random.uniform(LOW, HIGH)[:2], HIGH[2]),
                second + np.array([0, 0, 2]),
            )
        if kind == "of no length":
            second = first.copy()
        yield first, second


def box_bounds() -> list[tuple[float, float]]:
    return list(zip(LOW.tolist(), HIGH.tolist(), strict=True))


@pytest.fixture(scope="module")
def segment_function() -> ca.Function:
    (first_sx, first), (second_sx, second) = symbols("first", 3), symbols("second", 3)
    return ca.Function(
        "segment",
        [first_sx, second_sx],
        [segment_box_distance(first, second, box_bounds())],
    )


@pytest.fixture(scope="module")
def separation_function() -> ca.Function:
    (first_sx, first), (second_sx, second) = symbols("first", 3), symbols("second", 3)
    return ca.Function(
        "separation",
        [first_sx, second_sx],
        [segment_box_separation(first, second, box_bounds())],
    )


@pytest.mark.parametrize(
    "kind",
    [
        "random",
        "parallel to two faces",
        "parallel to an edge",
        "in the plane of a face",
        "between corners, edges and faces",
        "inside",
        "touching the top",
        "of no length",
    ],
)
def test_segment_box_distances_agree_with_coal(
    segment_function, separation_function, kind
):
    cases = list(segments(kind))
    found = np.array(
        [float(segment_function(first, second)) for first, second in cases]
    )
    expected = np.array(
        [coal_segment_separation(first, second) for first, second in cases]
    )
    np.testing.assert_allclose(found, np.maximum(expected, 0), rtol=0, atol=1e-9)
    separation = np.array(
        [float(separation_function(first, second)) for first, second in cases]
    )
    np.testing.assert_allclose(separation, expected, rtol=0, atol=2e-9)
    if kind in {"inside", "touching the top"}:
        np.testing.assert_array_equal(found, 0.0)


def test_segment_box_distance_is_not_nan_where_numpy_maximum_returns_nan(
    segment_function,
):
    first, second = (
        np.array(points).T.copy()
        for points in zip(*segments("between corners, edges and faces"), strict=True)
    )
    expected = [
        float(segment_function(a, b)) for a, b in zip(first.T, second.T, strict=True)
    ]
    (found,) = InterpretedKernel(tape_from_function(segment_function))(first, second)
    np.testing.assert_allclose(found[0], expected, rtol=0, atol=1e-15)


@pytest.fixture(scope="module")
def cuboid_function() -> ca.Function:
    (center_sx, center), (rotation_sx, rotation) = (
        symbols("center", 3),
        symbols("rotation", 9),
    )
    rows = [rotation[0:3], rotation[3:6], rotation[6:9]]
    endless = [*box_bounds()[:2], (None, HIGH[2])]
    outputs = [
        upright_box_separation(center, rows, SIZE, box)
        for box in (box_bounds(), endless)
    ]
    return ca.Function("cuboid", [center_sx, rotation_sx], outputs)


def cuboids(tilt: float, count: int = 1500) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    random = np.random.default_rng(3)
    for index in range(count):
        position = random.uniform(LOW - 0.2, HIGH + 0.2)
        position[2] = (
            HIGH[2]
            + 0.15
            + random.choice(
                [0.0, 1e-9, -1e-9, 1e-4, -1e-4, *random.uniform(-0.4, 0.1, 3)]
            )
        )
        turn = [0.0, np.pi / 2, *random.uniform(-np.pi, np.pi, 4)][index % 6]
        lean = random.uniform(-np.pi, np.pi)
        rotation = pin.exp3(
            tilt * np.array([np.cos(lean), np.sin(lean), 0.0])
        ) @ pin.exp3(np.array([0.0, 0.0, turn]))
        yield position, rotation


def test_separation_of_an_upright_cuboid_agrees_with_coal(cuboid_function):
    overlapping = 0
    for position, rotation in cuboids(tilt=0.0):
        found, _ = (
            float(value) for value in cuboid_function(position, rotation.ravel())
        )
        expected = coal_distance(coal.Box(*SIZE), rotation, position)
        overlapping += expected < 0
        if expected <= 0:
            assert found == pytest.approx(expected, abs=1e-9)
        else:
            assert -1e-9 < found < expected + 1e-9
    assert 300 < overlapping < 1400


@pytest.mark.parametrize("tilt", some([1e-8, 1e-3, np.deg2rad(1.0)], 1, "slow"))
def test_separation_of_a_tilted_cuboid_is_a_lower_bound_with_an_error_of_tilt_times_edge(
    cuboid_function, tilt
):
    for position, rotation in cuboids(tilt):
        found, _ = (
            float(value) for value in cuboid_function(position, rotation.ravel())
        )
        expected = coal_distance(coal.Box(*SIZE), rotation, position)
        assert found <= expected + 1e-9 + tilt**2 * max(-expected, 0.0)
        assert found >= expected - 1e-9 - tilt * max(SIZE) or expected > 0


def test_a_box_without_lower_end_separates_from_above_and_from_the_sides_only(
    cuboid_function,
):
    upright = np.eye(3).ravel()
    below = np.array([0.4, -0.45, LOW[2] - 0.5])
    box, endless = (float(value) for value in cuboid_function(below, upright))
    assert box == pytest.approx(0.35)
    assert endless == pytest.approx(-0.25)  # the smallest translation is along y
