"""Loss, boundary layer and robot in torch operations, against the compiled ones and finite differences."""

# ruff: noqa: E402 - without the framework nothing else is imported
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy

torch = pytest.importorskip("torch")

import cnpgen
from cnpgen.addons.frameworks.torch.tensor_loss import MAX_KEPT_TABLES
from cnpgen.addons.frameworks.torch.tensor_tape import _APPLY, TensorTape
from cnpgen.errors import UsageError
from cnpgen.interop.torch import (
    TensorBoundaryLayer,
    TensorLoss,
    TensorRobot,
    joint_states,
)
from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.kernels.tape import OPERATIONS
from cnpgen.losses.margins import Margins
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.plans.scene_plans import with_capacity
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.robot_model import RobotModel, inverse_dynamics_of
from cnpgen.trajectory.spline import clamped_knots
from tests.conftest import some
from tests.examples.losses import batch
from tests.examples.plans_of_networks import boundary_for_layer, outputs
from tests.examples.shaped_robot import write_problem

pytestmark = pytest.mark.slow

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
LABELS = ("hit", "transport")
PROBLEMS = {"hit": "airhockey", "transport": "heavy-object"}


def given(label: str, count: int = 6) -> dict[str, Any]:
    """Return perturbed plans with their obstacles and starts, as tensors."""
    plans = batch(label, count)
    tips = RobotModel(plans.problem, backend="numpy").forward_kinematics(
        plans.path[:, 0]
    )[0]
    arrays = {
        "path": plans.path,
        "rate": plans.rate,
        "obstacle_poses": plans.obstacle_poses,
        "start_tip": tips,
    }
    return {name: tensor(values) for name, values in arrays.items()}


def tensor(values: Any) -> Any:
    return torch.tensor(values, device=DEVICE)


def array(values: Any) -> np.ndarray:
    return np.asarray(values.detach().cpu())


def gradients(total: Any, variables: list[Any]) -> list[Any]:
    return list(torch.autograd.grad(total.sum(), variables, create_graph=True))


@pytest.mark.parametrize("form", ["signed", "paper"])
@pytest.mark.parametrize("label", LABELS)
def test_the_loss_and_its_gradient_equal_the_compiled_ones(
    label: str, form: str
) -> None:
    margins = Margins(factors={"joint-velocity": 0.9})
    loss = PlanLoss(
        PROBLEMS[label],
        dtype="float64",
        form=form,
        margins=margins,
        nodes=16,
        backend="numpy",
    )
    arguments, weights = given(label), tensor(loss.weights0).requires_grad_()
    path, rate = (
        arguments.pop("path").requires_grad_(),
        arguments.pop("rate").requires_grad_(),
    )
    total, terms = TensorLoss(loss)(path, rate, weights=weights, **arguments, shift=0.3)
    arrays, plain = (
        {name: array(values) for name, values in arguments.items()},
        (array(path), array(rate)),
    )
    expected = loss(*plain, weights=loss.weights0, **arrays, shift=0.3)
    np.testing.assert_allclose(array(total), expected.total, rtol=1e-9)
    np.testing.assert_allclose(array(terms), expected.terms, rtol=1e-9, atol=1e-12)
    by_path, by_rate, by_weights = gradients(total, [path, rate, weights])
    for got, wanted in (
        (by_path, expected.path_gradient),
        (by_rate, expected.rate_gradient),
    ):
        np.testing.assert_allclose(
            array(got), wanted, rtol=1e-7, atol=1e-9 * np.abs(wanted).max()
        )
    np.testing.assert_allclose(
        array(by_weights), expected.terms[:, 1:].sum(0), rtol=1e-9
    )


@pytest.mark.parametrize("label", some(LABELS, mark="extended"))
def test_second_derivatives_of_a_network_are_those_of_finite_differences(
    label: str,
) -> None:
    """Check products of the Hessian by network outputs through boundary layer and loss."""
    layer = BoundaryLayer(PROBLEMS[label], backend="numpy")
    loss = TensorLoss(
        PlanLoss(layer.problem, dtype="float64", nodes=8, backend="numpy")
    )
    tasks, of = layer.tasks(boundary_for_layer(layer, 3)), TensorBoundaryLayer(layer)
    x = tensor(np.concatenate(outputs(layer, 3), axis=1))
    direction = torch.randn(
        x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype
    ).to(DEVICE)

    def gradient(x: Any) -> Any:
        path, rate = of(
            tasks, *x.split([layer.path_outputs, layer.rate_outputs], dim=1)
        )
        total, _ = loss(
            path, rate, weights=loss.loss.weights0, obstacle_poses=tasks.scene.poses
        )
        return gradients(total, [x])[0]

    x.requires_grad_()
    (product,) = torch.autograd.grad((gradient(x) * direction).sum(), [x])
    ahead, behind = (
        gradient((x + h * direction).detach().requires_grad_()) for h in (1e-6, -1e-6)
    )
    numeric = (ahead - behind).detach() / 2e-6
    assert product.norm() > 1
    assert ((product - numeric).norm(dim=1) < 1e-4 * numeric.norm(dim=1)).all()


@pytest.mark.parametrize("acceleration", some(("free", "given"), mark="extended"))
@pytest.mark.parametrize("label", LABELS)
def test_control_points_are_those_of_the_compiled_layer(
    label: str, acceleration: str
) -> None:
    layer = BoundaryLayer(
        PROBLEMS[label],
        goal_acceleration=acceleration,
        projection_steps=2,
        backend="numpy",
    )
    tasks = layer.tasks(boundary_for_layer(layer, 4))
    phi, log_rate = outputs(layer, 4)
    path, rate = TensorBoundaryLayer(layer)(tasks, tensor(phi), tensor(log_rate))
    expected = layer(tasks, phi, log_rate)
    np.testing.assert_allclose(array(path), expected.path, atol=1e-10)
    np.testing.assert_allclose(array(rate), expected.rate, rtol=1e-12)
    half, _ = TensorBoundaryLayer(layer)(
        tasks, tensor(phi).half(), tensor(log_rate).half()
    )
    assert half.dtype == torch.float32


def test_plans_that_are_not_finite_do_not_affect_others() -> None:
    loss = TensorLoss(PlanLoss("airhockey", dtype="float64", nodes=8, backend="numpy"))
    arguments = given("hit", 4)
    path, rate = arguments.pop("path"), arguments.pop("rate")
    expected, _ = loss(path, rate, weights=loss.loss.weights0, **arguments)
    rate[1, 3], path[2, 4, 1], path[3] = -1.0, torch.nan, 1e200
    path, rate = path.requires_grad_(), rate.requires_grad_()
    total, _ = loss(path, rate, weights=loss.loss.weights0, **arguments)
    assert total[0] == expected[0]
    assert total[1:3].isnan().all()
    by_path, by_rate = gradients(total.nan_to_num(posinf=0.0), [path, rate])
    assert by_path[0].abs().sum() > 0
    assert not by_path[1:].any()
    assert not by_rate[1:].any()


def test_tables_of_many_shifts_do_not_accumulate() -> None:
    loss, arguments = (
        TensorLoss(PlanLoss("airhockey", nodes=4, backend="numpy")),
        given("hit", 1),
    )
    totals = [
        loss(**arguments, weights=loss.loss.weights0, shift=k / 40)[0].item()
        for k in (*range(40), 0)
    ]
    assert len(loss._tables) == MAX_KEPT_TABLES
    assert totals[0] == totals[-1]
    assert len(set(totals)) > 20


def test_problems_whose_samples_place_obstacles_are_refused(tmp_path: Path) -> None:
    problem = with_capacity(load_problem(write_problem(tmp_path)), {"box": 1})
    with pytest.raises(
        UsageError,
        match=r"loss must be of a problem whose obstacles samples do not place, got that of",
    ):
        TensorLoss(PlanLoss(problem, backend="numpy"))


@pytest.mark.extended
def test_the_loss_can_be_compiled() -> None:
    """Check ``torch.compile`` with the operations of the dynamics, which the C++ compiler takes a minute for."""
    problem = cnpgen.load_problem("airhockey")
    kernels = problem_kernels(problem, load_robot(problem), *choose_backend("numpy"))
    tape = TensorTape(kernels.tape(inverse_dynamics_of))
    states = torch.randn(
        (3, 6, 32), dtype=torch.float64, device=DEVICE, requires_grad=True
    )
    compiled = torch.compile(lambda states: tape(*states)[0], fullgraph=True)
    torch.testing.assert_close(compiled(states), tape(*states)[0])
    assert all(
        torch.autograd.grad(compiled(states).sum(), [states])[0].isfinite().flatten()
    )


@pytest.mark.parametrize("name", ["heavy-object", "heavy-object-drive"])
def test_motor_torques_equal_those_of_the_model(name: str) -> None:
    """Without drives, both are the torques of the rigid body."""
    model, robot = RobotModel(name, backend="numpy"), TensorRobot(name)
    q, dq, ddq = np.random.default_rng(5).uniform(-0.3, 0.3, (3, 50, 7))
    found = robot.motor_torque(*map(tensor, (q, dq, ddq)))
    low, high = model.motor_torque(q, dq, ddq)
    for got, wanted in zip(found, (low, high), strict=True):
        np.testing.assert_allclose(array(got), wanted, rtol=1e-9, atol=1e-9)
    assert (high > low).all() == (name == "heavy-object-drive")


@pytest.mark.parametrize("label", LABELS)
def test_the_robot_equals_the_compiled_one(label: str) -> None:
    model, robot = (
        RobotModel(PROBLEMS[label], backend="numpy"),
        TensorRobot(PROBLEMS[label]),
    )
    random = np.random.default_rng(3)
    q = random.uniform(
        model.position_lower, model.position_upper, (5, len(model.joint_names))
    )
    dq, ddq = random.standard_normal((2, *q.shape))
    scene = model.scene(
        model.forward_kinematics(q)[0], model.forward_kinematics(q[::-1])[0]
    )
    tensors, expected = (
        [tensor(x) for x in (q, dq, ddq)],
        model.constraint_values(q, dq, ddq, scene=scene),
    )
    for got, wanted in zip(
        robot.forward_kinematics(tensors[0]), model.forward_kinematics(q), strict=True
    ):
        np.testing.assert_allclose(array(got), wanted, atol=1e-12)
    np.testing.assert_allclose(
        array(robot.jacobian(tensors[0])), model.jacobian(q), atol=1e-12
    )
    np.testing.assert_allclose(
        array(robot.inverse_dynamics(*tensors)),
        model.inverse_dynamics(q, dq, ddq),
        rtol=1e-9,
    )
    poses = tensor(scene.poses)
    tensors[0].requires_grad_()
    values = robot.constraint_values(*tensors, obstacle_poses=poses)
    np.testing.assert_allclose(array(values), expected.g, rtol=1e-9, atol=1e-9)
    smooth = [
        index for index, name in enumerate(expected.names) if name.startswith("joint")
    ]
    (by_q,) = torch.autograd.grad(values[:, smooth].sum(), [tensors[0]])
    np.testing.assert_allclose(
        array(by_q), expected.jacobian_q[:, smooth].sum(1), rtol=1e-8, atol=1e-6
    )
    with pytest.raises(UsageError, match=r"obstacle_poses must have shape \(5, "):
        robot.constraint_values(*tensors)
    with pytest.raises(UsageError, match=r"q must have shape \(N, "):
        robot.forward_kinematics(tensors[0][0])


def test_states_of_motions_are_those_of_scipy_and_differentiable_in_the_phase() -> None:
    plans = batch("hit", 3)
    spec, s = cnpgen.load_problem("airhockey").trajectory, np.linspace(0, 1, 9)
    path, control_rate = tensor(plans.path), tensor(plans.rate)
    q, dq, ddq = joint_states(path, control_rate, tensor(s), spec)
    p, r = (
        scipy.interpolate.BSpline(
            clamped_knots(x.shape[1], spec.degree), np.moveaxis(x, 0, 1), spec.degree
        )
        for x in (plans.path, plans.rate)
    )
    rate, change = (r(s, order).T[..., None] for order in (0, 1))
    first, second = (np.moveaxis(p(s, order), 0, 1) for order in (1, 2))
    np.testing.assert_allclose(array(q), np.moveaxis(p(s), 0, 1), atol=1e-12)
    np.testing.assert_allclose(array(dq), first * rate, atol=1e-9)
    np.testing.assert_allclose(
        array(ddq), second * rate**2 + first * rate * change, atol=1e-7
    )
    phase = tensor(np.full((3, 1), 0.37)).requires_grad_()
    position, velocity, _ = joint_states(path, control_rate, phase, spec)
    (by_phase,) = torch.autograd.grad(position[..., 0].sum(), [phase])
    np.testing.assert_allclose(
        array(by_phase)[:, 0], array(velocity)[:, 0, 0] / r(0.37), rtol=1e-9
    )


def test_every_operation_of_tapes_has_one_on_tensors() -> None:
    assert set(_APPLY) == set(OPERATIONS) - {"CONST", "INPUT", "OUTPUT"}
