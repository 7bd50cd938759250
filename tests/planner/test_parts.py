"""Steps before and after the network: projection of the line, and time scaling to the limits."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import scipy

from cnpgen.kernels.library import problem_kernels
from cnpgen.planner.expressions import effective_steps
from cnpgen.planner.inference_pipeline import make_inference_pipeline
from cnpgen.planner.time_scaling import (
    MAX_TIME_SCALE,
    SCALING_INTERVALS,
    make_time_scaling,
)
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import make_plans
from cnpgen.problems.conditions import equality_residuals
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem_record import as_problem
from cnpgen.trajectory.boundary import Boundary, anchor_line, assemble
from cnpgen.trajectory.spline import chebyshev
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.world import World
from tests.conftest import columns_of
from tests.examples.constraints import TipSpeed
from tests.examples.jerk_limits import jerk_limited
from tests.examples.models import (
    boundary_of_columns,
    config_of,
    interpreted,
    loaded_problem_of,
    untrained_model,
)
from tests.examples.plans import KNOTS

LIMITS = ("joint velocity", "joint acceleration", "joint torque")


def worst_tilt(name: str, path: np.ndarray) -> float:
    """Return the largest angle of the tip's z axis to the world's along one path [rad], by Pinocchio and SciPy."""
    robot = loaded_problem_of(name).robot
    model, data = robot.model, robot.model.createData()
    spline, worst = scipy.interpolate.BSpline(KNOTS[15], path, 7), 0.0
    for s in np.linspace(0, 1, 101):
        pin.framesForwardKinematics(model, data, spline(s))
        up = data.oMf[model.getFrameId(robot.tip)].rotation[:, 2]
        worst = max(worst, float(np.hypot(up[0], up[1])))
    return worst


def projected_paths(
    tiny, dataset: str, name: str, steps: int, count: int = 12
) -> np.ndarray:
    """Return paths of the projected line alone."""
    given = interpreted(loaded_problem_of(name))
    boundary = boundary_of_columns(columns_of(tiny(dataset)), count)
    tasks = make_inference_pipeline(
        given, config_of(steps, 0), scale_time=False
    ).prepare(boundary)
    spec = given.problem.trajectory
    rate = np.repeat(1 / tasks.expected_time[:, None], 20, axis=1)
    interior = anchor_line(boundary, rate, spec)
    return assemble(
        boundary,
        interior if tasks.correction is None else interior + tasks.correction,
        rate,
        spec,
    )


def test_a_projected_line_keeps_the_object_upright(tiny):
    straight = projected_paths(tiny, "heavy-object", "heavy-object", 0)
    projected = projected_paths(tiny, "heavy-object", "heavy-object", 1)
    tilts = np.array(
        [
            [worst_tilt("heavy-object", path) for path in paths]
            for paths in (straight, projected)
        ]
    )
    assert np.median(tilts[0]) > 0.02
    assert np.median(tilts[1]) < 0.03 * np.median(tilts[0])


def heights(paths: np.ndarray) -> np.ndarray:
    """Return the largest distances of the tip from the table's height along paths of an arm on the table [m]."""
    robot = loaded_problem_of("airhockey").robot
    model, data, found = robot.model, robot.model.createData(), []
    for path in paths:
        z = []
        for q in scipy.interpolate.BSpline(KNOTS[15], path, 7)(
            np.linspace(0.1, 0.9, 41)
        ):
            pin.framesForwardKinematics(model, data, q)
            z.append(data.oMf[model.getFrameId(robot.tip)].translation[2])
        found.append(np.abs(np.array(z) - 0.16).max())
    return np.array(found)


@pytest.mark.slow
def test_a_second_projection_step_moves_the_line_closer_to_the_table(tiny):
    straight, once, twice = (
        heights(projected_paths(tiny, "airhockey-replan", "airhockey", k))
        for k in (0, 1, 2)
    )
    assert np.median(straight) > 5e-3
    assert np.median(once) < 0.1 * np.median(straight)
    assert twice.max() < 3e-4


def test_the_projection_of_the_line_moves_no_boundary_control_point(tiny):
    straight, projected = (
        projected_paths(tiny, "heavy-object", "heavy-object", steps) for steps in (0, 1)
    )
    np.testing.assert_array_equal(
        straight[:, [0, 1, 2, 13, 14]], projected[:, [0, 1, 2, 13, 14]]
    )
    assert np.abs(straight[:, 3:13] - projected[:, 3:13]).max() > 0.01


def test_a_problem_without_equalities_keeps_the_straight_line(tiny):
    given = loaded_problem_of("heavy-object")
    free = [
        each for each in given.problem.constraint if type(each).__name__ != "Vertical"
    ]
    problem = replace(given.problem, constraint=tuple(free))
    arguments = {"robot": given.robot, "problem": problem}
    kernels = replace(interpreted(given).kernels, identity="free", arguments=arguments)
    surrounding = replace(given, problem=problem, kernels=kernels)
    inference = make_inference_pipeline(surrounding, config_of(2, 1), scale_time=False)
    assert (
        inference.prepare(
            boundary_of_columns(columns_of(tiny("heavy-object")), 3)
        ).correction
        is None
    )


@pytest.fixture(scope="module")
def fast(tiny):
    """Plans along the projected line that exceed their limits, and their problem."""
    given = loaded_problem_of("heavy-object")
    boundary = boundary_of_columns(columns_of(tiny("heavy-object")), 12)
    ends = {
        f"{end}_xyz": columns_of(tiny("heavy-object"))[f"{end}_xyz"][:12]
        for end in ("start", "goal")
    }
    inference = make_inference_pipeline(
        interpreted(given), config_of(1, 0), scale_time=False
    )
    path = projected_paths(tiny, "heavy-object", "heavy-object", 1)
    tasks = inference.prepare(boundary)
    shape = 0.4 + np.sin(np.pi * np.linspace(0, 1, 20))  # slow at the ends
    motion = Motion(path, 0.9 * shape / tasks.expected_time[:, None])
    obstacle_poses = scene_of(
        as_problem(given.problem), ends["start_xyz"], ends["goal_xyz"]
    ).poses
    return given, boundary, ends, motion, obstacle_poses


def severities_of(fast, motion: Motion) -> dict[str, np.ndarray]:
    """Return the severities of the velocity, acceleration and torque limits of plans, by the verdict."""
    given, boundary, ends, _, _ = fast
    plans = make_plans(
        given.record,
        boundary,
        path_control_points=motion.path,
        rate_control_points=motion.rate,
        columns=ends,
    )
    verdicts = evaluate_plans(plans, workers=1).verdicts
    return {
        name: np.array([verdict.margins[name].severity for verdict in verdicts])
        for name in LIMITS
    }


def test_time_scaled_motions_meet_velocity_acceleration_and_torque_limits_and_slightly_faster_ones_do_not(
    fast,
):
    given, _, _, motion, obstacle_poses = fast
    factor = make_time_scaling(given.problem, given.robot, given.kernels).factor(
        motion, obstacle_poses
    )
    assert (factor > 1.05).sum() > 6
    time_scaled, faster = (
        severities_of(fast, motion.time_scaled(factor)),
        severities_of(fast, motion.time_scaled(np.maximum(factor * 0.98, 1))),
    )
    repaired = np.max([time_scaled[name] for name in LIMITS], axis=0)
    assert (repaired <= 1).all()
    needed = factor > 1.03
    assert (np.max([faster[name] for name in LIMITS], axis=0)[needed] > 1).all()


def test_the_violation_kernel_finds_the_motions_that_need_time_scaling(fast):
    """The largest violation at a phase is positive exactly if a limit is exceeded there."""
    given, _, _, motion, obstacle_poses = fast
    time_scaling = make_time_scaling(given.problem, given.robot, given.kernels)
    needed = time_scaling.factor(motion, obstacle_poses)
    for scale in (1.0, np.median(needed), 0.999 * needed.max(), 1.01 * needed.max()):
        slower = motion.time_scaled(np.full(12, scale))
        states = slower.at(chebyshev(SCALING_INTERVALS))
        lanes = [
            np.ascontiguousarray(part.reshape(-1, 7).T)
            for part in (states.q, states.dq, states.ddq)
        ]
        (values,) = time_scaling.residuals(
            *lanes, np.repeat(obstacle_poses.T, states.q.shape[1], axis=1)
        )
        violations = np.maximum(
            values - time_scaling.bounds.upper[:, None],
            time_scaling.bounds.lower[:, None] - values,
        ).max(axis=0)
        (violation,) = time_scaling.violation(
            time_scaling.column(slower, obstacle_poses)
        )
        np.testing.assert_allclose(violation[0], violations, atol=1e-9)
        np.testing.assert_array_equal(
            time_scaling.factor(slower, obstacle_poses) > 1,
            violations.reshape(12, -1).max(axis=1) > 0,
        )


def test_a_motion_of_nan_does_not_affect_other_motions(fast):
    given, _, _, motion, obstacle_poses = fast
    time_scaling = make_time_scaling(given.problem, given.robot, given.kernels)
    broken = replace(
        motion, rate=np.where(np.arange(12)[:, None] == 3, np.nan, motion.rate)
    )
    np.testing.assert_array_equal(
        np.delete(time_scaling.factor(broken, obstacle_poses), 3),
        np.delete(time_scaling.factor(motion, obstacle_poses), 3),
    )


def test_time_scaled_motions_meet_jerk_limits_and_slightly_faster_ones_do_not(
    fast, tmp_path
):
    _, _, _, motion, obstacle_poses = fast
    problem, robot = jerk_limited("heavy-object", 2.0)
    time_scaling = make_time_scaling(
        problem, robot, problem_kernels(problem, robot, "numpy", tmp_path)
    )
    assert (
        time_scaling.bounds.cubic.tolist()
        == [False] * (len(time_scaling.bounds.cubic) - 7) + [True] * 7
    )
    factor = time_scaling.factor(motion, obstacle_poses)
    needed = (factor > 1.01) & (factor < MAX_TIME_SCALE)

    def worst(factor: np.ndarray) -> np.ndarray:
        jerk = (
            motion.time_scaled(factor).at(chebyshev(SCALING_INTERVALS)).jerk
            / robot.jerk_limit
        )
        return np.abs(jerk).max(axis=(1, 2))

    alone = np.cbrt(worst(np.ones(12)))  # time scale of the jerk limits alone
    by_jerk = needed & np.isclose(factor, alone * (1 + 2e-4), rtol=1e-9)
    assert by_jerk.sum() > 2
    assert (worst(factor)[factor < MAX_TIME_SCALE] <= 1).all()
    assert (worst(factor * 0.99)[by_jerk] > 1).all()


def test_motions_within_their_limits_are_not_scaled(fast):
    given, _, _, motion, obstacle_poses = fast
    slow = motion.time_scaled(np.full(12, 10.0))
    np.testing.assert_array_equal(
        make_time_scaling(given.problem, given.robot, given.kernels).factor(
            slow, obstacle_poses
        ),
        1.0,
    )


@pytest.mark.slow
def test_a_torque_limit_exceeded_by_gravity_alone_does_not_scale_time(fast):
    from dataclasses import replace

    given, _, _, motion, obstacle_poses = fast
    limits = replace(given.problem.limits, torque_scale=0.05)
    problem = replace(given.problem, limits=limits)
    robot = replace(given.robot, torque_limit=given.robot.torque_limit * 0.05 / 0.8)
    arguments = {"robot": robot, "problem": problem}
    kernels = replace(interpreted(given).kernels, identity="weak", arguments=arguments)
    slow = motion.time_scaled(np.full(12, 10.0))
    weak = make_time_scaling(problem, robot, kernels)
    assert (weak.factor(slow, obstacle_poses) < MAX_TIME_SCALE).any()
    still = motion.time_scaled(np.full(12, 1e4))
    np.testing.assert_array_equal(weak.factor(still, obstacle_poses), 1.0)


@pytest.mark.slow
def test_only_models_of_motions_from_rest_to_rest_scale_time(tiny):
    from cnpgen.planner.planner import Planner

    boundary = boundary_of_columns(columns_of(tiny("heavy-object")), 12)
    model = untrained_model("heavy-object", boundary)
    given, free = Planner(model), Planner(model, scale_time=False)
    assert model.is_rest_to_rest
    time_scaled, raw = given.plan_batch(boundary), free.plan_batch(boundary)
    np.testing.assert_array_equal(
        time_scaled.path_control_points, raw.path_control_points
    )
    ratio = raw.rate_control_points / time_scaled.rate_control_points
    np.testing.assert_allclose(ratio, ratio[:, :1] * np.ones(20), rtol=1e-12)
    assert (ratio[:, 0] > 1).any()
    hits = boundary_of_columns(columns_of(tiny("airhockey-hit")), 12)
    assert not untrained_model("airhockey", hits).is_rest_to_rest


def test_a_tip_speed_limit_of_a_plug_in_scales_time_and_projects_no_line(tmp_path):
    given = loaded_problem_of("airhockey")
    slow = TipSpeed(highest=0.3)
    problem = replace(given.problem, constraint=(*given.problem.constraint, slow))
    kernels = problem_kernels(problem, given.robot, "numpy", tmp_path)
    assert effective_steps(kernels, 1) == 1
    assert (
        kernels.tape(equality_residuals).outputs
        == given.kernels.tape(equality_residuals).outputs
    )
    q = np.stack([given.robot.home, given.robot.home])
    q[1, 0] += 0.3
    rest = np.zeros((1, 6))
    boundary, rate = Boundary(q[:1], rest, rest, q[1:], rest), np.full((1, 20), 1.0)
    spec = problem.trajectory
    motion = Motion(
        assemble(boundary, anchor_line(boundary, rate, spec), rate, spec),
        rate,
        spec.degree,
    )
    factor = make_time_scaling(problem, given.robot, kernels).factor(
        motion, np.zeros((1, 4))
    )

    def fastest(run: Motion) -> float:
        world, states, found = World(given.robot), run.at(np.linspace(0, 1, 400)), []
        for state in zip(states.q[0], states.dq[0], states.ddq[0], strict=True):
            world.set_state(*state, np.empty(0))
            found.append(float(np.linalg.norm(world.tip_velocity)))
        return max(found)

    assert 0.3 < fastest(motion) < 3 * 0.3
    assert fastest(motion.time_scaled(factor)) == pytest.approx(0.3, rel=1e-3)
