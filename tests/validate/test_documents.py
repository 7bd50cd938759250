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


def test_the_recipe_in_a_blueprint_must_be_the_one_whose_digest_is_recorded(damaged):
    blueprint = load_blueprint(damaged)
    assert check_recipe(blueprint) == []
    changed = json.loads(json.dumps(blueprint.recipe))
    changed["pipeline"]["stage"][0]["min_distance"] = 0.11
    (finding,) = check_recipe(replace(blueprint, recipe=changed))
    assert finding.file == "plan.json"
    assert blueprint.recipe_sha256 in finding.problem
    (finding,) = check_recipe(replace(blueprint, robot={**blueprint.robot, "urdf": blueprint.robot["urdf"] + " "}))
    assert "not the recorded" in finding.problem
    retitled = json.loads(json.dumps(blueprint.recipe))
    retitled["pipeline"]["title"] = "Another title"
    assert check_recipe(replace(blueprint, recipe=retitled)) == []


@pytest.mark.parametrize("recipe", [{}, {"pipeline": 3}, {"pipeline": {"problem": {}}}])
def test_a_blueprint_without_a_recipe_is_a_finding(damaged, recipe):
    (finding,) = check_recipe(replace(load_blueprint(damaged), recipe=recipe))
    assert "has no recipe" in finding.problem


def test_statistics_must_sum_up_the_records_of_the_shards(damaged):
    blueprint = load_blueprint(damaged)
    assert check_statistics(damaged, blueprint) == []
    document = load_document(damaged / STATS, STATS_FORMAT, version=STATS_FORMAT_VERSION, form={})
    document["splits"]["train"]["start_q"]["mean"][0] += 1e-9
    save_document(damaged / STATS, document)
    (finding,) = check_statistics(damaged, blueprint)
    assert (finding.file, finding.problem) == (STATS, "does not sum up the shards' records: splits differ")
    report = validate_dataset(damaged, deep=True, workers=1)
    assert finding in report.findings
    finalize(damaged, blueprint)
    assert validate_dataset(damaged, deep=True, workers=1).findings == ()
