"""The public robot model against Pinocchio, Coal and finite differences."""

import numpy as np
import pinocchio as pin
import pytest

import cnpgen
from cnpgen.errors import UsageError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.robot_model import RobotModel
from cnpgen.world.world import World
from tests.conftest import some

PROBLEMS = some(("heavy-object", "airhockey"), mark="slow")


def random_states(
    model: RobotModel, n: int = 8
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(1)
    q = random.uniform(
        model.position_lower, model.position_upper, (n, len(model.joint_names))
    )
    dq = random.uniform(-1, 1, q.shape) * model.velocity_limit
    return q, dq, random.uniform(-1, 1, q.shape) * model.acceleration_limit


@pytest.fixture(scope="module", params=PROBLEMS)
def model(request: pytest.FixtureRequest) -> RobotModel:
    return RobotModel(request.param)


def test_kinematics_and_dynamics_are_those_of_pinocchio(model: RobotModel) -> None:
    robot = load_robot(model.problem)
    data, frame = robot.model.createData(), robot.tip_frame
    states = random_states(model)
    positions, rotations = model.forward_kinematics(states[0])
    jacobians, torques = model.jacobian(states[0]), model.inverse_dynamics(*states)
    for k, (q, dq, ddq) in enumerate(zip(*states, strict=True)):
        pin.framesForwardKinematics(robot.model, data, q)
        np.testing.assert_allclose(
            positions[k], data.oMf[frame].translation, atol=1e-12
        )
        np.testing.assert_allclose(rotations[k], data.oMf[frame].rotation, atol=1e-12)
        expected = pin.computeFrameJacobian(
            robot.model, data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        np.testing.assert_allclose(jacobians[k], expected, atol=1e-12)
        np.testing.assert_allclose(
            torques[k], pin.rnea(robot.model, data, q, dq, ddq), atol=1e-9
        )


def test_one_state_is_a_batch_of_one_and_rates_default_to_zero(
    model: RobotModel,
) -> None:
    (q, *_), *_ = random_states(model, 1)
    np.testing.assert_array_equal(
        model.forward_kinematics(q)[0], model.forward_kinematics(q[None])[0]
    )
    still = np.zeros_like(q)
    np.testing.assert_array_equal(
        model.inverse_dynamics(q), model.inverse_dynamics(q, still, still)
    )


def scene_between(model: RobotModel, n: int) -> cnpgen.Scene:
    tips = model.forward_kinematics(random_states(model, 2 * n)[0])[0]
    return model.scene(tips[:n], tips[n:])


def test_constraint_values_are_those_of_the_measured_form(model: RobotModel) -> None:
    problem, states = model.problem, random_states(model)
    scene = scene_between(model, len(states[0]))
    values = model.constraint_values(*states, scene=scene)
    world = World(load_robot(problem), problem.obstacle, problem.object_size)
    joints = [
        index for index, name in enumerate(values.names) if name.startswith("joint")
    ]
    assert joints
    for k, state in enumerate(zip(*states, strict=True)):
        world.set_state(*state, scene.poses[k])
        conditions = [
            item
            for constraint in problem.constraint
            for item in constraint.solved(world)
        ]
        measured = np.concatenate([np.array(item.g, float) for item in conditions])
        assert [item.name for item in conditions for _ in item.g] == list(values.names)
        np.testing.assert_allclose(values.g[k, joints], measured[joints], atol=1e-8)
        np.testing.assert_array_equal(
            values.lower, np.concatenate([item.lower for item in conditions])
        )


def test_derivatives_of_constraint_values_are_those_of_finite_differences(
    model: RobotModel,
) -> None:
    q, dq, ddq = random_states(model, 4)
    scene, h = scene_between(model, 4), 1e-6
    values = model.constraint_values(q, dq, ddq, scene=scene)
    smooth = [
        index
        for index, name in enumerate(values.names)
        if name.startswith(("joint", "table", "vertical"))
    ]
    for name, states in (
        ("jacobian_q", (1, 0, 0)),
        ("jacobian_dq", (0, 1, 0)),
        ("jacobian_ddq", (0, 0, 1)),
    ):
        for joint in range(q.shape[1]):
            step = np.zeros_like(q)
            step[:, joint] = h
            ahead, behind = (
                model.constraint_values(
                    *(
                        x + sign * on * step
                        for x, on in zip((q, dq, ddq), states, strict=True)
                    ),
                    scene=scene,
                ).g
                for sign in (1, -1)
            )
            numeric = (ahead - behind) / (2 * h)
            np.testing.assert_allclose(
                getattr(values, name)[:, smooth, joint],
                numeric[:, smooth],
                rtol=1e-5,
                atol=1e-4,
            )


def test_the_drift_is_the_second_derivative_of_positions_at_constant_velocity(
    model: RobotModel,
) -> None:
    q, dq, ddq = random_states(model, 4)
    scene, h = scene_between(model, 4), 1e-4
    values = model.constraint_values(q, dq, ddq, scene=scene)
    still = [
        index
        for index, name in enumerate(values.names)
        if name.startswith(("joint pos", "table", "tilt", "upright"))
    ]
    before, now, after = (
        model.constraint_values(q + step * dq, dq, ddq, scene=scene).g
        for step in (-h, 0, h)
    )
    numeric = (before - 2 * now + after) / h**2
    assert np.abs(values.drift[:, still]).max() > 0.1
    np.testing.assert_allclose(
        values.drift[:, still], numeric[:, still], rtol=1e-4, atol=1e-4
    )
    fast = [
        index for index, name in enumerate(values.names) if name == "joint velocity"
    ]
    assert not values.drift[:, fast].any()


def test_the_base_configuration_is_free_and_limits_decide_validity(
    model: RobotModel,
) -> None:
    base = model.home[None]
    scene = model.scene(*(model.forward_kinematics(base)[0],) * 2)
    values = model.constraint_values(base, scene=scene)
    assert values.violation.shape == (1, len(values.names))
    assert model.is_collision_free(base, scene=scene).shape == (1,)
    fast = model.constraint_values(base, 2 * model.velocity_limit[None], scene=scene)
    limits = [
        index for index, name in enumerate(fast.names) if name == "joint velocity"
    ]
    assert limits
    assert (fast.violation[0, limits] > fast.tolerance[limits]).all()
    assert not fast.valid[0]


def test_distances_are_negative_inside_an_obstacle() -> None:
    model = RobotModel("heavy-object")
    tip = model.forward_kinematics(model.home)[0]
    touching, inside = (
        model.scene(tip, tip),
        model.scene(tip + np.array([0, 0, 0.3]), tip + np.array([0, 0, 0.3])),
    )
    distances = [
        model.min_distance(model.home, scene=scene)[0] for scene in (touching, inside)
    ]
    assert distances[1] < distances[0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda model: model.forward_kinematics(np.zeros(3)),
            r"q must have shape \(N, 7\) or \(7,\), got \(3,\)",
        ),
        (lambda model: model.jacobian(np.full(7, np.nan)), "q must be finite"),
        (
            lambda model: model.inverse_dynamics(np.zeros((2, 7)), np.zeros((3, 7))),
            "dq must have as many rows as q",
        ),
        (
            lambda model: model.constraint_values(
                np.zeros((2, 7)), scene=model.scene(np.zeros((3, 3)), np.zeros((3, 3)))
            ),
            "scene must have one sample or 2, got 3",
        ),
    ],
)
def test_wrong_arguments_are_refused_with_their_name(call, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        call(RobotModel("heavy-object"))
