"""Boundary states of a robot with a shape: capsules accept most of them, convex parts decide the others."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.judges.rows.verify import verify_rows
from cnpgen.kernels.tape import tape_from_function
from cnpgen.pipelines.acceptance import narrow_phase, narrow_phase_of
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.pipelines.prepared import PreparedPipeline, random_generator
from cnpgen.pipelines.stages.collision import Collision, capsule_clearance
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, load_context
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.refine.solver.residuals import stage_values
from cnpgen.robots.solid import place_obstacles
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.conftest import Prepare, run_stages, some
from tests.examples.shaped_robot import KINDS, OBSTACLES, write_pipeline, write_problem

COLLISION = '[[stage]]\nuse = "collision"\nend = "start"\njudge = "segments"\n'


@pytest.fixture(
    scope="module", params=some([OBSTACLES, KINDS], 1, "slow"), ids=["boxes", "kinds"]
)
def problem(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Problem:
    return load_problem(
        write_problem(tmp_path_factory.mktemp("crane"), obstacles=request.param)
    )


def poses_of(context: Context, count: int) -> np.ndarray:
    """Return the obstacle poses, shape (width, count)."""
    return np.repeat(place_obstacles(context.problem.obstacle)[:, None], count, axis=1)


@pytest.fixture(scope="module")
def context(problem: Problem, cache_folder: Path) -> Context:
    return load_context(problem, "numpy", cache_folder)


@pytest.fixture(scope="module")
def drawn(context: Context) -> np.ndarray:
    """Random configurations, shape (n, N)."""
    robot = context.robot
    return (
        np.random.default_rng(1)
        .uniform(robot.position_lower, robot.position_upper, (600, robot.n))
        .T.copy()
    )


def measured(context: Context, drawn: np.ndarray) -> np.ndarray:
    """Return the minimum distances of every state [m]: from obstacles, between links."""
    world, zero, found = (
        World(context.robot, context.problem.obstacle),
        np.zeros(context.robot.n),
        [],
    )
    for q in drawn.T:
        world.set_state(q.copy(), zero, zero, place_obstacles(context.problem.obstacle))
        found.append((min(world.shape_distances()), min(world.self_distances())))
    return np.array(found).T


def test_convex_parts_decide_states_without_capsule_clearance_only(
    context, drawn, monkeypatch
):
    decide, checked_counts = narrow_phase_of(context, "start"), []
    obstacle_poses, still = poses_of(context, drawn.shape[1]), np.zeros_like(drawn)
    real = PathWorld.set_path
    monkeypatch.setattr(
        PathWorld,
        "set_path",
        lambda *x: (checked_counts.append(x[1].shape[1]), real(*x))[1],
    )
    broken = decide(
        (drawn, still, still), obstacle_poses, np.ones(drawn.shape[1], bool), None
    )
    assert all(0.1 < states / drawn.shape[1] < 0.9 for states in checked_counts)
    assert len(checked_counts) == 2  # obstacles, and the robot itself
    monkeypatch.undo()
    distances = measured(context, drawn)
    names = [type(each).__name__ for each in context.problem.constraint]
    np.testing.assert_array_equal(
        broken[names.index("RobotClearance")], distances[0] < -1e-8
    )
    np.testing.assert_array_equal(
        broken[names.index("SelfClearance")], distances[1] < -1e-8
    )
    assert not broken[names.index("JointPosition")].any()
    (doubts,) = context.kernels.load(narrow_phase, end="start", dtype="float64")(
        drawn, still, still, obstacle_poses
    )
    saved = (doubts[names.index("RobotClearance")] > 0) & (distances[0] > 0)
    assert saved.sum() > 10  # states that capsules alone would reject


def test_states_with_different_obstacle_poses_are_checked_one_by_one(
    context, drawn, monkeypatch
):
    few = drawn[:, :60].copy()
    obstacle_poses, still = poses_of(context, 60), np.zeros_like(few)
    other = obstacle_poses.copy()
    other[1, 0] += 1.0
    all_states = np.ones(60, bool)
    together = narrow_phase_of(context, "start")(
        (few, still, still), obstacle_poses, all_states, None
    )
    monkeypatch.setattr(RobotClearance, "met", None)
    alone = narrow_phase_of(context, "start")(
        (few, still, still), other, all_states, None
    )
    np.testing.assert_array_equal(alone[:, 1:], together[:, 1:])
    assert alone.any()


def test_states_outside_the_mask_are_not_checked(context, drawn):
    obstacle_poses, still = poses_of(context, drawn.shape[1]), np.zeros_like(drawn)
    assert not narrow_phase_of(context, "goal")(
        (drawn, still, still), obstacle_poses, np.zeros(drawn.shape[1], bool), None
    ).any()


def test_a_robot_without_a_shape_needs_no_narrow_phase(prepare: Prepare):
    assert narrow_phase_of(prepare("airhockey-replan").context, "start") is None


@pytest.mark.parametrize("judge", ["segments", "coal"])  # the arm holds nothing
def test_the_collision_stage_keeps_states_without_collision_of_convex_parts(
    context, drawn, judge
):
    candidates = CandidateBatch(drawn.shape[1])
    candidates["start_q"], candidates["start_xyz"], candidates["goal_xyz"] = (
        drawn,
        drawn[:3],
        drawn[:3],
    )
    Collision(end="start", judge=judge).prepare(context)(
        candidates, random_generator(0, "train", 0)
    )
    distance = measured(context, drawn)[0]
    sure = (
        np.abs(distance) > 5e-4
    )  # Coal's answer with its usual tolerance is not exact
    kept = np.isin(np.arange(drawn.shape[1]), candidates.alive)
    np.testing.assert_array_equal(kept[sure], (distance > 0)[sure])
    assert candidates.reasons == ["arm in collision at the start"]


def test_the_capsules_clearance_is_a_lower_bound(context, drawn):
    obstacle_poses = poses_of(context, drawn.shape[1])
    (clearance,) = context.kernels.load(capsule_clearance)(drawn, obstacle_poses)
    distance = measured(context, drawn)[0]
    assert (clearance[0] <= np.maximum(distance, 0) + 1e-9).all()
    assert (clearance[0] > 0).mean() > 0.2


@pytest.mark.slow
def test_scenes_with_obstacles_of_the_same_kinds_share_kernels(tmp_path: Path):
    """Kernels are independent of the poses and sizes of obstacles."""
    found = []
    for number, words in enumerate([("0.08", "0.6", "20"), ("0.12", "0.5", "50")]):
        text = KINDS
        for old, new in zip(("0.08", "0.6", "20"), words, strict=True):
            text = text.replace(old, new)
        problem = load_problem(write_problem(tmp_path / str(number), obstacles=text))
        robot = load_robot(problem)
        found.append(
            [
                tape_from_function(build(robot, problem)).to_bytes()
                for build in (capsule_clearance, stage_values)
            ]
        )
    assert found[0] == found[1]


@pytest.mark.slow
@pytest.mark.parametrize("collision", ["", COLLISION])
@pytest.mark.parametrize("obstacles", [OBSTACLES, KINDS], ids=["boxes", "kinds"])
def test_rows_of_such_a_problem_pass_the_check_by_pinocchio_and_coal(
    tmp_path, prepare: Prepare, collision, obstacles
):
    write_problem(tmp_path, obstacles=obstacles)
    pipeline = load_pipeline(write_pipeline(tmp_path, collision=collision))
    prepared: PreparedPipeline = prepare(pipeline, "numpy")
    block = prepared.block(3, "train", 0, stop=300)
    columns = {name: values.T for name, values in block.columns.items()}
    report = verify_rows(prepared.context.problem, prepared.context.robot, columns)
    assert report.ok, report.failed
    assert {"robot clearance", "self clearance"} <= {
        check.name for check in report.checks
    }
    candidates = run_stages(prepared, 400, seed=1)
    assert "start_clearance" not in candidates.columns
