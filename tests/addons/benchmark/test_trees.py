"""SST and MPC-MPNet: validity of states, steering and the network, compared with Pinocchio and SciPy."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import scipy  # imports scipy.stats on first access, which takes a second
from numpy.typing import NDArray
from train_proposals import likelihood_gradient, save_proposals, train_proposals

from cnpgen.addons.benchmark.benchmark_planner import Setting
from cnpgen.addons.benchmark.planners.cbirrt import Search
from cnpgen.addons.benchmark.planners.mpc_mpnet import (
    STEERING_STEP_S,
    MPCMPNet,
    ProposedExtension,
    Steering,
    spread_of,
)
from cnpgen.addons.benchmark.planners.sst import (
    CONTROL_STEP_S,
    SST,
    Radii,
    Tree,
    radii_of,
)
from cnpgen.addons.benchmark.planners.state_check import (
    MAX_TIP_HEIGHT_ERROR_M,
    MAX_UPRIGHT_ERROR,
    StateCheck,
)
from cnpgen.addons.benchmark.suite import load_suite
from cnpgen.addons.paper.proposals import (
    MIN_PROPOSAL_DEVIATION,
    Proposals,
    load_proposals,
    shipped_proposals,
)
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.errors import DatasetError, UsageError
from cnpgen.planner.network.architecture import (
    Architecture,
    forward,
    initial_parameters,
)
from cnpgen.plans import Plans, open_problem
from cnpgen.refine.refine_plans import solve_plans
from tests.conftest import some
from tests.refusals import is_refused

Array = NDArray[np.float64]

RADII = Radii(0.05, 0.02, 0.02)
PROBLEM_OF = {"hits-81": "airhockey", "heavy-100": "heavy-object"}


def one_of(suite: str, index: int = 0) -> Plans:
    return load_suite(suite).problems(index + 1)[0][index]


@pytest.mark.parametrize("suite", some(["hits-81", "heavy-100"], 1, "slow"))
def test_valid_states_are_those_of_pinocchio_and_cbirrt(suite: str) -> None:
    """Check states near a plan, where both outcomes occur, and random ones."""
    task = one_of(suite)
    problem, robot = open_problem(task.problem)
    check, search, random = (
        StateCheck(problem, robot),
        Search(problem, robot, task),
        np.random.default_rng(0),
    )
    plan = solve_plans(task, workers=1).plans.motion.at_times(
        np.linspace(0, 0.4, 200)[None]
    )
    q = plan.q[0] + random.normal(0, 0.01, plan.q[0].shape)
    q[150:] = (
        random.uniform(robot.position_lower, robot.position_upper, (50, robot.n)) * 1.1
    )
    dq, ddq = (
        random.normal(0, 0.6, (2, *q.shape))
        * np.stack([robot.velocity_limit, robot.acceleration_limit])[:, None]
    )
    dq[:75], ddq[:75] = plan.dq[0][:75], plan.ddq[0][:75]
    tips, valid = check(q, dq, ddq, task.scene.poses[0])
    data, expected = robot.model.createData(), []
    for state in zip(q, dq, ddq, strict=True):
        torque = pin.rnea(robot.model, data, *state)
        limits = (
            np.abs([state[1] / robot.velocity_limit, torque / robot.torque_limit]).max()
            <= 1
        )
        inside = np.all(
            (state[0] >= robot.position_lower) & (state[0] <= robot.position_upper)
        )
        on_manifold = abs(search.residual(state[0])[0]) <= (
            MAX_TIP_HEIGHT_ERROR_M if suite == "hits-81" else MAX_UPRIGHT_ERROR
        )
        expected.append(
            bool(limits and inside and on_manifold and search.is_valid(state[0]))
        )
    np.testing.assert_array_equal(valid, expected)
    assert 5 < valid.sum() < 180
    np.testing.assert_allclose(tips, task.problem.tip_positions(q), atol=1e-12)


def test_problems_without_table_and_object_are_refused() -> None:
    problem, robot = open_problem(one_of("heavy-100").problem)
    with is_refused(UsageError):
        StateCheck(replace(problem, object=None, obstacle=()), robot)


def check_constant_accelerations(
    trajectory: Trajectory, step: float, limit: np.ndarray
) -> None:
    """Check that accelerations are constant over every step and within their limits."""
    assert trajectory.dq is not None
    np.testing.assert_allclose(np.diff(trajectory.t), step)
    ddq = np.diff(trajectory.dq, axis=0) / step
    assert np.all(np.abs(ddq) <= limit * (1 + 1e-9))
    assert (
        np.abs(
            np.diff(trajectory.q, axis=0)
            - step * (trajectory.dq[1:] + trajectory.dq[:-1]) / 2
        ).max()
        < 1e-12
    )


def test_sst_stays_within_limits_and_approaches_the_goal() -> None:
    task = one_of("hits-81", 40)
    problem, robot = open_problem(task.problem)
    start_xyz, goal = task.columns["start_xyz"][0], task.columns["goal_xyz"][0]
    check = StateCheck(problem, robot)
    tree = Tree(
        np.concatenate([task.boundary.start_q[0], task.boundary.start_dq[0]]),
        start_xyz,
        RADII,
        CONTROL_STEP_S,
    )
    random = np.random.default_rng(0)
    extend = partial(SST().extend, tree, check, task.scene.poses[0], goal, random)
    trajectory = tree.grow(extend, goal, time_limit=60, max_iterations=3000)
    assert trajectory is not None
    check_constant_accelerations(trajectory, CONTROL_STEP_S, robot.acceleration_limit)
    tip = task.problem.tip_positions(trajectory.q)
    assert np.linalg.norm(tip[-1] - goal) < np.linalg.norm(tip[0] - goal) - 0.01
    assert np.abs(tip[:, 2] - 0.16).max() <= 0.01
    assert np.all(np.abs(trajectory.dq) <= robot.velocity_limit)
    np.testing.assert_array_equal(trajectory.q[0], task.boundary.start_q[0])


def test_fields_of_sst_change_the_length_of_controls_the_share_of_goals_and_the_witnesses() -> (
    None
):
    task = one_of("hits-81", 40)
    problem, robot = open_problem(task.problem)
    lengths, check = [], StateCheck(problem, robot)

    def recorded(q: Array, *others: Array) -> tuple[Array, NDArray[np.bool_]]:
        lengths.append(len(q))
        return check(q, *others)

    recorded.robot = robot
    start = np.concatenate([task.boundary.start_q[0], task.boundary.start_dq[0]])
    tree = Tree(start, task.columns["start_xyz"][0], RADII, CONTROL_STEP_S)
    always_goal = SST(max_steps=7, goal_bias=1.0)  # no random position is sampled
    goal, random = task.columns["goal_xyz"][0], np.random.default_rng(0)
    for _ in range(100):
        always_goal.extend(tree, recorded, task.scene.poses[0], goal, random)  # type: ignore[arg-type]
    assert set(lengths) == set(range(1, 8))
    assert radii_of(problem, 0.05) == Radii(0.05, 0.05, 0.02)


def test_fields_of_mpc_mpnet_are_the_counts_of_the_cross_entropy_method(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shapes = []
    integrate = Steering.integrate

    def recorded(
        self: Steering, state: Array, controls: Array
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        shapes.append((len(controls), self.settings.elites))
        return integrate(self, state, controls)

    monkeypatch.setattr(Steering, "integrate", recorded)
    planner = MPCMPNet(samples=10, elites=3, iterations=2)
    task = one_of("hits-81", 40)
    planner.prepare(Setting(task.problem, time_limit=0.2))(task)
    assert set(shapes) == {(10, 3)}
    steer = replace(steering_of(task), settings=MPCMPNet(samples=10, iterations=2))
    shapes.clear()
    steer(
        np.concatenate([task.boundary.start_q[0], task.boundary.start_dq[0]]),
        task.boundary.goal_q[0],
    )
    assert len(shapes) <= 2


def test_a_tree_keeps_the_cheapest_node_of_every_witness_and_selects_the_cheapest_nearby() -> (
    None
):
    tree = Tree(np.zeros(2), np.zeros(3), RADII, 0.1)
    slow, quick = np.zeros((5, 2)), np.ones((2, 2))
    assert tree.add(0, slow, np.array([1.0, 0, 0])) == 1
    assert (
        tree.add(0, quick, np.array([1.01, 0, 0])) == 2
    )  # cheaper, of the same witness
    assert (
        tree.add(0, slow, np.array([1.0, 0.01, 0])) == 2
    )  # more expensive: the other one is kept
    assert tree.select(np.array([1.0, 0, 0])) == 2
    assert tree.add(0, slow, np.array([1.04, 0, 0])) == 3
    assert tree.select(np.array([1.04, 0, 0])) == 2  # the nearest one took longer
    assert (
        tree.select(np.array([1.2, 0, 0])) == 3
    )  # none is within the radius: the nearest one
    np.testing.assert_array_equal(tree.path_to(2).q[:, 0], [0, 1, 1])


def steering_of(task: Plans, seed: int = 0) -> Steering:
    problem, robot = open_problem(task.problem)
    check = StateCheck(problem, robot)
    return Steering(
        MPCMPNet(),
        check,
        task.scene.poses[0],
        spread_of(problem),
        np.random.default_rng(seed),
    )


def test_controls_are_integrated_as_by_pinocchio_up_to_the_first_invalid_state() -> (
    None
):
    task = one_of("hits-81", 40)
    robot, steer = open_problem(task.problem)[1], steering_of(task)
    state = np.concatenate([task.boundary.start_q[0], 0.1 * robot.velocity_limit])
    controls = np.column_stack(
        [np.tile([1.0, -2, 0.5, 3, -1, 2], (3, 1)), [0.05, 0.1, 0.5]]
    )
    paths, tips, lengths = steer.integrate(state, controls)
    for path, tip, length, control in zip(paths, tips, lengths, controls, strict=True):
        q, dq = np.split(state, 2)
        assert length <= round(control[-1] / STEERING_STEP_S)
        for reached, position in zip(path[:length], tip, strict=False):
            dq, old = dq + STEERING_STEP_S * control[:-1], dq
            q = pin.integrate(robot.model, q, STEERING_STEP_S * (dq + old) / 2)
            np.testing.assert_allclose(reached, np.concatenate([q, dq]), atol=1e-12)
            assert abs(position[2] - 0.16) <= MAX_TIP_HEIGHT_ERROR_M
    assert lengths[0] == 5
    assert 5 < lengths[2] < 50  # cut where it leaves the table


def test_steering_approaches_a_reachable_configuration() -> None:
    task = one_of("hits-81", 40)
    steer = steering_of(task)
    plan = solve_plans(task, workers=1).plans.motion.at_times(np.array([[0.0, 0.1]]))
    result = steer(np.concatenate([plan.q[0, 0], plan.dq[0, 0]]), plan.q[0, 1])
    assert result is not None
    path, tip = result
    assert (
        np.linalg.norm(path[-1, : plan.q.shape[2]] - plan.q[0, 1])
        < 0.05
        < np.linalg.norm(plan.q[0, 1] - plan.q[0, 0])
    )
    np.testing.assert_allclose(
        tip, task.problem.tip_positions(path[-1:, : plan.q.shape[2]])[0], atol=1e-12
    )


def test_the_likelihood_equals_that_of_scipy_and_its_gradient_finite_differences() -> (
    None
):
    random = np.random.default_rng(0)
    architecture = Architecture(
        inputs=4, hidden=8, layers=2, path_outputs=3, rate_outputs=3
    )
    parameters = initial_parameters(
        architecture, seed=0, head_scale=1.0, rate_bias=-1.0
    ).astype(float)
    features, targets = random.normal(size=(5, 4)), random.normal(0, 0.3, (5, 3))
    gradient = np.empty_like(parameters)

    def value(at: np.ndarray) -> float:
        return likelihood_gradient(
            architecture.split(at),
            features,
            targets,
            out=architecture.split(np.empty_like(at)),
        )

    loss = likelihood_gradient(
        architecture.split(parameters),
        features,
        targets,
        out=architecture.split(gradient),
    )
    for direction in random.normal(size=(5, len(parameters))):
        difference = (
            value(parameters + 1e-6 * direction) - value(parameters - 1e-6 * direction)
        ) / 2e-6
        assert gradient @ direction == pytest.approx(difference, rel=1e-6)
    prediction = forward(architecture.split(parameters), features)
    log_likelihood = (
        scipy.stats.norm.logpdf(
            targets,
            prediction.path,
            MIN_PROPOSAL_DEVIATION + np.exp(prediction.log_rate),
        )
        + np.log(2 * np.pi) / 2
    )
    assert loss == pytest.approx(-log_likelihood.sum(axis=1).mean())


@pytest.mark.slow
def test_a_network_trained_on_plans_proposes_their_next_configurations(
    tmp_path: Path,
) -> None:
    plans = solve_plans(load_suite("hits-81").problems(9)[0], workers=1).plans
    network = train_proposals(plans, ahead=0.1, steps=300)
    repeated = [
        train_proposals(plans[:2], ahead=0.1, steps=9).parameters for _ in range(2)
    ]
    np.testing.assert_array_equal(*repeated)
    assert relative_error(network, plans) < 0.4
    save_proposals(tmp_path / "a.h5", network)
    reread = load_proposals(tmp_path / "a.h5")
    assert relative_error(reread, plans) == relative_error(network, plans)
    with is_refused(UsageError):
        train_proposals(plans[:0], ahead=0.1)


def relative_error(network: Proposals, plans: Plans) -> float:
    """Return the error of proposals relative to the change from the present."""
    random = np.random.default_rng(1)
    states = plans.motion.at_times(np.tile([0.1, 0.1 + network.ahead], (len(plans), 1)))
    current = np.concatenate([states.q[:, 0], states.dq[:, 0]], axis=1)
    errors, changes = [], states.q[:, 1] - states.q[:, 0]
    for index in range(len(plans)):
        task = plans[index]
        proposal = network.propose(
            current[index], task.boundary.goal_q[0], task.scene.poses[0], random
        )
        errors.append(proposal - states.q[index, 1])
    return float(np.linalg.norm(errors) / np.linalg.norm(changes))


@pytest.mark.parametrize("suite", some(["hits-81", "heavy-100"], 1, "slow"))
def test_shipped_networks_propose_the_next_configurations_of_new_plans(
    suite: str,
) -> None:
    network = load_proposals(shipped_proposals(PROBLEM_OF[suite]))
    assert (
        relative_error(
            network, solve_plans(load_suite(suite).problems(6)[0], workers=1).plans
        )
        < 0.25
    )
    assert "plans of" in network.training["made"]
    assert shipped_proposals(PROBLEM_OF[suite]).stat().st_size < 1e6


def test_a_missing_or_damaged_network_is_reported(tmp_path: Path) -> None:
    with is_refused(UsageError):
        shipped_proposals("panda-cup")
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(shipped_proposals("airhockey").read_bytes()[:-9])
    with is_refused(DatasetError):
        load_proposals(damaged)


@pytest.mark.parametrize("suite", some(["hits-81", "heavy-100"], 0, "slow"))
def test_mpc_mpnet_stays_within_limits_and_approaches_the_goal(suite: str) -> None:
    task = one_of(suite, 40)
    robot = open_problem(task.problem)[1]
    trajectory = MPCMPNet().prepare(Setting(task.problem, time_limit=1.5))(task)
    assert isinstance(trajectory, Trajectory)
    check_constant_accelerations(trajectory, STEERING_STEP_S, robot.acceleration_limit)
    tip, goal = task.problem.tip_positions(trajectory.q), task.columns["goal_xyz"][0]
    assert np.linalg.norm(tip[-1] - goal) < np.linalg.norm(tip[0] - goal) - 0.01
    assert np.all(np.abs(trajectory.dq) <= robot.velocity_limit)


def test_a_network_of_another_arm_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    other = "cnpgen.addons.benchmark.planners.mpc_mpnet.shipped_proposals"
    monkeypatch.setattr(other, lambda _: shipped_proposals("heavy-object"))
    with is_refused(UsageError):
        MPCMPNet().prepare(Setting(one_of("hits-81").problem))


def test_mpc_mpnet_continues_from_another_node_after_a_failure() -> None:
    task = one_of("hits-81", 40)
    steer = steering_of(task)
    start = np.concatenate([task.boundary.start_q[0], task.boundary.start_dq[0]])
    tree = Tree(start, task.columns["start_xyz"][0], RADII, STEERING_STEP_S)
    upwards = np.concatenate(
        [start[:6], [0, -1.0, 0, 0, 0, 0]]
    )  # the tip leaves the table at once
    stuck = tree.add(0, upwards[None], np.array([1.5, 0, 0.16]))
    extend = ProposedExtension(
        tree,
        load_proposals(shipped_proposals("airhockey")),
        steer,
        start[:6],
        node=stuck,
    )
    assert extend() == 0
    assert extend.node == 0
