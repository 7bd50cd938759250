"""Documents whose checksums are right and that contradict each other are found."""

import json
from dataclasses import replace

import pytest

from cnpgen.store.blueprint import load_blueprint
from cnpgen.store.files.documents import load_document, save_document
from cnpgen.store.layout import STATS
from cnpgen.store.manifest import finalize
from cnpgen.store.summary import STATS_FORMAT, STATS_FORMAT_VERSION
from cnpgen.validate.dataset import validate_dataset
from cnpgen.validate.documents import check_recipe, check_statistics


def test_the_recipe_in_a_plan_must_be_the_one_whose_digest_is_recorded(damaged):
    plan = load_blueprint(damaged)
    assert check_recipe(plan) == []
    changed = json.loads(json.dumps(plan.recipe))
    changed["pipeline"]["stage"][0]["min_distance"] = 0.11
    (finding,) = check_recipe(replace(plan, recipe=changed))
    assert finding.file == "plan.json"
    assert plan.recipe_sha256 in finding.problem
    (finding,) = check_recipe(replace(plan, robot={**plan.robot, "urdf": plan.robot["urdf"] + " "}))
    assert "not the recorded" in finding.problem
    retitled = json.loads(json.dumps(plan.recipe))
    retitled["pipeline"]["title"] = "Another title"
    assert check_recipe(replace(plan, recipe=retitled)) == []


@pytest.mark.parametrize("recipe", [{}, {"pipeline": 3}, {"pipeline": {"problem": {}}}])
def test_a_plan_without_a_recipe_is_a_finding(damaged, recipe):
    (finding,) = check_recipe(replace(load_blueprint(damaged), recipe=recipe))
    assert "has no recipe" in finding.problem


def test_statistics_must_sum_up_the_records_of_the_shards(damaged):
    plan = load_blueprint(damaged)
    assert check_statistics(damaged, plan) == []
    document = load_document(damaged / STATS, STATS_FORMAT, version=STATS_FORMAT_VERSION)
    document["splits"]["train"]["start_q"]["mean"][0] += 1e-9
    save_document(damaged / STATS, document)
    (finding,) = check_statistics(damaged, plan)
    assert (finding.file, finding.problem) == (STATS, "does not sum up the shards' records: splits differ")
    report = validate_dataset(damaged, deep=True, workers=1)
    assert finding in report.findings
    finalize(damaged, plan)
    assert validate_dataset(damaged, deep=True, workers=1).findings == ()
