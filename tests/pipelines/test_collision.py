"""Collisions: the exact segment test against Coal, Coal against the verifier's distances, and the stages."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import RecipeError
from cnpgen.pipelines.prepared import PreparedPipeline, random_generator
from cnpgen.pipelines.stages.collision import Collision, coal_judge, skeleton_distance
from cnpgen.pipelines.stages.stage import Round
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.world.state import World
from tests.conftest import Prepare, needs_compiler, run_stages

Array = np.ndarray
BACKENDS = [pytest.param("compiled", marks=needs_compiler), "numpy", "casadi"]
RADIUS = 0.14


@pytest.fixture(scope="module")
def heavy(prepare: Prepare) -> PreparedPipeline:
    return prepare("heavy-object")


@pytest.fixture(scope="module")
def anywhere(heavy: PreparedPipeline) -> tuple[Array, Array]:
    """Random configurations, most of them far from upright, and pedestals of any height."""
    robot, random = heavy.context.robot, np.random.default_rng(91)
    q = random.uniform(robot.position_lower, robot.position_upper, (2000, robot.n)).T.copy()
    return q, random.uniform(0.05, 0.9, (2, 2000))


@pytest.fixture(scope="module")
def measured(heavy: PreparedPipeline, anywhere: tuple[Array, Array]) -> tuple[Array, Array]:
    """The verifier's smallest distance of the arm's segments and of the object, by Coal."""
    world = World(heavy.context.robot, heavy.context.problem.obstacle, heavy.context.problem.object_size)
    zero, arm, held = np.zeros(7), [], []
    for q, tops in zip(*(values.T for values in anywhere), strict=True):
        world.set_state(q, zero, zero, tops)
        arm.append(min(world.segment_distances()))
        held.append(min(world.object_distances()))
    return np.array(arm), np.array(held)


@pytest.mark.parametrize("backend", BACKENDS)
def test_segment_distances_agree_with_coal_s(heavy, anywhere, measured, kernels_of, backend):
    q, tops = (np.ascontiguousarray(values[:, : 300 if backend == "casadi" else 2000]) for values in anywhere)
    (found,) = kernels_of(heavy, backend).load(skeleton_distance)(q, tops)
    np.testing.assert_allclose(found[0], np.maximum(measured[0][: q.shape[1]], 0), rtol=0, atol=1e-9)


def test_the_segment_stage_and_the_coal_stage_reject_the_same_arms(heavy, anywhere, fastest, kernels_of):
    """Without the object, which the segment test does not know."""
    q, tops = anywhere
    problem = replace(heavy.context.problem, object=None)
    hit = coal_judge(problem, heavy.context.robot, RADIUS, 0.0)(q, tops)
    (distance,) = kernels_of(heavy, fastest).load(skeleton_distance)(q, tops)
    clear = np.abs(distance[0] - RADIUS) > 1e-7
    assert clear.mean() > 0.999
    np.testing.assert_array_equal(hit[clear], (distance[0] <= RADIUS)[clear])
    assert 0.1 < hit.mean() < 0.9


def test_coal_s_verdict_on_arm_and_object_agrees_with_the_verifier_s_distances(heavy, anywhere, measured):
    """Where neither is within 2 mm of its limit: a smaller object and a depth are not quite the same thing there."""
    depth = heavy.context.constraint(ObjectContact).depth
    hit = coal_judge(heavy.context.problem, heavy.context.robot, RADIUS, depth)(*anywhere)
    arm, held = measured
    clear = (np.abs(arm - RADIUS) > 1e-6) & (np.abs(held + depth) > 2e-3)
    assert clear.mean() > 0.9
    np.testing.assert_array_equal(hit[clear], ((arm < RADIUS) | (held < -depth))[clear])


def pair_at(heavy: PreparedPipeline, change: Callable[[Round], None]) -> Round:
    """Draws that passed every stage with 6 mm to spare, changed; judged by Coal on both ends."""
    draws = run_stages(heavy, 200, seed=92)
    draws.reject((draws["start_clearance"] > 6e-3)[0] & (draws["goal_clearance"] > 6e-3)[0], "close")
    again = Round(len(draws.alive))
    for name in ("start_q", "goal_q", "start_xyz", "goal_xyz"):
        again[name] = draws[name].copy()
    change(again)
    Collision(end="both", judge="coal").prepare(heavy.context)(again, random_generator(0, "train", 0))
    return again


def test_an_object_that_stands_on_its_pedestal_is_no_collision(heavy):
    draws = pair_at(heavy, lambda _: None)
    assert len(draws.alive) == draws.size > 20


@pytest.mark.parametrize(("raised", "collides"), [(0.5e-3, False), (0.9e-3, False), (1.1e-3, True), (5e-3, True)])
@pytest.mark.parametrize("end", ["start", "goal"])
def test_an_object_may_sink_into_its_pedestal_as_deep_as_the_problem_says(heavy, end, raised, collides):
    """The pedestal's top is where the object's bottom is said to be: saying it is higher raises the pedestal."""

    def change(draws: Round) -> None:
        draws[f"{end}_xyz"][2] += raised

    draws = pair_at(heavy, change)
    assert len(draws.alive) == (0 if collides else draws.size)


def test_the_clearance_is_stored_and_never_more_than_the_wrist_leaves(heavy):
    """The object's centre is 0.15 m above its pedestal, so a capsule of 0.14 m leaves a centimetre at most."""
    draws = run_stages(heavy, 3000, seed=93)
    for end in ("start", "goal"):
        clearance = draws[f"{end}_clearance"]
        assert clearance.min() > 0
        assert clearance.max() <= 0.01 + 1e-9
    names = [field.name for field in heavy.fields]
    assert {"start_clearance", "goal_clearance"} <= set(names)


def test_arms_in_collision_are_rejected_under_the_end_s_name(heavy):
    draws = run_stages(heavy, 3000, seed=94)
    counts = np.bincount(draws.fate, minlength=1 + len(draws.reasons))[1:]
    fates = dict(zip(draws.reasons, counts.tolist(), strict=True))
    assert fates["arm in collision at the start"] > 100
    assert fates["arm in collision at the goal"] > 50
    assert fates["collision (Coal)"] == 0


def test_a_distance_that_is_asked_for_is_kept_beside_the_radius(heavy, prepare: Prepare):
    constraints = heavy.context.problem.constraint
    further = [replace(each, distance=5e-3) if isinstance(each, RobotClearance) else each for each in constraints]
    problem = replace(heavy.context.problem, constraint=tuple(further))
    context = replace(heavy.context, problem=problem)
    draws = run_stages(heavy, 1500, seed=96, until="Collision")
    before = draws["start_clearance"][0]
    Collision(end="start", judge="segments").prepare(context)(draws, random_generator(0, "train", 0))
    assert 0 < len(draws.alive) < len(before)
    np.testing.assert_array_equal(draws["start_clearance"][0], before[before > 5e-3])


def test_coal_alone_rejects_what_the_segments_reject(heavy):
    stages = heavy.pipeline.stage
    until_start = run_stages(heavy, 1500, seed=95, until="StartIK")
    by_segments = run_stages(heavy, 1500, seed=95, until="Collision")
    Collision(end="start", judge="coal").prepare(heavy.context)(until_start, random_generator(0, "train", 0))
    np.testing.assert_array_equal(until_start.alive, by_segments.alive)
    assert len(until_start.alive) < 1300
    assert replace(stages[2], judge="coal") == Collision(end="start", judge="coal")


def test_a_problem_without_obstacles_has_no_collision_stage(prepare: Prepare):
    with pytest.raises(RecipeError, match="needs a constraint 'robot-clearance'"):
        Collision(end="start", judge="segments").prepare(prepare("airhockey-hit").context)


def test_the_radius_is_the_problem_s(heavy):
    assert heavy.context.constraint(RobotClearance).radius == RADIUS
