"""SST and MPC-MPNet: what states they allow, how they steer, what the network has learned; by Pinocchio and SciPy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import scipy  # which imports its statistics when they are asked for: that takes a second

from cnpgen.benchmark.benchmark_planner import Setting
from cnpgen.benchmark.planners import steering
from cnpgen.benchmark.planners.cbirrt import Search
from cnpgen.benchmark.planners.mpc_mpnet import MPCMPNet, ProposedExtension
from cnpgen.benchmark.planners.proposals import (
    MIN_PROPOSAL_DEVIATION,
    Proposals,
    likelihood_gradient,
    load_proposals,
    save_proposals,
    shipped_proposals,
    train_proposals,
)
from cnpgen.benchmark.planners.sst import CONTROL_STEP_S, RandomExtension
from cnpgen.benchmark.planners.state_check import MAX_TIP_HEIGHT_ERROR_M, MAX_UPRIGHT_ERROR, StateCheck
from cnpgen.benchmark.planners.steering import Steering
from cnpgen.benchmark.planners.tree import HIT, Tree
from cnpgen.benchmark.suite import load_suite
from cnpgen.benchmark.trajectory import Trajectory
from cnpgen.errors import DatasetError, UsageError
from cnpgen.planner.network.architecture import Architecture, initial_parameters
from cnpgen.planner.network.forward import forward
from cnpgen.plans import Plans, open_problem
from cnpgen.refine.refine_plans import solve_plans
from tests.conftest import some

PROBLEM_OF = {"hits-81": "airhockey", "heavy-100": "heavy-object"}


def one_of(suite: str, index: int = 0) -> Plans:
    return load_suite(suite).problems(index + 1)[0][index]


def poses_of(check: StateCheck, task: Plans) -> np.ndarray:
    return check.obstacle_poses(task.columns["start_xyz"][0], task.columns["goal_xyz"][0])


@pytest.mark.parametrize("suite", some(["hits-81", "heavy-100"], 1, "slow"))
def test_states_are_allowed_as_pinocchio_and_the_search_in_joint_space_have_it(suite: str) -> None:
    """Near a plan, where either happens, and anywhere."""
    task = one_of(suite)
    problem, robot = open_problem(task.problem)
    check, search, random = StateCheck(problem, robot), Search(problem, robot, task), np.random.default_rng(0)
    plan = solve_plans(task, workers=1).plans.motion.at_times(np.linspace(0, 0.4, 200)[None])
    q = plan.q[0] + random.normal(0, 0.01, plan.q[0].shape)
    q[150:] = random.uniform(robot.position_lower, robot.position_upper, (50, robot.n)) * 1.1
    dq, ddq = random.normal(0, 0.6, (2, *q.shape)) * np.stack([robot.velocity_limit, robot.acceleration_limit])[:, None]
    dq[:75], ddq[:75] = plan.dq[0][:75], plan.ddq[0][:75]
    tips, allowed = check(q, dq, ddq, poses_of(check, task))
    data, expected = robot.model.createData(), []
    for state in zip(q, dq, ddq, strict=True):
        torque = pin.rnea(robot.model, data, *state)
        limits = np.abs([state[1] / robot.velocity_limit, torque / robot.torque_limit]).max() <= 1
        inside = np.all((state[0] >= robot.position_lower) & (state[0] <= robot.position_upper))
        on = abs(search.residual(state[0])[0]) <= (MAX_TIP_HEIGHT_ERROR_M if suite == "hits-81" else MAX_UPRIGHT_ERROR)
        expected.append(bool(limits and inside and on and search.is_valid(state[0])))
    np.testing.assert_array_equal(allowed, expected)
    assert 5 < allowed.sum() < 180
    np.testing.assert_allclose(tips, task.problem.tip_positions(q), atol=1e-12)


def test_problems_without_table_and_object_are_refused() -> None:
    problem, robot = open_problem(one_of("heavy-100").problem)
    with pytest.raises(UsageError, match="neither"):
        StateCheck(replace(problem, object=None, obstacle=()), robot)


def ways(found: Trajectory, step: float, limit: np.ndarray) -> None:
    """Accelerations are constant over every step and within their limits."""
    assert found.dq is not None
    np.testing.assert_allclose(np.diff(found.t), step)
    ddq = np.diff(found.dq, axis=0) / step
    assert np.all(np.abs(ddq) <= limit * (1 + 1e-9))
    assert np.abs(np.diff(found.q, axis=0) - step * (found.dq[1:] + found.dq[:-1]) / 2).max() < 1e-12


def test_a_tree_of_sst_keeps_its_limits_and_comes_nearer_to_the_goal() -> None:
    task = one_of("hits-81", 40)
    problem, robot = open_problem(task.problem)
    start_xyz, goal = task.columns["start_xyz"][0], task.columns["goal_xyz"][0]
    check = StateCheck(problem, robot)
    tree = Tree(np.concatenate([task.boundary.start_q[0], task.boundary.start_dq[0]]), start_xyz, HIT, CONTROL_STEP_S)
    extend = RandomExtension(tree, robot, check, poses_of(check, task), goal, np.random.default_rng(0))
    found = tree.grow(extend, goal, time_limit=60, max_iterations=3000)
    assert found is not None
    ways(found, CONTROL_STEP_S, robot.acceleration_limit)
    tip = task.problem.tip_positions(found.q)
    assert np.linalg.norm(tip[-1] - goal) < np.linalg.norm(tip[0] - goal) - 0.01
    assert np.abs(tip[:, 2] - 0.16).max() <= 0.01
    assert np.all(np.abs(found.dq) <= robot.velocity_limit)
    np.testing.assert_array_equal(found.q[0], task.boundary.start_q[0])


def test_a_tree_keeps_the_cheapest_node_of_every_witness_and_extends_the_cheapest_nearby() -> None:
    tree = Tree(np.zeros(2), np.zeros(3), HIT, 0.1)
    slow, quick = np.zeros((5, 2)), np.ones((2, 2))
    assert tree.add(0, slow, np.array([1.0, 0, 0])) == 1
    assert tree.add(0, quick, np.array([1.01, 0, 0])) == 2  # cheaper, of the same witness
    assert tree.add(0, slow, np.array([1.0, 0.01, 0])) == 2  # more expensive: the other one is kept
    assert tree.selected(np.array([1.0, 0, 0])) == 2
    assert tree.add(0, slow, np.array([1.04, 0, 0])) == 3
    assert tree.selected(np.array([1.04, 0, 0])) == 2  # the nearest one took longer
    assert tree.selected(np.array([1.2, 0, 0])) == 3  # none is near: the nearest one
    np.testing.assert_array_equal(tree.path_to(2).q[:, 0], [0, 1, 1])


def steering_of(task: Plans, seed: int = 0) -> Steering:
    problem, robot = open_problem(task.problem)
    check = StateCheck(problem, robot)
    spread = steering.HIT if problem.object_size is None else steering.TRANSPORT
    return Steering(check, poses_of(check, task), robot.acceleration_limit, spread, np.random.default_rng(seed))


def test_controls_are_followed_as_pinocchio_integrates_and_only_as_far_as_states_are_allowed() -> None:
    task = one_of("hits-81", 40)
    robot, steer = open_problem(task.problem)[1], steering_of(task)
    state = np.concatenate([task.boundary.start_q[0], 0.1 * robot.velocity_limit])
    controls = np.column_stack([np.tile([1.0, -2, 0.5, 3, -1, 2], (3, 1)), [0.05, 0.1, 0.5]])
    paths, tips, lengths = steer.followed(state, controls)
    for path, tip, length, control in zip(paths, tips, lengths, controls, strict=True):
        q, dq = np.split(state, 2)
        assert length <= round(control[-1] / steering.STEERING_STEP_S)
        for reached, place in zip(path[:length], tip, strict=False):
            dq, old = dq + steering.STEERING_STEP_S * control[:-1], dq
            q = pin.integrate(robot.model, q, steering.STEERING_STEP_S * (dq + old) / 2)
            np.testing.assert_allclose(reached, np.concatenate([q, dq]), atol=1e-12)
            assert abs(place[2] - 0.16) <= MAX_TIP_HEIGHT_ERROR_M
    assert lengths[0] == 5
    assert 5 < lengths[2] < 50  # cut off where it leaves the table


def test_steering_comes_near_a_configuration_that_can_be_reached() -> None:
    task = one_of("hits-81", 40)
    steer = steering_of(task)
    plan = solve_plans(task, workers=1).plans.motion.at_times(np.array([[0.0, 0.1]]))
    found = steer(np.concatenate([plan.q[0, 0], plan.dq[0, 0]]), plan.q[0, 1])
    assert found is not None
    path, tip = found
    assert (
        np.linalg.norm(path[-1, : plan.q.shape[2]] - plan.q[0, 1]) < 0.05 < np.linalg.norm(plan.q[0, 1] - plan.q[0, 0])
    )
    np.testing.assert_allclose(tip, task.problem.tip_positions(path[-1:, : plan.q.shape[2]])[0], atol=1e-12)


def test_the_gradient_of_the_likelihood_is_that_of_its_differences_and_the_likelihood_scipys() -> None:
    random = np.random.default_rng(0)
    architecture = Architecture(inputs=4, hidden=8, layers=2, path_outputs=3, rate_outputs=3)
    parameters = initial_parameters(architecture, seed=0, head_scale=1.0, rate_bias=-1.0).astype(float)
    features, targets = random.normal(size=(5, 4)), random.normal(0, 0.3, (5, 3))
    gradient = np.empty_like(parameters)

    def value(at: np.ndarray) -> float:
        return likelihood_gradient(architecture.split(at), features, targets, out=architecture.split(np.empty_like(at)))

    found = likelihood_gradient(architecture.split(parameters), features, targets, out=architecture.split(gradient))
    for direction in random.normal(size=(5, len(parameters))):
        difference = (value(parameters + 1e-6 * direction) - value(parameters - 1e-6 * direction)) / 2e-6
        assert gradient @ direction == pytest.approx(difference, rel=1e-6)
    given = forward(architecture.split(parameters), features)
    logs = (
        scipy.stats.norm.logpdf(targets, given.path, MIN_PROPOSAL_DEVIATION + np.exp(given.log_rate))
        + np.log(2 * np.pi) / 2
    )
    assert found == pytest.approx(-logs.sum(axis=1).mean())


@pytest.mark.slow
def test_a_network_that_was_trained_on_plans_proposes_what_is_next_on_them(tmp_path: Path) -> None:
    plans = solve_plans(load_suite("hits-81").problems(9)[0], workers=1).plans
    network = train_proposals(plans, ahead=0.1, steps=300)
    few = [train_proposals(plans[:2], ahead=0.1, steps=9).parameters for _ in range(2)]
    np.testing.assert_array_equal(*few)
    assert misses(network, plans) < 0.4
    save_proposals(tmp_path / "a.h5", network)
    read = load_proposals(tmp_path / "a.h5")
    assert misses(read, plans) == misses(network, plans)
    with pytest.raises(UsageError, match="no plans"):
        train_proposals(plans[:0], ahead=0.1)


def misses(network: Proposals, plans: Plans) -> float:
    """Return the error of proposals relative to the change from the present."""
    random = np.random.default_rng(1)
    states = plans.motion.at_times(np.tile([0.1, 0.1 + network.ahead], (len(plans), 1)))
    now = np.concatenate([states.q[:, 0], states.dq[:, 0]], axis=1)
    check = StateCheck(*open_problem(plans.problem))
    wrong, far = [], states.q[:, 1] - states.q[:, 0]
    for index in range(len(plans)):
        task = plans[index]
        proposal = network.propose(now[index], task.boundary.goal_q[0], poses_of(check, task), random)
        wrong.append(proposal - states.q[index, 1])
    return float(np.linalg.norm(wrong) / np.linalg.norm(far))


@pytest.mark.parametrize("suite", some(["hits-81", "heavy-100"], 1, "slow"))
def test_the_shipped_networks_propose_what_is_next_on_plans_that_they_have_not_seen(suite: str) -> None:
    network = load_proposals(shipped_proposals(PROBLEM_OF[suite]))
    assert misses(network, solve_plans(load_suite(suite).problems(6)[0], workers=1).plans) < 0.25
    assert "plans of" in network.training["made"]
    assert shipped_proposals(PROBLEM_OF[suite]).stat().st_size < 1e6


def test_a_network_that_is_missing_or_damaged_is_told_of(tmp_path: Path) -> None:
    with pytest.raises(
        UsageError, match="no network proposes configurations for 'panda-cup', only for airhockey, heavy"
    ):
        shipped_proposals("panda-cup")
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(shipped_proposals("airhockey").read_bytes()[:-9])
    with pytest.raises(DatasetError, match="damaged"):
        load_proposals(damaged)


@pytest.mark.parametrize("suite", some(["hits-81", "heavy-100"], 0, "slow"))
def test_mpc_mpnet_keeps_its_limits_and_gets_away_from_the_start(suite: str) -> None:
    task = one_of(suite, 40)
    robot = open_problem(task.problem)[1]
    found = MPCMPNet().prepare(Setting(task.problem, time_limit=1.5))(task)
    assert isinstance(found, Trajectory)
    ways(found, steering.STEERING_STEP_S, robot.acceleration_limit)
    tip, goal = task.problem.tip_positions(found.q), task.columns["goal_xyz"][0]
    assert np.linalg.norm(tip[-1] - goal) < np.linalg.norm(tip[0] - goal) - 0.01
    assert np.all(np.abs(found.dq) <= robot.velocity_limit)


def test_a_network_of_another_arm_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    other = "cnpgen.benchmark.planners.mpc_mpnet.shipped_proposals"
    monkeypatch.setattr(other, lambda _: shipped_proposals("heavy-object"))
    with pytest.raises(UsageError, match="'airhockey' is trained for another arm or scene"):
        MPCMPNet().prepare(Setting(one_of("hits-81").problem))


def test_mpc_mpnet_goes_on_elsewhere_after_a_step_that_led_nowhere() -> None:
    task = one_of("hits-81", 40)
    steer = steering_of(task)
    start = np.concatenate([task.boundary.start_q[0], task.boundary.start_dq[0]])
    tree = Tree(start, task.columns["start_xyz"][0], HIT, steering.STEERING_STEP_S)
    upwards = np.concatenate([start[:6], [0, -1.0, 0, 0, 0, 0]])  # the tip leaves the table at once
    stuck = tree.add(0, upwards[None], np.array([1.5, 0, 0.16]))
    extend = ProposedExtension(tree, load_proposals(shipped_proposals("airhockey")), steer, start[:6], node=stuck)
    assert extend() == 0
    assert extend.node == 0
