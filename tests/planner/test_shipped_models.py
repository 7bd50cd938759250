"""The models that are shipped: small, of the shipped problems, documented, and as good as they say."""

from pathlib import Path

import pytest

from cnpgen.make.load import load_dataset_recipe
from cnpgen.planner.model_file import load_model, shipped_models
from cnpgen.planner.planner import Planner
from cnpgen.planner.requests import read_rows
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.problems.record import record_problem

LARGEST = 3_000_000  # bytes
STRICT = {
    "airhockey-hit": 0.95, "airhockey-onthefly": 0.85, "airhockey-replan": 0.85, "heavy-object": 0.95,
    "heavy-object-anywhere": 0.9,
}  # fmt: skip
FOLDER = Path(__file__).parents[2] / "datasets" / "models"


def test_there_is_one_for_every_shipped_dataset_of_random_draws():
    assert list(shipped_models()) == list(STRICT)


@pytest.mark.parametrize("name", STRICT)
def test_a_model_is_small_and_of_the_problem_as_it_is_shipped(name):
    assert shipped_models()[name].stat().st_size < LARGEST
    model, problem = load_model(name), load_dataset_recipe(name).pipeline.problem
    assert list(model.problem.differences(record_problem(problem))) == []


@pytest.mark.parametrize("name", STRICT)
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
