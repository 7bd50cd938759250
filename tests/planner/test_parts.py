"""What surrounds the network: a line bent onto the manifold, and slowing down as far as limits need and no further."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.interpolate import BSpline

from cnpgen.kernels.library import problem_kernels
from cnpgen.planner.expressions import equality_residuals, useful_steps
from cnpgen.planner.kit import make_kit
from cnpgen.planner.slowing import INTERVALS, SLOWEST, make_slowing
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import make_plans
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.trajectory.boundary import Boundary, anchor_line, assemble
from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spline import chebyshev
from cnpgen.world.state import World
from tests.conftest import columns_of
from tests.examples.constraints import TipSpeed
from tests.examples.jerky import jerky
from tests.examples.models import boundary_of_columns, interpreted, meaning_of, surroundings_of, untrained_model
from tests.examples.plans import KNOTS

LIMITS = ("joint velocity", "joint acceleration", "joint torque")


def worst_tilt(name: str, path: np.ndarray) -> float:
    """Largest deviation of the tip's z axis from the world's along one path [rad], by Pinocchio and SciPy."""
    robot = surroundings_of(name).robot
    model, data = robot.model, robot.model.createData()
    spline, worst = BSpline(KNOTS[15], path, 7), 0.0
    for s in np.linspace(0, 1, 101):
        pin.framesForwardKinematics(model, data, spline(s))
        up = data.oMf[model.getFrameId(robot.tip)].rotation[:, 2]
        worst = max(worst, float(np.hypot(up[0], up[1])))
    return worst


def bent_paths(tiny, dataset: str, name: str, steps: int, count: int = 12) -> np.ndarray:
    """Paths of the bent line alone."""
    given = interpreted(surroundings_of(name))
    boundary = boundary_of_columns(columns_of(tiny(dataset)), count)
    tasks = make_kit(given, meaning_of(steps, 0), slow_down=False).prepare(boundary)
    spec = given.problem.trajectory
    rate = np.repeat(1 / tasks.expected_time[:, None], 20, axis=1)
    interior = anchor_line(boundary, rate, spec)
    return assemble(boundary, interior if tasks.correction is None else interior + tasks.correction, rate, spec)


def test_a_bent_line_keeps_the_object_upright_all_the_way(tiny):
    straight = bent_paths(tiny, "heavy-object", "heavy-object", 0)
    bent = bent_paths(tiny, "heavy-object", "heavy-object", 1)
    tilts = np.array([[worst_tilt("heavy-object", path) for path in paths] for paths in (straight, bent)])
    assert np.median(tilts[0]) > 0.02
    assert np.median(tilts[1]) < 0.03 * np.median(tilts[0])


def heights(paths: np.ndarray) -> np.ndarray:
    """How far the tip is off the table's height at most along paths of an arm on the table [m]."""
    robot = surroundings_of("airhockey").robot
    model, data, found = robot.model, robot.model.createData(), []
    for path in paths:
        z = []
        for q in BSpline(KNOTS[15], path, 7)(np.linspace(0.1, 0.9, 41)):
            pin.framesForwardKinematics(model, data, q)
            z.append(data.oMf[model.getFrameId(robot.tip)].translation[2])
        found.append(np.abs(np.array(z) - 0.16).max())
    return np.array(found)


@pytest.mark.slow
def test_a_second_step_bends_the_line_further_onto_the_table(tiny):
    straight, once, twice = (heights(bent_paths(tiny, "airhockey-replan", "airhockey", k)) for k in (0, 1, 2))
    assert np.median(straight) > 5e-3
    assert np.median(once) < 0.1 * np.median(straight)
    assert twice.max() < 3e-4


def test_the_bent_line_moves_no_boundary_control_point(tiny):
    straight, bent = (bent_paths(tiny, "heavy-object", "heavy-object", steps) for steps in (0, 1))
    np.testing.assert_array_equal(straight[:, [0, 1, 2, 13, 14]], bent[:, [0, 1, 2, 13, 14]])
    assert np.abs(straight[:, 3:13] - bent[:, 3:13]).max() > 0.01


def test_a_problem_without_equalities_keeps_the_straight_line(tiny):
    given = surroundings_of("heavy-object")
    free = [each for each in given.problem.constraint if type(each).__name__ != "Vertical"]
    problem = replace(given.problem, constraint=tuple(free))
    arguments = {"robot": given.robot, "problem": problem}
    kernels = replace(interpreted(given).kernels, identity="free", arguments=arguments)
    surrounding = replace(given, problem=problem, kernels=kernels)
    kit = make_kit(surrounding, meaning_of(2, 1), slow_down=False)
    assert kit.prepare(boundary_of_columns(columns_of(tiny("heavy-object")), 3)).correction is None


@pytest.fixture(scope="module")
def fast(tiny):
    """Plans that run the bent line too fast, and what slows them down."""
    given = surroundings_of("heavy-object")
    boundary = boundary_of_columns(columns_of(tiny("heavy-object")), 12)
    ends = {f"{end}_xyz": columns_of(tiny("heavy-object"))[f"{end}_xyz"][:12] for end in ("start", "goal")}
    kit = make_kit(interpreted(given), meaning_of(1, 0), slow_down=False)
    path = bent_paths(tiny, "heavy-object", "heavy-object", 1)
    tasks = kit.prepare(boundary)
    shape = 0.4 + np.sin(np.pi * np.linspace(0, 1, 20))  # slow at the ends
    motion = Motion(path, 0.9 * shape / tasks.expected_time[:, None])
    tops = obstacle_tops(given.problem, ends["start_xyz"], ends["goal_xyz"])
    return given, boundary, ends, motion, tops


def excesses(fast, motion: Motion) -> dict[str, np.ndarray]:
    """By how much plans exceed the limits that depend on speed, by the verdict, relative to what is allowed."""
    given, boundary, ends, _, _ = fast
    plans = make_plans(
        given.record, boundary, path_control_points=motion.path, rate_control_points=motion.rate, columns=ends
    )
    verdicts = evaluate_plans(plans, workers=1).verdicts
    return {name: np.array([verdict.margins[name].severity for verdict in verdicts]) for name in LIMITS}


def test_slowed_motions_meet_velocity_acceleration_and_torque_and_slightly_faster_ones_do_not(fast):
    given, _, _, motion, tops = fast
    factor = make_slowing(given.problem, given.robot, given.kernels).factor(motion, tops)
    assert (factor > 1.05).sum() > 6
    slowed, faster = excesses(fast, motion.slower(factor)), excesses(fast, motion.slower(np.maximum(factor * 0.98, 1)))
    repaired = np.max([slowed[name] for name in LIMITS], axis=0)
    assert (repaired <= 1).all()
    needed = factor > 1.03
    assert (np.max([faster[name] for name in LIMITS], axis=0)[needed] > 1).all()


def test_the_look_at_all_phases_finds_the_motions_that_need_to_be_slower_and_no_others(fast):
    """One number tells of every phase whether the limits are kept there, as the limits themselves do."""
    given, _, _, motion, tops = fast
    slowing = make_slowing(given.problem, given.robot, given.kernels)
    needed = slowing.factor(motion, tops)
    for pace in (1.0, np.median(needed), 0.999 * needed.max(), 1.01 * needed.max()):
        slower = motion.slower(np.full(12, pace))
        states = slower.at(chebyshev(INTERVALS))
        lanes = [np.ascontiguousarray(part.reshape(-1, 7).T) for part in (states.q, states.dq, states.ddq)]
        (values,) = slowing.residuals(*lanes, np.repeat(tops.T, states.q.shape[1], axis=1))
        out = np.maximum(values - slowing.bounds.upper[:, None], slowing.bounds.lower[:, None] - values).max(axis=0)
        (excess,) = slowing.excess(slowing.column(slower, tops))
        np.testing.assert_allclose(excess[0], out, atol=1e-9)
        np.testing.assert_array_equal(slowing.factor(slower, tops) > 1, out.reshape(12, -1).max(axis=1) > 0)


def test_a_motion_that_is_none_touches_no_other(fast):
    given, _, _, motion, tops = fast
    slowing = make_slowing(given.problem, given.robot, given.kernels)
    broken = replace(motion, rate=np.where(np.arange(12)[:, None] == 3, np.nan, motion.rate))
    np.testing.assert_array_equal(
        np.delete(slowing.factor(broken, tops), 3), np.delete(slowing.factor(motion, tops), 3)
    )


def test_slowed_motions_keep_limited_jerks_and_slightly_faster_ones_do_not(fast, tmp_path):
    _, _, _, motion, tops = fast
    problem, robot = jerky("heavy-object", 2.0)
    slowing = make_slowing(problem, robot, problem_kernels(problem, robot, "numpy", tmp_path))
    assert slowing.bounds.cubic.tolist() == [False] * (len(slowing.bounds.cubic) - 7) + [True] * 7
    factor = slowing.factor(motion, tops)
    needed = (factor > 1.01) & (factor < SLOWEST)

    def worst(factor: np.ndarray) -> np.ndarray:
        jerk = motion.slower(factor).at(chebyshev(INTERVALS)).jerk / robot.jerk_limit
        return np.abs(jerk).max(axis=(1, 2))

    alone = np.cbrt(worst(np.ones(12)))  # what jerks alone ask for
    by_jerk = needed & np.isclose(factor, alone * (1 + 2e-4), rtol=1e-9)
    assert by_jerk.sum() > 2
    assert (worst(factor)[factor < SLOWEST] <= 1).all()
    assert (worst(factor * 0.99)[by_jerk] > 1).all()


def test_motions_within_their_limits_are_left_as_they_are(fast):
    given, _, _, motion, tops = fast
    slow = motion.slower(np.full(12, 10.0))
    np.testing.assert_array_equal(make_slowing(given.problem, given.robot, given.kernels).factor(slow, tops), 1.0)


@pytest.mark.slow
def test_a_torque_that_gravity_alone_exceeds_slows_nothing_down(fast):
    from dataclasses import replace

    given, _, _, motion, tops = fast
    limits = replace(given.problem.limits, torque_scale=0.05)
    problem = replace(given.problem, limits=limits)
    robot = replace(given.robot, torque_limit=given.robot.torque_limit * 0.05 / 0.8)
    arguments = {"robot": robot, "problem": problem}
    kernels = replace(interpreted(given).kernels, identity="weak", arguments=arguments)
    slow = motion.slower(np.full(12, 10.0))
    weak = make_slowing(problem, robot, kernels)
    assert (weak.factor(slow, tops) < SLOWEST).any()
    still = motion.slower(np.full(12, 1e4))
    np.testing.assert_array_equal(weak.factor(still, tops), 1.0)


@pytest.mark.slow
def test_only_models_of_motions_from_rest_to_rest_slow_down(tiny):
    from cnpgen.planner.planner import Planner

    boundary = boundary_of_columns(columns_of(tiny("heavy-object")), 12)
    model = untrained_model("heavy-object", boundary)
    given, free = Planner(model), Planner(model, slow_down=False)
    assert model.rests
    slowed, raw = given.plan_batch(boundary), free.plan_batch(boundary)
    np.testing.assert_array_equal(slowed.path_control_points, raw.path_control_points)
    ratio = raw.rate_control_points / slowed.rate_control_points
    np.testing.assert_allclose(ratio, ratio[:, :1] * np.ones(20), rtol=1e-12)
    assert (ratio[:, 0] > 1).any()
    hits = boundary_of_columns(columns_of(tiny("airhockey-hit")), 12)
    assert not untrained_model("airhockey", hits).rests


def test_a_plug_ins_limit_of_the_tip_speed_slows_motions_down_and_bends_no_line(tmp_path):
    given = surroundings_of("airhockey")
    slow = TipSpeed(highest=0.3)
    problem = replace(given.problem, constraint=(*given.problem.constraint, slow))
    kernels = problem_kernels(problem, given.robot, "numpy", tmp_path)
    assert useful_steps(kernels, 1) == 1
    assert kernels.tape(equality_residuals).outputs == given.kernels.tape(equality_residuals).outputs
    q = np.stack([given.robot.base, given.robot.base])
    q[1, 0] += 0.3
    rest = np.zeros((1, 6))
    boundary, rate = Boundary(q[:1], rest, rest, q[1:], rest), np.full((1, 20), 1.0)
    spec = problem.trajectory
    motion = Motion(assemble(boundary, anchor_line(boundary, rate, spec), rate, spec), rate, spec.degree)
    factor = make_slowing(problem, given.robot, kernels).factor(motion, np.empty((1, 0)))

    def fastest(run: Motion) -> float:
        world, states, found = World(given.robot), run.at(np.linspace(0, 1, 400)), []
        for state in zip(states.q[0], states.dq[0], states.ddq[0], strict=True):
            world.set_state(*state, np.empty(0))
            found.append(float(np.linalg.norm(world.tip_velocity)))
        return max(found)

    assert 0.3 < fastest(motion) < 3 * 0.3
    assert fastest(motion.slower(factor)) == pytest.approx(0.3, rel=1e-3)
