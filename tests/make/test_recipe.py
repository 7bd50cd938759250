"""Problem, Pipeline and DatasetRecipe: splits, resolved values, identity."""

import json
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from cnpgen.errors import RecipeError, UsageError
from cnpgen.make.recipe import (
    DatasetRecipe,
    load_dataset_recipe,
    load_notes,
    recipe_digest,
    split_rows,
)
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.problems.problem import Problem, resolved
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot_spec import LimitSpec, RobotSpec
from cnpgen.schema.catalogue import list_recipes
from cnpgen.schema.keys import Range
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from tests.examples.stages import Roll
from tests.refusals import is_refused


@pytest.fixture
def recipe(tmp_path):
    (tmp_path / "arm.urdf").write_text("<robot name='arm'/>")
    robot = RobotSpec(urdf="arm.urdf", joints=("a", "b"), tip="hand", base=(0.0, 0.0))
    problem = Problem(
        name="arm", robot=robot, limits=LimitSpec(), path=tmp_path / "problem.toml"
    )
    pipeline = Pipeline(
        name="arm",
        problem=problem,
        stage=(Roll(size=Range(0.0, 1.0)),),
        path=tmp_path / "arm.toml",
    )
    return DatasetRecipe(
        name="arm",
        pipeline=pipeline,
        splits={"train": 80, "validation": 10, "test": 10},
    )


def with_splits(recipe: DatasetRecipe, rows: Iterable[int]) -> DatasetRecipe:
    return replace(recipe, splits=dict(zip("abcdefgh", rows, strict=False)))


SPLITS = [
    (1,),
    (90, 10),
    (80, 10, 10),
    (1, 1, 1),
    (1, 45, 45),
    (7, 3, 3, 1),
    (1, 1000, 2),
    (19000, 1000),
]


@pytest.mark.parametrize("rows", SPLITS)
def test_no_split_shrinks_when_n_grows(recipe, rows):
    recipe = with_splits(recipe, rows)
    before: dict[str, int] = {}
    for n in range(1, 2 * min(sum(rows), 500) + 3):
        now = split_rows(recipe, n)
        assert sum(now.values()) == n
        assert all(now.get(name, 0) >= count for name, count in before.items())
        before = now


@pytest.mark.parametrize("rows", SPLITS)
def test_n_equal_to_the_total_gives_the_recipes_own_rows(recipe, rows):
    recipe = with_splits(recipe, rows)
    for factor in (1, 2, 10**12):
        expected = {name: count * factor for name, count in recipe.splits.items()}
        assert split_rows(recipe, factor * sum(rows)) == expected


@pytest.mark.parametrize("rows", SPLITS)
def test_every_split_is_within_its_share(recipe, rows):
    recipe = with_splits(recipe, rows)
    total = sum(rows)
    for n in (1, 5, 17, 999):
        now = split_rows(recipe, n)
        assert all(
            now.get(name, 0) >= n * share // total
            for name, share in recipe.splits.items()
        )


def test_a_split_without_rows_is_left_out_and_the_order_is_kept(recipe):
    assert split_rows(recipe, 1) == {"train": 1}
    assert split_rows(recipe, 9) == {"train": 8, "validation": 1}
    assert list(split_rows(recipe, 10)) == ["train", "validation", "test"]


@pytest.mark.parametrize("n", [0, -1])
def test_no_rows_is_a_usage_error(recipe, n):
    with is_refused(UsageError, argument="n"):
        split_rows(recipe, n)


def test_resolved_is_plain_json_with_everything_referred_to(recipe):
    plain = resolved(recipe)
    assert json.loads(json.dumps(plain)) == plain
    (stage,) = plain["pipeline"]["stage"]
    assert len(stage.pop("source")) == 64  # the digest of a plug-in's code
    assert stage == {"use": "tests.examples.stages:Roll", "size": [0.0, 1.0]}
    assert plain["pipeline"]["problem"]["limits"]["acceleration_cap"] == 20.0
    assert plain["version"] == "1.0.0"
    assert "path" not in plain
    assert "digest" not in plain["pipeline"]


def changed(recipe: DatasetRecipe, **pipeline) -> DatasetRecipe:
    return replace(recipe, pipeline=replace(recipe.pipeline, **pipeline))


def test_the_digest_ignores_what_does_not_change_the_rows_of_a_seed(recipe, tmp_path):
    digest = recipe_digest(recipe)
    assert len(digest) == 64
    assert recipe_digest(recipe.pipeline) == digest
    assert (
        recipe_digest(
            replace(
                recipe, title="x", seed=7, splits={"a": 1}, version="2.0.0", name="x"
            )
        )
        == digest
    )
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    (moved / "renamed.urdf").write_bytes((tmp_path / "arm.urdf").read_bytes())
    problem = recipe.pipeline.problem
    robot = replace(problem.robot, urdf="renamed.urdf")
    problem = replace(problem, title="x", path=moved / "other.toml", robot=robot)
    assert (
        recipe_digest(changed(recipe, title="x", path=moved, problem=problem)) == digest
    )


def test_the_digest_changes_with_stages_problem_and_urdf(recipe, tmp_path):
    digest = recipe_digest(recipe)
    problem = recipe.pipeline.problem
    others = {
        recipe_digest(changed(recipe, stage=(Roll(size=Range(0.0, 2.0)),))),
        recipe_digest(changed(recipe, stage=recipe.pipeline.stage * 2)),
        recipe_digest(
            changed(
                recipe, problem=replace(problem, limits=LimitSpec(velocity_scale=0.5))
            )
        ),
    }
    (tmp_path / "arm.urdf").write_text("<robot name='leg'/>")
    assert (
        recipe_digest(recipe) == digest
    )  # the URDF is read once: all of a problem is of one text
    others.add(recipe_digest(changed(recipe, problem=replace(problem))))
    assert len(others | {digest}) == 5


def test_base_has_one_value_per_planned_joint():
    robot = RobotSpec(urdf="arm.urdf", joints=("a", "b"), tip="hand", base=(0.0, 0.0))
    assert list(robot.validate()) == []
    assert list(replace(robot, base=(0.0,)).validate()) == [
        ("base", "expected 2 numbers, one per planned joint, got 1")
    ]


def test_a_joint_is_planned_once():
    robot = RobotSpec(urdf="arm.urdf", joints=("a", "a"), tip="hand", base=(0.0, 0.0))
    assert [key for key, _ in robot.validate()] == ["joints"]


@pytest.mark.parametrize(
    ("top", "below", "keys"),
    [(0.5, "", []), (None, "start", []), (None, "", ["top"]), (0.5, "goal", ["top"])],
)
def test_an_obstacle_has_either_a_top_or_an_object_on_it(top, below, keys):
    obstacle = Obstacle(
        name="box", x=Range(0.0, 1.0), y=Range(0.0, 1.0), top=top, below=below
    )
    assert [key for key, _ in obstacle.validate()] == keys


def test_an_obstacle_has_an_extent():
    obstacle = Obstacle(name="box", x=Range(0.0, 0.0), y=Range(1.0, 1.0), top=0.0)
    assert [key for key, _ in obstacle.validate()] == ["x", "y"]


@pytest.mark.parametrize(("count", "keys"), [(8, []), (7, ["path_control_points"])])
def test_a_spline_has_more_control_points_than_its_degree(count, keys):
    spec = TrajectorySpec(degree=7, path_control_points=count)
    assert [key for key, _ in spec.validate()] == keys


@pytest.mark.parametrize("name", list_recipes("dataset"))
def test_every_shipped_dataset_loads_and_resolves(name):
    recipe = load_dataset_recipe(name)
    assert recipe.name == name
    assert all(
        ":" not in stage["use"] for stage in resolved(recipe)["pipeline"]["stage"]
    )
    assert split_rows(recipe, sum(recipe.splits.values())) == recipe.splits


def thin_object(folder: Path, size: str) -> Path:
    """The shipped heavy object with other edge lengths."""
    shipped = list_recipes("problem")["heavy-object"]
    text = (
        shipped.read_text()
        .replace('urdf = "', f'urdf = "{shipped.parent}/')
        .replace("[0.2, 0.2, 0.3] m", size)
    )
    (folder / "problem.toml").write_text(text)
    return folder / "problem.toml"


@pytest.mark.parametrize("key", ["obstacle", "constraint", "stage"])
def test_there_are_not_more_of_anything_than_kernels_can_be_compiled_for(recipe, key):
    whole = recipe.pipeline if key == "stage" else load_problem("heavy-object")
    many = replace(whole, **{key: getattr(whole, key)[:1] * 101})
    assert [
        (where, text.partition(" of them")[0].partition(" stages")[0])
        for where, text in many.validate()
    ] == [(key, "there are 101")]
    assert list(replace(whole, **{key: getattr(whole, key)[:1] * 100}).validate()) == []


def test_notes_that_are_a_link_to_another_folder_are_not_passed_on(tmp_path):
    shipped = list_recipes("dataset")["airhockey-hit"]
    (tmp_path / "private").write_text("a secret")
    for name, target in (("theirs", tmp_path / "private"), ("mine", "notes.txt")):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "hits.toml").write_text(shipped.read_text())
        (folder / "notes.txt").write_text("what I saw")
        (folder / "hits.md").symlink_to(target)
    with is_refused(RecipeError):
        load_notes(load_dataset_recipe(tmp_path / "theirs" / "hits.toml"))
    assert (
        load_notes(load_dataset_recipe(tmp_path / "mine" / "hits.toml")) == "what I saw"
    )


def test_an_object_must_be_thicker_than_its_contacts_may_be_deep(tmp_path):
    with is_refused(RecipeError):
        load_problem(thin_object(tmp_path, "[200, 200, 2] mm"))
    assert (
        load_problem(thin_object(tmp_path, "[200, 200, 2.1] mm")).object.size[2]
        == 0.0021
    )


@pytest.mark.parametrize(
    ("name", "key"), [("airhockey", "table"), ("heavy-object", "vertical")]
)
def test_no_motion_can_be_asked_to_hold_an_equality_with_a_tolerance_of_zero(
    tmp_path, name, key
):
    path = tmp_path / "problem.toml"
    shipped = load_problem(name)
    text = shipped.path.read_text().replace(shipped.robot.urdf, str(shipped.urdf_path))
    head, rest = text.split(f'use = "{key}"')
    path.write_text(
        f'{head}use = "{key}"'
        + re.sub(r"(?m)^tolerance = .*$", "tolerance = 0", rest, count=1)
    )
    with is_refused(RecipeError):
        load_problem(path)
