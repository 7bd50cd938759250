"""The shipped models: small, for the shipped problems, documented, and as good as recorded."""

from dataclasses import replace
from pathlib import Path

import pytest

from cnpgen.errors import UsageError
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.planner.model_file import load_model, model_for, shipped_models
from cnpgen.planner.plan_requests import check_stages, read_rows
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.problems.problem import resolved
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import record_problem
from cnpgen.scenes import make_scenes, plan_scenes
from cnpgen.store.files.documents import plain
from tests.conftest import needs_compiled_code, some
from tests.examples.example_robots import SHIPPED, needs_robots, with_robots
from tests.refusals import is_refused

MAX_MODEL_BYTES = 3_000_000
STRICT = {
    "airhockey-hit": 0.95,
    "airhockey-online": 0.85,
    "airhockey-replan": 0.85,
    "airhockey-tables": 0.85,
    "heavy-object": 0.95,
    "heavy-object-anywhere": 0.9,
    "heavy-object-drive": 0.95,
    "heavy-object-loads": 0.85,
    "panda-cup": 0.9,
    "panda-scenes": 0.6,
    "ur5-wipe": 0.9,
}
FOLDER = Path(__file__).parents[2] / "datasets" / "models"


def test_a_problem_selects_its_only_shipped_model_and_several_raise_an_error():
    alone = load_model("ur5-wipe")
    assert model_for(alone.problem).training == alone.training
    with is_refused(UsageError, argument="model"):
        Planner(load_model("heavy-object").problem)
    with is_refused(UsageError, argument="model"):
        Planner(record_problem(load_problem("airhockey")))
    other = replace(alone.problem, recipe=alone.problem.recipe.replace("0.1", "0.2"))
    with is_refused(UsageError, argument="model"):
        Planner(other)


def test_there_is_a_shipped_model_for_every_dataset_of_random_draws():
    assert list(shipped_models()) == list(STRICT)


@pytest.mark.parametrize("name", with_robots(STRICT))
def test_a_model_is_small_and_of_the_recipe_of_its_name(name):
    assert shipped_models()[name].stat().st_size < MAX_MODEL_BYTES
    model, pipeline = load_model(name), load_dataset_recipe(name).pipeline
    record = record_problem(pipeline.problem)
    assert list(model.problem.differences(record)) == []
    stages = plain(resolved(pipeline))["stage"]
    check_stages(name, record, stages, model, other=False)  # refuses other recipes


# Those of the shipped robots: tests/problems/test_shipped_robots.py.
@pytest.mark.parametrize(
    "name",
    some(
        [name for name in STRICT if name not in (*SHIPPED, "panda-scenes")], 1, "slow"
    ),
)
def test_a_model_reaches_its_recorded_score(name, tiny):
    planner = Planner(name)
    requests = read_rows(
        tiny(name), planner.model
    )  # raises an error if the recipe has changed
    found = evaluate_plans(planner.plan_batch(requests.boundary), workers=1)
    score = planner.model.training["score"]
    assert score["valid"] >= STRICT[name]
    assert found.valid.mean() >= score["valid"] - 0.08  # 60 rows


@needs_robots
@needs_compiled_code
@pytest.mark.slow
def test_the_planner_of_scenes_plans_in_unseen_scenes():
    scenes = make_scenes("tabletop", "panda-3kg", 25, seed=29_270_001)
    plans = plan_scenes(Planner("panda-scenes"), scenes)
    assert evaluate_plans(plans, workers=1).valid.mean() >= STRICT["panda-scenes"]


@pytest.mark.parametrize("name", STRICT)
def test_the_readme_documents_how_a_model_was_made(name):
    text, training = (
        (FOLDER / "README.md").read_text(encoding="utf-8"),
        load_model(name).training,
    )
    assert training["command"] in text
    assert f"--seed {training['dataset']['seed']}" in text
    assert f"{training['score']['valid']:.1%}" in text
    assert f"{training['cpu_seconds'] / 60:.1f} min" in text
    assert len(load_model(name).log.splitlines()) > 100
