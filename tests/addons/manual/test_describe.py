"""Recipes in words: complete, with numbers and units, and readable at 100 columns."""

import json
import re
from pathlib import Path

import pytest

from cnpgen.addons.manual.describe import (
    describe,
    describe_model,
    describe_pipeline,
    model_to_dict,
    numbers,
    quantity,
    recipe_to_dict,
)
from cnpgen.cli.main import main
from cnpgen.cli.terminal import LINE_WIDTH, table
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.planner.model_file import find_model, load_model
from cnpgen.problems.problem_file import load_problem
from cnpgen.schema.catalogue import list_recipes
from cnpgen.schema.keys import Range
from cnpgen.store.files.documents import plain
from tests.examples.example_robots import with_robots
from tests.examples.jerk_limits import jerk_limited
from tests.examples.shaped_robot import KINDS as EVERY_KIND
from tests.examples.shaped_robot import write_problem


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.15, "m", "0.15 m"),
        (Range(0.6, 1.3), "m", "[0.6, 1.3] m"),
        (Range(0.16, 0.16), "m", "0.16 m"),
        ((Range(0.0, 1.0), Range(2.0, 2.0)), "rad", "[0, 1] x 2 rad"),
        ((0.2, 0.3), "m", "(0.2, 0.3) m"),
        ((), "rad", "none"),
        (None, "m", "none"),
        ("", "1", "none"),
        ("base", "1", "base"),
        (7, "1", "7"),
        (True, "1", "true"),
        (0.0, "m", "0 m"),
    ],
)
def test_a_value_is_written_with_its_unit(value, unit, text):
    assert quantity(value, unit) == text


def test_the_numbers_of_a_constraint_have_units():
    constraints = {
        type(item).__name__: item for item in load_problem("airhockey").constraint
    }
    text = numbers(constraints["Table"])
    for part in (
        "x [0.6, 2] m",
        "y [-0.45, 0.45] m",
        "z 0.16 m",
        "start_band 0.005 m",
        "tolerance 0.001 m",
    ):
        assert part in text


@pytest.mark.parametrize("name", with_robots(list_recipes("dataset")))
def test_a_dataset_is_described_with_everything_it_refers_to(name):
    recipe = load_dataset_recipe(name)
    text = describe(recipe)
    assert f"dataset {name} {recipe.version}" in text
    assert f"pipeline {recipe.pipeline.name}" in text
    assert f"problem {recipe.pipeline.problem.name}" in text
    assert str(recipe.seed) in text
    for joint in recipe.pipeline.problem.robot.joints:
        assert joint in text
    long = [line for line in text.splitlines() if len(line) > LINE_WIDTH]
    assert not [line for line in long if str(recipe.path) not in line]


def test_the_stages_are_numbered_in_order():
    lines = describe_pipeline(load_pipeline("airhockey-hit")).splitlines()
    heads = [
        line.split()[:2]
        for line in lines
        if line.split()[0].endswith(".") and line.startswith("  ")
    ]
    names = [use for _, use in heads]
    assert [number for number, _ in heads] == [
        f"{index}." for index in range(1, len(heads) + 1)
    ]
    assert names[:2] == ["draw-positions", "start-ik"]
    assert names[-1] == "ballistic-reach"


def test_the_limits_of_every_joint_are_shown():
    text = describe(load_problem("airhockey"))
    assert re.search(
        r"joint +position +velocity +acceleration +torque +base\n +\[rad\] +\[rad/s\] +\[rad/s\^2\] ",
        text,
    )
    assert "-2.967 to 2.967" in text
    assert "11.87" in text
    problem, robot = jerk_limited("airhockey")
    limited = describe(problem)
    assert re.search(r"acceleration +jerk +torque", limited)
    assert all(f" {limit:.6g} " in limited for limit in robot.jerk_limit)


def test_an_object_and_obstacles_are_described():
    text = describe(load_problem("heavy-object"))
    assert "(0.2, 0.2, 0.3) m" in text
    assert "pedestal-2: x [0.2, 0.6] m" in text


def test_obstacles_of_every_kind_are_described_by_what_is_theirs(tmp_path):
    text = " ".join(
        describe(load_problem(write_problem(tmp_path, obstacles=EVERY_KIND))).split()
    )
    assert (
        "ball: kind sphere, position (0.3, 0.35, 0.55) m, radius 0.08 m obstacle"
        in text
    )
    assert (
        "wall: position (0.5, 0, 0.15) m, rotation (0, 0, 0.349066) rad, size (0.1, 0.5, 0.3) m obstacle"
        in text
    )
    assert "the hull of 6 corners" in text
    assert "data:" not in text


def test_the_objective_is_described():
    assert "objective  minimum time, and centrifugal 0.01 s^2/m" in describe(
        load_problem("airhockey")
    )
    assert re.search(
        r"objective +minimum time\n", describe(load_problem("heavy-object"))
    )


def test_the_links_of_a_shape_and_their_pairs_are_listed(tmp_path):
    problem = load_problem(write_problem(tmp_path))
    lines = describe(problem).splitlines()
    assert re.search(
        r"turret +1 +128 +[\d.]+ +99\.\d +29\.\d +1$",
        next(line for line in lines if " turret " in line),
    )
    hand = next(
        line for line in lines if line.startswith("    base ") and " hand " in line
    )
    assert re.search(r"3\.\d\d% +[45]\.\d\d% +judges and solvers$", hand)
    assert any(
        re.search(r"arm +fore +ignored: joined by a joint", line) for line in lines
    )
    content = json.loads(json.dumps(plain(recipe_to_dict(problem))))["shape"]
    turret = next(link for link in content["links"] if link["link"] == "turret")
    assert (turret["joint"], turret["convex_parts"], round(turret["overhang"], 3)) == (
        1,
        1,
        0.029,
    )
    assert len(content["pairs"]) == 14
    assert "shape" not in recipe_to_dict(load_problem("heavy-object"))


@pytest.mark.parametrize("kind", ["problem", "pipeline", "dataset"])
def test_every_kind_of_recipe_has_a_json_form(kind):
    load = {
        "problem": load_problem,
        "pipeline": load_pipeline,
        "dataset": load_dataset_recipe,
    }[kind]
    content = json.loads(json.dumps(plain(recipe_to_dict(load("heavy-object")))))
    assert content["kind"] == kind
    assert (
        len(content["limits"]["velocity_limit"]["values"])
        == len(content["joints"])
        == 7
    )
    assert ("stages" in content) == (kind != "problem")


def test_a_table_is_aligned_and_its_last_column_wraps():
    lines = table(
        [("a", "1", "short"), ("long", "20", "word " * 40)], indent="  ", right=(1,)
    )
    assert lines[0] == "  a      1  short"
    assert lines[1].startswith("  long  20  word word")
    assert lines[2].startswith(" " * 12 + "word")
    assert all(len(line) <= LINE_WIDTH for line in lines)


def test_a_path_stays_in_one_piece_for_scripts():
    path = Path("/a folder/" + 30 * "deeply/" + "recipe.toml")
    assert table([("name", "x"), ("file", path)], indent="  ")[1] == f"  file  {path}"


def test_a_table_can_cut_its_last_column_instead():
    (line,) = table([("name", "word " * 40)], one_line=True)
    assert len(line) <= LINE_WIDTH
    assert line.endswith(" ...")


def test_recipes_and_models_say_that_goal_accelerations_are_free(capsys):
    for name, given in (("airhockey-hit", "free"), ("panda-cup", "given")):
        model = load_model(name)
        assert model.goal_acceleration == given
        assert f'goal_acceleration = "{given}"' in describe_model(model_to_dict(model))
        text = describe_pipeline(load_pipeline(name))
        assert ('goal_acceleration = "free"' in text) == (given == "free")
    assert main(["show", "airhockey-hit"]) == 0
    assert "model of airhockey: a network of 5 x 128" in capsys.readouterr().out
    assert main(["show", str(find_model("airhockey-hit")), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["kind"], shown["goal_acceleration"]) == ("model", "free")
