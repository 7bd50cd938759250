"""Collisions: the exact segment test compared with Coal, Coal compared with the verifier, and the stages."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import RecipeError
from cnpgen.pipelines.prepared import PreparedPipeline, random_generator
from cnpgen.pipelines.stages.collision import (
    Collision,
    capsule_axes_distance,
    coal_judge,
)
from cnpgen.pipelines.stages.stage import CandidateBatch
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.world.world import World
from tests.conftest import Prepare, needs_compiled_code, run_stages
from tests.refusals import is_refused

Array = np.ndarray
BACKENDS = [pytest.param("compiled", marks=needs_compiled_code), "numpy", "casadi"]
RADIUS = 0.14


@pytest.fixture(scope="module")
def heavy(prepare: Prepare) -> PreparedPipeline:
    return prepare("heavy-object")


@pytest.fixture(scope="module")
def anywhere(heavy: PreparedPipeline) -> tuple[Array, Array]:
    """Random configurations, most of them tilted, and pedestals of random height."""
    robot, random = heavy.context.robot, np.random.default_rng(91)
    q = random.uniform(
        robot.position_lower, robot.position_upper, (2000, robot.n)
    ).T.copy()
    return q, random.uniform(0.05, 0.9, (2, 2000))


@pytest.fixture(scope="module")
def measured(
    heavy: PreparedPipeline, anywhere: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Minimum distances of the arm's segments and of the object, computed by the verifier with Coal."""
    world = World(
        heavy.context.robot,
        heavy.context.problem.obstacle,
        heavy.context.problem.object_size,
    )
    zero, arm, held = np.zeros(7), [], []
    for q, obstacle_poses in zip(*(values.T for values in anywhere), strict=True):
        world.set_state(q, zero, zero, obstacle_poses)
        arm.append(min(world.segment_distances()))
        held.append(min(world.object_distances()))
    return np.array(arm), np.array(held)


@pytest.mark.parametrize("backend", BACKENDS)
def test_segment_distances_agree_with_coal_s(
    heavy, anywhere, measured, kernels_of, backend
):
    q, obstacle_poses = (
        np.ascontiguousarray(values[:, : 300 if backend == "casadi" else 2000])
        for values in anywhere
    )
    (found,) = kernels_of(heavy, backend).load(capsule_axes_distance)(q, obstacle_poses)
    np.testing.assert_allclose(
        found[0], np.maximum(measured[0][: q.shape[1]], 0), rtol=0, atol=1e-9
    )


def test_the_segment_stage_and_the_coal_stage_reject_the_same_arms(
    heavy, anywhere, fastest, kernels_of
):
    """The object is omitted, since the segment test ignores it."""
    q, obstacle_poses = anywhere
    problem = replace(heavy.context.problem, object=None)
    hit = coal_judge(problem, heavy.context.robot, RADIUS, 0.0)(q, obstacle_poses)
    (distance,) = kernels_of(heavy, fastest).load(capsule_axes_distance)(
        q, obstacle_poses
    )
    clear = np.abs(distance[0] - RADIUS) > 1e-7
    assert clear.mean() > 0.999
    np.testing.assert_array_equal(hit[clear], (distance[0] <= RADIUS)[clear])
    assert 0.1 < hit.mean() < 0.9


def test_coal_s_verdict_on_arm_and_object_agrees_with_the_verifier_s_distances(
    heavy, anywhere, measured
):
    """States within 2 mm of a limit are omitted: a smaller object is only an approximation of the allowed depth."""
    depth = heavy.context.constraint(ObjectContact).depth
    hit = coal_judge(heavy.context.problem, heavy.context.robot, RADIUS, depth)(
        *anywhere
    )
    arm, held = measured
    clear = (np.abs(arm - RADIUS) > 1e-6) & (np.abs(held + depth) > 2e-3)
    assert clear.mean() > 0.9
    np.testing.assert_array_equal(hit[clear], ((arm < RADIUS) | (held < -depth))[clear])


def pair_at(
    heavy: PreparedPipeline, change: Callable[[CandidateBatch], None]
) -> CandidateBatch:
    """Return the check by Coal of changed candidates that passed every stage with a margin of 6 mm."""
    candidates = run_stages(heavy, 200, seed=92)
    candidates.reject(
        (candidates["start_clearance"] > 6e-3)[0]
        & (candidates["goal_clearance"] > 6e-3)[0],
        "close",
    )
    again = CandidateBatch(len(candidates.alive))
    for name in ("start_q", "goal_q", "start_xyz", "goal_xyz"):
        again[name] = candidates[name].copy()
    change(again)
    Collision(end="both", judge="coal").prepare(heavy.context)(
        again, random_generator(0, "train", 0)
    )
    return again


def test_without_a_held_object_coal_agrees_with_the_segment_test(heavy):
    problem = replace(
        heavy.context.problem,
        object=None,
        constraint=(heavy.context.constraint(RobotClearance),),
    )
    context, kept = replace(heavy.context, problem=problem), []
    for judge in ("coal", "segments"):
        candidates = run_stages(heavy, 1500, seed=96, until="StartIK")
        for end in (
            "start",
            "goal",
        ):  # without an object, the pedestals would end at the tip
            candidates[f"{end}_xyz"] = candidates[f"{end}_xyz"] - [[0.0], [0.0], [0.15]]
        Collision(end="start", judge=judge).prepare(context)(
            candidates, random_generator(0, "train", 0)
        )
        kept.append(np.isin(np.arange(1500), candidates.alive))
    assert (
        kept[0] == kept[1]
    ).mean() > 0.999  # Coal's capsules have its usual tolerance
    assert 0.05 < kept[0].mean() < 0.95


def test_an_object_that_stands_on_its_pedestal_is_no_collision(heavy):
    candidates = pair_at(heavy, lambda _: None)
    assert len(candidates.alive) == candidates.size > 20


@pytest.mark.parametrize(
    ("raised", "collides"),
    [(0.5e-3, False), (0.9e-3, False), (1.1e-3, True), (5e-3, True)],
)
@pytest.mark.parametrize("end", ["start", "goal"])
def test_an_object_may_penetrate_its_pedestal_up_to_the_depth_of_the_problem(
    heavy, end, raised, collides
):
    """The given object position defines the top of the pedestal: a higher position raises the pedestal."""

    def change(candidates: CandidateBatch) -> None:
        candidates[f"{end}_xyz"][2] += raised

    candidates = pair_at(heavy, change)
    assert len(candidates.alive) == (0 if collides else candidates.size)


def test_the_clearance_is_stored_and_bounded_by_the_wrist(heavy):
    """The object's centre is 0.15 m above its pedestal, so a capsule of 0.14 m leaves a centimetre at most."""
    candidates = run_stages(heavy, 3000, seed=93)
    for end in ("start", "goal"):
        clearance = candidates[f"{end}_clearance"]
        assert clearance.min() > 0
        assert clearance.max() <= 0.01 + 1e-9
    names = [field.name for field in heavy.fields]
    assert {"start_clearance", "goal_clearance"} <= set(names)


def test_arms_in_collision_are_rejected_under_the_name_of_the_end(heavy):
    candidates = run_stages(heavy, 3000, seed=94)
    counts = np.bincount(candidates.outcome, minlength=1 + len(candidates.reasons))[1:]
    sampling = dict(zip(candidates.reasons, counts.tolist(), strict=True))
    assert sampling["arm in collision at the start"] > 100
    assert sampling["arm in collision at the goal"] > 50
    assert sampling["collision (Coal)"] == 0


def test_a_required_distance_is_added_to_the_radius(heavy, prepare: Prepare):
    constraints = heavy.context.problem.constraint
    further = [
        replace(each, distance=5e-3) if isinstance(each, RobotClearance) else each
        for each in constraints
    ]
    problem = replace(heavy.context.problem, constraint=tuple(further))
    context = replace(heavy.context, problem=problem)
    candidates = run_stages(heavy, 1500, seed=96, until="Collision")
    before = candidates["start_clearance"][0]
    Collision(end="start", judge="segments").prepare(context)(
        candidates, random_generator(0, "train", 0)
    )
    assert 0 < len(candidates.alive) < len(before)
    np.testing.assert_array_equal(
        candidates["start_clearance"][0], before[before > 5e-3]
    )


def test_coal_alone_rejects_the_candidates_that_the_segments_reject(heavy):
    stages = heavy.pipeline.stage
    until_start = run_stages(heavy, 1500, seed=95, until="StartIK")
    by_segments = run_stages(heavy, 1500, seed=95, until="Collision")
    Collision(end="start", judge="coal").prepare(heavy.context)(
        until_start, random_generator(0, "train", 0)
    )
    np.testing.assert_array_equal(until_start.alive, by_segments.alive)
    assert len(until_start.alive) < 1300
    assert replace(stages[2], judge="coal") == Collision(end="start", judge="coal")


def test_a_problem_without_obstacles_has_no_collision_stage(prepare: Prepare):
    with is_refused(RecipeError):
        Collision(end="start", judge="segments").prepare(
            prepare("airhockey-hit").context
        )


def test_the_radius_is_the_problem_s(heavy):
    assert heavy.context.constraint(RobotClearance).radius == RADIUS
