"""Quantities of shipped recipes in degrees, millimetres, grams or milliseconds are refused with a suggestion."""

import re

import pytest

from cnpgen.errors import RecipeError
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.schema.catalogue import find_recipe

PROBLEMS = {
    ("heavy-object", "vertical"): {"tolerance": 1.8},
    ("heavy-object", "obstacle"): {"x": [200, 600], "y": [-400, 400]},
    ("heavy-object", "robot-clearance"): {"radius": 140, "tolerance": 10},
    ("heavy-object-loads", "payload"): {"mass": 12000, "centre": [0, 0, 150]},
    ("heavy-object", "object"): {"size": [200, 200, 300]},
    ("airhockey", "table"): {"start_band": 5, "tolerance": 10, "z": 160},
    ("airhockey", "puck-contact"): {"last": 10, "mallet_radius": 48},
    ("airhockey", "robot"): {
        "tip_rotation": [0, 90, 0],
        "tip_offset": [0, 0, 90],
        "base": [0, 45, 0, -90, 0, 0],
    },
    ("airhockey", "limits"): {"acceleration_cap": 1146},
}
PIPELINES = {
    ("airhockey-hit", "hit-angle-to-goal"): {"target": [2490, 0], "noise": 17},
    ("airhockey-replan", "hit-angle-in-cone"): {"half_angle": 120},
    ("airhockey-replan", "ballistic-reach"): {"start_time": 20},
    ("airhockey-replan", "start-ik"): {"guess": [[-30, 30]] * 6, "max_step": 45},
    ("heavy-object-anywhere", "goal-ik"): {"max_change": 165},
    ("airhockey-pucks", "behind-puck"): {"distance": 70},
    ("heavy-object", "draw-positions"): {
        "min_distance": 150,
        "start": [[200, 600], [-400, 400], [0, 100]],
    },
}


def cases(tables):
    return [
        (*place, key, value)
        for place, keys in tables.items()
        for key, value in keys.items()
    ]


def changed(text: str, table: str, key: str, value: object) -> str:
    """Replace a key of a table or of the array entry that uses a name, or add the key."""
    heads = [
        rf"\[{table}\].*\n",
        rf"\[\[{table}\]\].*\n",
        rf'\[\[\w+\]\].*\n(?:#.*\n)*use = "{table}".*\n',
    ]
    head = next(found for each in heads if (found := re.search(each, text)))
    end = text.find("\n[", head.end())
    body = text[head.end() : end if end > 0 else len(text)]
    other = re.sub(
        rf"^{key} = (\[\n( .*\n)*\]|.*)\n", "", body + "\n", flags=re.MULTILINE
    )
    return (
        text[: head.end()]
        + f"{key} = {value}\n"
        + other
        + (text[end:] if end > 0 else "")
    )


def errors(load, file) -> list[str]:
    with pytest.raises(RecipeError) as caught:
        load(file)
    return caught.value.errors


@pytest.mark.parametrize(("recipe", "table", "key", "value"), cases(PROBLEMS))
def test_problems_refuse_quantities_in_another_unit(
    tmp_path, recipe, table, key, value
):
    source = find_recipe(("problem",), recipe)
    file = tmp_path / "problem.toml"
    text = changed(source.read_text(encoding="utf-8"), table, key, value)
    file.write_text(
        re.sub(r'urdf = "([^:"]*)"', rf'urdf = "{source.parent}/\1"', text),
        encoding="utf-8",
    )
    found = errors(lambda path: load_robot(load_problem(path)), file)
    assert any(f"{key}" in each and "did you mean" in each for each in found), found


@pytest.mark.parametrize(("recipe", "table", "key", "value"), cases(PIPELINES))
def test_pipelines_refuse_quantities_in_another_unit(
    tmp_path, recipe, table, key, value
):
    file = tmp_path / "pipeline.toml"
    text = changed(
        find_recipe(("pipeline",), recipe).read_text(encoding="utf-8"),
        table,
        key,
        value,
    )
    file.write_text(text, encoding="utf-8")
    found = errors(load_pipeline, file)
    assert any(f"{key}" in each and "did you mean" in each for each in found), found
