"""The models that are shipped: small, of the shipped problems, documented, and as good as they say."""

from dataclasses import replace
from pathlib import Path

import pytest

from cnpgen.errors import UsageError
from cnpgen.make.load import load_dataset_recipe
from cnpgen.planner.model_file import load_model, model_for, shipped_models
from cnpgen.planner.planner import Planner
from cnpgen.planner.requests import read_rows
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.problems.load import load_problem
from cnpgen.problems.record import record_problem
from tests.conftest import some
from tests.examples.example_robots import SHIPPED, with_robots

LARGEST = 3_000_000  # bytes
STRICT = {
    "airhockey-hit": 0.95,
    "airhockey-onthefly": 0.85,
    "airhockey-replan": 0.85,
    "heavy-object": 0.95,
    "heavy-object-anywhere": 0.9,
    "panda-cup": 0.9,
    "ur5-wipe": 0.9,
}
FOLDER = Path(__file__).parents[2] / "datasets" / "models"


def test_a_problem_finds_the_planner_that_is_the_only_one_for_it_and_hears_of_several():
    alone = load_model("ur5-wipe")
    assert model_for(alone.problem).training == alone.training
    with pytest.raises(UsageError, match=r"several shipped models \(heavy-object, heavy-object-anywhere\) for"):
        Planner(load_model("heavy-object").problem)
    with pytest.raises(UsageError, match="airhockey-hit, airhockey-onthefly, airhockey-replan"):
        Planner(record_problem(load_problem("airhockey")))
    other = replace(alone.problem, recipe=alone.problem.recipe.replace("0.1", "0.2"))
    with pytest.raises(UsageError, match="no shipped model for the problem 'ur5-wipe'"):
        Planner(other)


def test_there_is_one_for_every_shipped_dataset_of_random_draws():
    assert list(shipped_models()) == list(STRICT)


@pytest.mark.parametrize("name", with_robots(STRICT))
def test_a_model_is_small_and_of_the_problem_as_it_is_shipped(name):
    assert shipped_models()[name].stat().st_size < LARGEST
    model, problem = load_model(name), load_dataset_recipe(name).pipeline.problem
    assert list(model.problem.differences(record_problem(problem))) == []


# Those of the shipped robots: tests/problems/test_shipped_robots.py.
@pytest.mark.parametrize("name", some([name for name in STRICT if name not in SHIPPED], 1, "slow"))
def test_a_model_is_as_good_as_it_says(name, tiny):
    planner = Planner(name)
    asked = read_rows(tiny(name), planner.model)  # raises if rows are drawn in another way now
    found = evaluate_plans(planner.plan_batch(asked.boundary), workers=1)
    score = planner.model.training["score"]
    assert score["valid"] >= STRICT[name]
    assert found.valid.mean() >= score["valid"] - 0.08  # 60 rows


@pytest.mark.parametrize("name", STRICT)
def test_the_readme_says_how_a_model_was_made(name):
    text, training = (FOLDER / "README.md").read_text(encoding="utf-8"), load_model(name).training
    assert training["command"] in text
    assert f"--seed {training['dataset']['seed']}" in text
    assert f"{training['score']['valid']:.1%}" in text
    assert f"{training['cpu_seconds'] / 60:.1f} min" in text
    assert len(load_model(name).log.splitlines()) > 100
