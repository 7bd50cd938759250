"""Stages that draw scenes and their ends: shares, capacities, distinct pairs, colliding lines, and both backends."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import RecipeError
from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.pipeline import Pipeline, load_pipeline
from cnpgen.pipelines.resting_states import RestingStates
from cnpgen.pipelines.stages.draw_scenes import TOO_MANY, base_depths
from cnpgen.pipelines.stages.scene_clearance import SceneClearance
from cnpgen.pipelines.stages.scene_ends import (
    MAX_POSE_IK_STEPS,
    NO_ENDS,
    POSE_TOLERANCE,
    pose_ik_step,
)
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, load_context
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import with_capacity
from cnpgen.robots.observation.primitives import KINDS, primitives_of
from cnpgen.robots.scene import make_scene_table, scene_capacity
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.store.scene_table import OBSTACLE_KINDS
from cnpgen.world.pose_ik import PoseKinematics
from tests.conftest import needs_compiled_code
from tests.examples.numpy_observations import signed_distances
from tests.examples.obstacles import draw_obstacle
from tests.examples.scene_arm import obstacles_of, write_scene_pipeline
from tests.refusals import is_refused


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Pipeline:
    return load_pipeline(write_scene_pipeline(tmp_path_factory.mktemp("scene_stages")))


@pytest.fixture(scope="module")
def context(pipeline: Pipeline, cache_folder: Path) -> Context:
    return load_context(pipeline.problem, "compiled", cache_folder)


def drawn(
    pipeline: Pipeline, context: Context, size: int, *, stages: int, seed: int = 3
) -> CandidateBatch:
    candidates, random = CandidateBatch(size), np.random.default_rng(seed)
    for stage in pipeline.stage[:stages]:
        stage.prepare(context)(candidates, random)
    return candidates


def test_kinds_have_one_code() -> None:
    assert OBSTACLE_KINDS == KINDS


def test_the_pipeline_adds_places_for_the_obstacles_of_scenes(
    pipeline: Pipeline,
) -> None:
    assert scene_capacity(pipeline.problem.obstacle) == 14
    assert load_robot(pipeline.problem).n == 7


def test_tables_hold_obstacles_of_every_kind() -> None:
    random = np.random.default_rng(5)
    kinds = ("turned box", "sphere", "cylinder", "capsule", "box", "cylinder")
    layouts = [
        tuple(draw_obstacle(kind, random) for kind in kinds[: 6 - k]) for k in range(4)
    ]
    table = make_scene_table(layouts, [0, 1, 0, 1], 8)
    for scene, layout in enumerate(layouts):
        for kept, obstacle in zip(obstacles_of(table, scene), layout, strict=True):
            a, b = (
                solids_of([each], place_obstacles([each]))[0]
                for each in (kept, obstacle)
            )
            assert a.low == pytest.approx(b.low, abs=1e-12)
            assert a.high == pytest.approx(b.high, abs=1e-12)


def test_depths_of_the_base_are_signed_distances() -> None:
    random = np.random.default_rng(6)
    kinds = ("turned box", "sphere", "cylinder", "capsule") * 9
    layouts = [(draw_obstacle(kind, random),) for kind in kinds]
    depths = base_depths(make_scene_table(layouts, [0] * len(layouts), 1))
    wanted = [
        -signed_distances(
            primitives_of(each, place_obstacles(each)), np.zeros((1, 3))
        ).min()
        for each in layouts
    ]
    inside = np.array(wanted) > 0
    assert inside.any()
    assert depths[inside] == pytest.approx(np.array(wanted)[inside], abs=1e-12)
    assert np.array_equal(depths > 0, inside)


@needs_compiled_code
def test_candidates_share_scenes_evenly(pipeline: Pipeline, context: Context) -> None:
    candidates = drawn(pipeline, context, 64, stages=1)
    counts = np.bincount(candidates.scene)
    assert len(candidates.scenes) == len(counts) == 13
    assert set(counts.tolist()) <= {4, 5}
    assert (candidates.scenes.table.obstacle_count >= 2).all()


@needs_compiled_code
def test_scenes_with_too_many_obstacles_are_rejected(
    pipeline: Pipeline, context: Context
) -> None:
    few = {"box": 3, "cylinder": 2, "sphere": 1}
    problem = with_capacity(replace(pipeline.problem, obstacle=()), few)
    stage = replace(pipeline.stage[0], capacity=few)
    candidates = drawn(
        replace(pipeline, stage=(stage,)),
        replace(context, problem=problem),
        64,
        stages=1,
    )
    assert 0 < len(candidates.alive) < 64
    kept = candidates.scenes.table[np.unique(candidates.scene)]
    assert ((kept.obstacle_kind == 0).sum(axis=1) <= 3).all()
    assert candidates.reasons[0] == TOO_MANY
    with is_refused(RecipeError):
        stage.prepare(context)


@needs_compiled_code
def test_lines_collide_and_no_pair_occurs_twice(
    pipeline: Pipeline, context: Context
) -> None:
    stages = (pipeline.stage[0], replace(pipeline.stage[1], straight=0.0))
    candidates = drawn(replace(pipeline, stage=stages), context, 200, stages=2)
    robot, pairs = context.robot, set()
    assert len(candidates.alive) > 20
    for index in range(len(candidates.alive)):
        start, goal = candidates["start_q"][:, index], candidates["goal_q"][:, index]
        pairs.add((*start, *goal))
        if index % 5 == 0:
            obstacles = obstacles_of(
                candidates.scenes.table, int(candidates.scene[index])
            )
            states = RestingStates(
                replace(context.problem, obstacle=()), robot, obstacles
            )
            assert states.are_ends(
                np.stack([start, goal], axis=1), margin=0.005 - 1e-6
            ).all()
            assert not states.is_line_clear(start, goal)
    assert len(pairs) == len(candidates.alive)


@needs_compiled_code
def test_scenes_without_grasps_have_no_samples(
    pipeline: Pipeline, context: Context
) -> None:
    candidates = drawn(pipeline, context, 20, stages=1)
    candidates.scenes = replace(
        candidates.scenes, grasp_count=0 * candidates.scenes.grasp_count
    )
    pipeline.stage[1].prepare(context)(candidates, np.random.default_rng(4))
    assert not len(candidates.alive)
    assert candidates.reasons[-1] == NO_ENDS


@needs_compiled_code
def test_coal_decides_like_compiled_checks(
    pipeline: Pipeline, context: Context
) -> None:
    scenes = drawn(pipeline, context, 40, stages=1).scenes
    random, scene = np.random.default_rng(8), np.repeat(np.arange(len(scenes)), 12)
    q = random.uniform(-2.5, 2.5, (7, len(scene)))
    compiled = SceneClearance(context)
    clear = compiled.are_clear(q, scene, scenes, 0.01)
    assert 0 < clear.sum() < len(clear)
    measured, states = [], RestingStates(context.problem, context.robot)
    for index in range(len(scenes)):
        poses = scenes.poses[index]
        states.place_solids(solids_of(context.problem.obstacle, poses))
        measured += states.are_clear(q[:, scene == index], margin=0.01).tolist()
    assert np.array_equal(clear, measured)


@needs_compiled_code
def test_inverse_kinematics_reaches_poses(context: Context) -> None:
    robot, random = context.robot, np.random.default_rng(9)
    kinematics, loop = PoseKinematics(robot), Loop(POSE_TOLERANCE, MAX_POSE_IK_STEPS)
    kernel = context.kernels.load(pose_ik_step, loop)
    position, rotation, _ = kinematics.evaluate(random.uniform(-2, 2, (7, 200)))
    q, error = kernel(
        random.uniform(-2, 2, (7, 200)),
        position.T.copy(),
        rotation.reshape(-1, 9).T.copy(),
    )
    met = error[0] < POSE_TOLERANCE
    assert met.mean() > 0.3
    reached, turned, _ = kinematics.evaluate(q[:, met])
    assert reached == pytest.approx(position[met], abs=1e-8)
    assert turned == pytest.approx(rotation[met], abs=1e-7)
