"""Listed positions and grids: each task is used once, and unsolved tasks are counted."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import RecipeError, UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.pipelines.stages.hit_angle import BehindPuck
from cnpgen.pipelines.stages.stage import CandidateBatch, Context
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.store.dataset_spec import shards
from cnpgen.store.reader import open_dataset
from cnpgen.store.shard_record import load_record
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import Arm, Prepare
from tests.refusals import is_refused

LIST = """\
name = "listed"
problem = "airhockey"

[[stage]]
use = "given-positions"
{positions}

[[stage]]
use = "at-rest"
end = "start"

[[stage]]
use = "hit-angle-to-goal"
target = "[2.49, 0] m"

[[stage]]
use = "hitting-configuration"
near = "base"

[[stage]]
use = "hitting-velocity"
full_speed = 1.0
"""
THREE = 'goal = ["[1.0, 0.1, 0.16] m", "[3.0, 0, 0.16] m", [0.9, -0.2, 0.16], "[4.0, 0, 0.16] m"]'


@pytest.fixture
def recipe(tmp_path: Path):
    def written(positions: str) -> Path:
        path = tmp_path / "listed.toml"
        path.write_text(LIST.format(positions=positions), encoding="utf-8")
        return path

    return written


def test_the_81_pucks_are_met_behind_their_centres_as_fast_as_possible(
    prepare: Prepare,
):
    prepared = prepare("airhockey-pucks")
    rows = prepared.block(0, "test", 0).columns
    puck = np.stack(
        np.meshgrid(np.linspace(0.8, 1.2, 9), np.linspace(-0.4, 0.4, 9), indexing="ij")
    ).reshape(2, -1)
    along = np.array([[2.478], [0.0]]) - puck
    along /= np.linalg.norm(along, axis=0)
    np.testing.assert_allclose(rows["goal_xyz"][:2], puck - 0.07 * along, atol=1e-12)
    np.testing.assert_array_equal(rows["hit_speed"], rows["hit_speed_max"])
    np.testing.assert_array_equal(rows["start_q"].T, [prepared.context.robot.home] * 81)
    arm = Arm(prepared.context.robot)
    for i in range(0, 81, 9):
        q, dq = rows["goal_q"][:, i].copy(), rows["goal_dq"][:, i].copy()
        np.testing.assert_allclose(
            arm.pose(q).translation[:2], rows["goal_xyz"][:2, i], atol=1e-8
        )
        np.testing.assert_allclose(
            arm.velocity(q, dq)[:2], rows["hit_speed"][0, i] * along[:, i], atol=1e-9
        )


def test_a_dataset_has_one_row_per_solved_task_and_counts_the_others(recipe, tmp_path):
    made = make_dataset(
        load_dataset_recipe(recipe(THREE)), tmp_path / "rows", workers=1
    )
    assert made.rows == {"train": 2}
    dataset = open_dataset(made.folder)
    np.testing.assert_allclose(
        dataset.read("train")["goal_xyz"], [[1.0, 0.1, 0.16], [0.9, -0.2, 0.16]]
    )
    np.testing.assert_array_equal(
        dataset.read("train")["attempts"], [1, 3]
    )  # a list ends with its last row
    (task,) = shards(made.spec)
    sampling = load_record(made.folder, task).sampling
    assert (
        sampling.tried,
        sampling.accepted,
        sampling.rejections["no hitting configuration"],
    ) == (
        4,
        2,
        2,
    )  # the last one, too
    assert validate_dataset(made.folder, deep=True, regenerate=1, workers=1).ok


def test_shards_of_one_row_hold_the_same_rows_and_the_same_counts(recipe, tmp_path):
    made = make_dataset(
        load_dataset_recipe(recipe(THREE)), tmp_path / "rows", workers=1, shard_size=1
    )
    tried = [
        load_record(made.folder, task).sampling.tried for task in shards(made.spec)
    ]
    assert tried == [1, 3]


def test_more_rows_than_solved_tasks_raise_an_error_with_the_reasons(recipe, tmp_path):
    with is_refused(UsageError):
        make_dataset(load_dataset_recipe(recipe(THREE)), tmp_path / "rows", n=3)
    assert not (tmp_path / "rows").exists()
    for n in (3, 5):
        with is_refused(UsageError):
            draw_boundary_problems(recipe(THREE), n)
    assert len(draw_boundary_problems(recipe(THREE), 2)) == 2


def test_a_dataset_without_solved_tasks_raises_an_error(recipe, tmp_path):
    with is_refused(UsageError):
        make_dataset(
            load_dataset_recipe(recipe('goal = ["[3.0, 0, 0.16] m"]')),
            tmp_path / "rows",
        )


def test_two_splits_of_the_same_tasks_raise_an_error(recipe, tmp_path):
    recipe(THREE)
    dataset = tmp_path / "dataset.toml"
    dataset.write_text(
        'name = "d"\npipeline = "listed.toml"\n[splits]\ntrain = 1\ntest = 1\n',
        encoding="utf-8",
    )
    with is_refused(UsageError):
        make_dataset(load_dataset_recipe(dataset), tmp_path / "rows")


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ("", "stage 1.goal: either a list of goals or a grid"),
        (
            THREE + '\ngrid = ["[0, 1] m", "0 m", "0 m"]\ncounts = [1, 1, 1]',
            "either a list of goals or a grid",
        ),
        (
            'grid = ["[0, 1] m", "0 m", "0 m"]\ncounts = [2, 2]',
            "stage 1.counts: expected 3 entries",
        ),
        (
            THREE + '\nstart = ["[0.6, 0, 0.16] m", "[0.7, 0, 0.16] m"]',
            "one for each of 4, got 2",
        ),
        (
            'grid = ["[0, 1] m", "0 m", "0 m"]\ncounts = [1000000000000, 1000000000000, 1]',
            "stage 1.counts: a grid of 1,000,000,000,000,000,000,000,000 goals is too large, expected at most 100,000",
        ),
        (
            'grid = ["[0, 1] m", "0 m", "0 m"]\ncounts = [2, 0, 1]',
            "0 is too small, expected at least 1",
        ),
    ],
)
def test_recipe_errors_in_the_recipe_name_their_keys(recipe, positions, message):
    with pytest.raises(RecipeError) as error:
        load_pipeline(recipe(positions))
    assert message in str(error.value)


def test_listed_starts_are_solved_by_a_later_stage(tmp_path, prepare):
    text = LIST.format(positions=THREE + '\nstart = ["[0.65, 0.02, 0.16] m"]')
    text = text.replace(
        '[[stage]]\nuse = "at-rest"',
        '[[stage]]\nuse = "start-ik"\n\n[[stage]]\nuse = "at-rest"',
    )
    (tmp_path / "from.toml").write_text(text, encoding="utf-8")
    rows = (
        prepare(load_pipeline(tmp_path / "from.toml"))
        .block(0, "train", 0, stop=2)
        .columns
    )
    np.testing.assert_array_equal(rows["start_xyz"].T, [[0.65, 0.02, 0.16]] * 2)


def test_the_mallet_is_behind_the_puck_on_the_line_of_the_hit():
    candidates = CandidateBatch(2)
    candidates["goal_xyz"], candidates["hit_angle"] = (
        np.array([[1.0, 1.0], [0.0, 0.1], [0.16, 0.16]]),
        np.array([[0.0, np.pi / 2]]),
    )
    problem = load_problem("airhockey")
    BehindPuck(distance=0.07).prepare(Context(problem, load_robot(problem), None))(
        candidates, np.random.default_rng(0)
    )
    np.testing.assert_allclose(
        candidates["goal_xyz"].T, [[0.93, 0, 0.16], [1.0, 0.03, 0.16]], atol=1e-15
    )


def test_another_distance_than_that_of_the_problem_is_a_mistake():
    problem = load_problem("airhockey")
    with is_refused(RecipeError):
        BehindPuck(distance=0.06).prepare(Context(problem, load_robot(problem), None))
