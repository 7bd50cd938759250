"""TrajOpt, AQP and CBiRRT, compared with finite differences, SciPy and Pinocchio."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
import scipy

from cnpgen.addons.benchmark.answers import judge_answer
from cnpgen.addons.benchmark.benchmark_planner import BenchmarkPlanner, Setting
from cnpgen.addons.benchmark.planners.aqp import (
    AQP,
    MAX_MALLET_XY_M,
    MIN_MALLET_XY_M,
    PlanePath,
    nearest_in_null_space,
    stopping_path,
    striking_path,
)
from cnpgen.addons.benchmark.planners.cbirrt import CBiRRT
from cnpgen.addons.benchmark.planners.obstacle_boxes import boxes_of
from cnpgen.addons.benchmark.planners.rrtconnect import RRTConnect, timed_by_toppra
from cnpgen.addons.benchmark.planners.ruckig import Ruckig, time_optimal_motion
from cnpgen.addons.benchmark.planners.trajopt import (
    TrajOpt,
    TrajOptTranscription,
    knot_constraints,
)
from cnpgen.addons.benchmark.process import PlannerProcess
from cnpgen.addons.benchmark.results_file import answer_from_dict
from cnpgen.addons.benchmark.simulator.tip import Tip
from cnpgen.addons.benchmark.suite import load_suite
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.errors import UsageError
from cnpgen.plans import Plans, open_problem, record_problem
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.joint import (
    JointAcceleration,
    JointPosition,
    JointTorque,
    JointVelocity,
)
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.trajectory.boundary import Boundary
from tests.conftest import some
from tests.refusals import is_refused


def one_of(suite: str, index: int = 0) -> Plans:
    return load_suite(suite).problems(index + 1)[0][index]


def transcription(task: Plans) -> TrajOptTranscription:
    problem, robot = open_problem(task.problem)
    at_knots = knot_constraints(problem, robot, task.scene)
    return TrajOptTranscription(robot, task.boundary, at_knots)


@pytest.mark.parametrize("suite", some(["hits-81", "heavy-100"], 1, "slow"))
def test_derivatives_of_trajopt_equal_finite_differences(suite: str) -> None:
    program = transcription(one_of(suite))
    x = program.start() + 0.1 * np.random.default_rng(0).normal(
        size=len(program.start())
    )
    x[-1] = 0.7
    direction = np.random.default_rng(1).normal(size=(4, len(x)))
    for function, jacobian in (
        (program.defects, program.defects_jacobian),
        (program.margins, program.margins_jacobian),
    ):
        J = jacobian(x)
        for d in direction:
            difference = (function(x + 1e-6 * d) - function(x - 1e-6 * d)) / 2e-6
            np.testing.assert_allclose(J @ d, difference, atol=2e-5)


def test_trajopt_satisfies_its_constraints_and_boundary_conditions() -> None:
    task = one_of("hits-81", 40)
    trajectory = TrajOpt().prepare(Setting(task.problem))(task)
    assert isinstance(trajectory, Trajectory)
    program = transcription(task)
    x = np.concatenate(
        [
            trajectory.q[1:-1].ravel(),
            trajectory.dq[1:-1].ravel(),
            trajectory.ddq.ravel(),
            [trajectory.duration],
        ]
    )
    assert np.abs(program.defects(x)).max() < 1e-5
    assert program.margins(x).min() > -1e-5
    low, high = program.bounds()
    assert np.all((x > low - 1e-9) & (x < high + 1e-9))
    np.testing.assert_allclose(
        trajectory.q[[0, -1]],
        [task.boundary.start_q[0], task.boundary.goal_q[0]],
        atol=1e-12,
    )
    np.testing.assert_allclose(trajectory.dq[-1], task.boundary.goal_dq[0], atol=1e-12)
    verdict = judge_answer(task, trajectory)
    assert verdict.paper.finished
    assert verdict.metrics.duration < 0.6


@pytest.mark.parametrize("seed", range(5))
def test_the_quadratic_program_of_aqp_has_the_optimum_of_slsqp(seed: int) -> None:
    random = np.random.default_rng(seed)
    null = np.linalg.svd(random.normal(size=(3, 6)))[2][3:].T
    weights, ahead, min_norm = (
        random.uniform(1, 10, 6),
        random.normal(size=6),
        0.3 * random.normal(size=6),
    )
    low, high = -0.8 - min_norm, 0.8 - min_norm
    solution = nearest_in_null_space(null, weights, ahead, (low, high))
    H, f = null.T @ (weights[:, None] * null), null.T @ (weights * ahead)
    expected = scipy.optimize.minimize(
        lambda a: a @ H @ a / 2 + f @ a,
        np.zeros(3),
        jac=lambda a: H @ a + f,
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": lambda a: high - null @ a, "jac": lambda _: -null},
            {"type": "ineq", "fun": lambda a: null @ a - low, "jac": lambda _: null},
        ],
        options={"ftol": 1e-14},
    )
    assert (
        scipy.optimize.LinearConstraint(null, low, high).residual(expected.x)[0].min()
        > -1e-9
    )
    np.testing.assert_allclose(solution, expected.x, atol=1e-5)


def test_an_infeasible_quadratic_program_returns_none() -> None:
    null = np.linalg.svd(np.random.default_rng(0).normal(size=(3, 6)))[2][3:].T
    assert (
        nearest_in_null_space(
            null, np.ones(6), np.zeros(6), (np.full(6, 2.0), np.full(6, 3.0))
        )
        is None
    )


def length_of(path: PlanePath) -> float:
    def speed(s: float) -> float:
        return float(np.linalg.norm(path.at(s + 1e-6) - path.at(s - 1e-6))) / 2e-6

    return float(scipy.integrate.quad(speed, 1e-6, path.length - 1e-6, limit=200)[0])


@pytest.mark.parametrize("hit", [(1.1, 0.3), (0.9, -0.35), (1.0, 0.0)])
def test_paths_in_the_plane_have_smooth_headings_correct_lengths_and_ends(
    hit: tuple[float, float],
) -> None:
    start, end = np.array([0.65, 0.0]), np.array(hit)
    direction = np.array([2.478, 0.0]) - end
    hit = striking_path(start, end, direction, 1.5, 8.0)
    np.testing.assert_allclose(hit.at(0.0), start, atol=1e-12)
    np.testing.assert_allclose(hit.at(hit.length), end, atol=1e-12)
    assert length_of(hit) == pytest.approx(hit.length, abs=1e-4)
    last = hit.at(hit.length) - hit.at(hit.length - 1e-5)
    np.testing.assert_allclose(
        last / np.linalg.norm(last), direction / np.linalg.norm(direction), atol=1e-3
    )
    steps = np.diff([hit.at(s) for s in np.linspace(0, hit.length, 2000)], axis=0)
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    assert np.abs(np.diff(heading)).max() < 0.1  # no corner
    points = np.array(list(hit.sampled(0.01)))
    assert np.all((points > MIN_MALLET_XY_M - 1e-9) & (points < MAX_MALLET_XY_M + 1e-9))
    stop = stopping_path(hit)
    np.testing.assert_allclose(stop.at(0.0), end, atol=1e-12)
    first = stop.at(1e-5) - stop.at(0.0)
    np.testing.assert_allclose(
        first / np.linalg.norm(first), direction / np.linalg.norm(direction), atol=1e-3
    )


@pytest.mark.parametrize("hit", [(0.9, 0.05), (0.8, -0.1)])
def test_paths_to_a_hit_behind_the_start_are_straight_and_stop_within_the_table(
    hit: tuple[float, float],
) -> None:
    start, end = np.array([1.0, 0.0]), np.array(hit)
    forwards = striking_path(start, end, np.array([1.5, 0.0]), 1.5, 8.0)
    assert forwards.length == pytest.approx(np.linalg.norm(end - start))
    points = np.array([*forwards.sampled(0.01), *stopping_path(forwards).sampled(0.01)])
    assert np.isfinite(points).all()
    assert np.all((points > MIN_MALLET_XY_M - 1e-9) & (points < MAX_MALLET_XY_M + 1e-9))


def test_aqp_hits_the_goal_in_the_required_direction() -> None:
    task = one_of("hits-81", 40)
    trajectory = AQP().prepare(Setting(task.problem))(task)
    assert isinstance(trajectory, Trajectory)
    tip = task.problem.tip_positions(trajectory.q)
    assert np.linalg.norm(tip[-1] - task.columns["goal_xyz"][0]) < 1e-3
    assert np.abs(tip[:, 2] - 0.16).max() < 1e-3
    direction = np.array([2.478, 0.0]) - task.columns["goal_xyz"][0][:2]
    last = tip[-1, :2] - tip[-2, :2]
    assert (
        abs(np.arctan2(last[1], last[0]) - np.arctan2(direction[1], direction[0]))
        < 0.01
    )
    robot = open_problem(task.problem)[1]
    assert np.all(
        np.abs(np.diff(trajectory.q, axis=0))
        <= robot.velocity_limit * trajectory.t[1] * (1 + 1e-6)
    )


def test_the_fields_of_aqp_limit_the_acceleration_of_the_mallet_and_slow_the_anchor() -> (
    None
):
    task = one_of("hits-81", 40)
    slow, default, anchored = (
        planner.prepare(Setting(task.problem))(task)
        for planner in (AQP(acceleration=2.0), AQP(), AQP(anchor_time=5.0))
    )
    for trajectory, limit in ((slow, 2.0), (default, 8.0)):
        steps = np.diff(task.problem.tip_positions(trajectory.q)[:, :2], axis=0)
        length = np.linalg.norm(steps, axis=1).sum()
        assert (
            2 * length / trajectory.duration**2 <= 1.02 * limit
        )  # of a constant acceleration from rest
    assert slow.duration > 1.2 * default.duration
    goal = task.boundary.goal_q[0]
    assert np.linalg.norm(anchored.q[-1] - goal) > np.linalg.norm(default.q[-1] - goal)


def test_aqp_refuses_transports() -> None:
    with is_refused(UsageError):
        AQP().prepare(Setting(one_of("heavy-100").problem))


@pytest.mark.parametrize("suite", some(["hits-81", "heavy-100"], 0, "slow"))
def test_paths_of_cbirrt_stay_on_the_manifold_and_within_the_velocity_limits(
    suite: str,
) -> None:
    """Use a separate process, because OMPL reports leaks when its process ends."""
    pytest.importorskip("ompl")
    task = one_of(suite)
    _, robot = open_problem(task.problem)
    process = PlannerProcess("cbirrt", Setting(task.problem, time_limit=20))
    try:
        trajectory = answer_from_dict(task, process.plan(task).answer)
    finally:
        process.stop()
    assert isinstance(trajectory, Trajectory)
    data, frame = robot.model.createData(), robot.model.getFrameId(robot.tip)
    for q in trajectory.q:
        pin.framesForwardKinematics(robot.model, data, q)
        tip = data.oMf[frame]
        residual = (
            tip.translation[2] - 0.16 if suite == "hits-81" else tip.rotation[2, 2] - 1
        )
        assert abs(residual) < 0.011
    np.testing.assert_allclose(
        trajectory.q[[0, -1]],
        [task.boundary.start_q[0], task.boundary.goal_q[0]],
        atol=0.01,
    )
    use = (
        np.abs(np.diff(trajectory.q, axis=0))
        / np.diff(trajectory.t)[:, None]
        / robot.velocity_limit
    )
    assert use.max() <= 1
    assert np.median(use.max(axis=1)) > 0.98


def test_planners_use_the_tip_frame_if_a_joint_has_the_same_name() -> None:
    task = one_of("hits-81")
    urdf = task.problem.urdf.replace(
        'joint name="world_F_base_joint"', 'joint name="striker_tip"'
    )
    robot = open_problem(replace(task.problem, urdf=urdf))[1]
    tip = Tip(robot).at(task.boundary.start_q[0])[0]
    np.testing.assert_allclose(
        tip, task.problem.tip_positions(task.boundary.start_q)[0], atol=1e-12
    )


def test_baselines_refuse_obstacles_that_are_not_upright_boxes() -> None:
    problem, _ = open_problem(one_of("heavy-100").problem)
    ball = Obstacle(name="ball", kind="sphere", position=(0.4, 0.1, 0.5), radius=0.1)
    with is_refused(UsageError):
        boxes_of(
            replace(problem, obstacle=(*problem.obstacle, ball)),
            one_of("heavy-100").scene,
        )


@pytest.mark.parametrize("planner", [TrajOpt(), CBiRRT()])
def test_baselines_do_not_apply_to_problems_without_table_and_object(
    planner: BenchmarkPlanner,
) -> None:
    if isinstance(planner, CBiRRT):
        pytest.importorskip("ompl")
    heavy = load_problem("heavy-object")
    free = replace(
        heavy,
        object=None,
        obstacle=(),
        constraint=tuple(c for c in heavy.constraint if is_of_joints(c)),
    )
    with is_refused(UsageError):
        planner.prepare(Setting(record_problem(free)))


def is_of_joints(constraint: Constraint) -> bool:
    return isinstance(
        constraint, JointPosition | JointVelocity | JointAcceleration | JointTorque
    )


def at_rest(joints: int, distance: np.ndarray) -> Boundary:
    still = np.zeros((1, joints))
    return Boundary(still, still, still, distance[None], still)


def test_ruckig_returns_its_own_motion_within_the_limits_and_in_the_known_time() -> (
    None
):
    ruckig = pytest.importorskip("ruckig")
    robot = open_problem(one_of("hits-81").problem)[1]
    limited = SimpleNamespace(
        n=robot.n,
        velocity_limit=np.full(robot.n, 1.0),
        acceleration_limit=np.full(robot.n, 5.0),
        jerk_limit=np.full(robot.n, 50.0),
    )
    distance = np.array([1.5, 0.2, -0.4, 0.0, 0.1, -0.3])
    motion = time_optimal_motion(ruckig, limited, at_rest(robot.n, distance))
    assert isinstance(motion, Trajectory)
    assert motion.duration == pytest.approx(
        1.5 / 1.0 + 1.0 / 5.0 + 5.0 / 50.0
    )  # d / v + v / a + a / j
    t = np.linspace(0, motion.duration, 3001)
    q, dq, ddq = motion.states(t)
    np.testing.assert_allclose(q[[0, -1]], [np.zeros(6), distance], atol=1e-9)
    assert np.abs(dq).max() == pytest.approx(1.0)
    assert np.abs(ddq).max() == pytest.approx(5.0)
    assert np.abs(np.diff(ddq, axis=0)).max() / t[1] < 50.0 * (1 + 1e-6)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], dq[1:-1], atol=1e-4)


def test_ruckig_meets_the_boundary_conditions_of_a_hit_and_refuses_an_impossible_one() -> (
    None
):
    ruckig = pytest.importorskip("ruckig")
    task = one_of("hits-81", 3)
    robot = open_problem(task.problem)[1]
    motion = Ruckig().prepare(Setting(task.problem))(task)
    assert isinstance(motion, Trajectory)
    q, dq, ddq = motion.states(np.array([0.0, motion.duration]))
    boundary = task.boundary
    np.testing.assert_allclose(q, [boundary.start_q[0], boundary.goal_q[0]], atol=1e-9)
    np.testing.assert_allclose(
        dq, [boundary.start_dq[0], boundary.goal_dq[0]], atol=1e-9
    )
    np.testing.assert_allclose(ddq, 0.0, atol=1e-6)
    verdict = judge_answer(task, motion)
    assert not verdict.valid  # it leaves the plane of the table
    assert verdict.metrics.z_error > 1e-4
    too_fast = replace(boundary, goal_dq=boundary.goal_dq + 2 * robot.velocity_limit)
    assert time_optimal_motion(ruckig, robot, too_fast) is None


def test_toppra_times_a_line_in_the_known_time_and_reaches_the_speed_of_the_goal() -> (
    None
):
    pytest.importorskip("toppra")
    limited = SimpleNamespace(
        velocity_limit=np.array([1.0, 2.0]), acceleration_limit=np.array([4.0, 8.0])
    )
    line = np.linspace([0.0, 0.0], [1.5, 0.5], 20)
    motion = timed_by_toppra(line, limited, np.zeros(2))
    assert isinstance(motion, Trajectory)
    assert motion.duration == pytest.approx(
        1.5 / 1.0 + 1.0 / 4.0, rel=1e-3
    )  # d / v + v / a of the first joint
    moving = timed_by_toppra(line, limited, np.array([0.6, 0.2]))
    assert isinstance(moving, Trajectory)
    np.testing.assert_allclose(
        moving.states(np.array([moving.duration]))[1][0], [0.6, 0.2], rtol=1e-3
    )
    too_fast = timed_by_toppra(line, limited, np.array([1.2, 0.4]))
    assert isinstance(too_fast, Trajectory)
    np.testing.assert_allclose(
        too_fast.states(np.array([too_fast.duration]))[1][0], [0.9, 0.3], rtol=1e-3
    )
    assert timed_by_toppra(line[[0, 0]], limited, np.zeros(2)) is None


@pytest.mark.parametrize("planner", some([CBiRRT(), RRTConnect()], 1, "slow"))
def test_a_sampling_based_search_depends_on_its_own_problem_only(
    planner: BenchmarkPlanner,
) -> None:
    pytest.importorskip("ompl")
    if isinstance(planner, RRTConnect):
        pytest.importorskip("toppra")
    problems = load_suite("heavy-100").problems(4)[0]
    plan = planner.prepare(Setting(problems.problem, time_limit=20.0))
    after_others = [plan(problem) for problem in problems]
    alone = planner.prepare(Setting(problems.problem, time_limit=20.0))
    other_seed = planner.prepare(Setting(problems.problem, time_limit=20.0, seed=1))
    assert all(isinstance(answer, Trajectory) for answer in after_others)
    np.testing.assert_array_equal(alone(problems[3]).q, after_others[3].q)
    np.testing.assert_array_equal(alone(problems[1]).q, after_others[1].q)
    changed = [other_seed(problem) for problem in problems]
    shorter = replace(planner, step_size=0.2).prepare(
        Setting(problems.problem, time_limit=20.0)
    )
    assert any(
        not np.array_equal(shorter(a).q, b.q)
        for a, b in zip(problems, after_others, strict=True)
    )
    assert any(
        a.q.shape != b.q.shape or (a.q != b.q).any()
        for a, b in zip(changed, after_others, strict=True)
    )
