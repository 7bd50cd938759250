"""Contradicting documents with valid checksums are found."""

import json
from dataclasses import replace

import pytest

from cnpgen.store.dataset_spec import load_dataset_spec
from cnpgen.store.dataset_summary import STATS_FORMAT, STATS_VERSION
from cnpgen.store.files.documents import load_document, save_document
from cnpgen.store.layout import STATS
from cnpgen.validate.validate_dataset import (
    check_recipe,
    check_statistics,
    validate_dataset,
)
from tests.examples.finalized import finalize


def test_the_recipe_in_a_specification_must_have_the_recorded_digest(damaged):
    spec = load_dataset_spec(damaged)
    assert check_recipe(spec) == []
    changed = json.loads(json.dumps(spec.recipe))
    changed["pipeline"]["stage"][0]["min_distance"] = 0.11
    (finding,) = check_recipe(replace(spec, recipe=changed))
    assert finding.file == "specification.json"
    assert spec.recipe_sha256 in finding.problem
    (finding,) = check_recipe(
        replace(spec, robot={**spec.robot, "urdf": spec.robot["urdf"] + " "})
    )
    assert "not the recorded" in finding.problem
    retitled = json.loads(json.dumps(spec.recipe))
    retitled["pipeline"]["title"] = "Another title"
    assert check_recipe(replace(spec, recipe=retitled)) == []


@pytest.mark.parametrize("recipe", [{}, {"pipeline": 3}, {"pipeline": {"problem": {}}}])
def test_a_specification_without_a_recipe_is_a_finding(damaged, recipe):
    (finding,) = check_recipe(replace(load_dataset_spec(damaged), recipe=recipe))
    assert "its recipe cannot be read" in finding.problem


def test_statistics_must_equal_the_summary_of_the_records(damaged):
    spec = load_dataset_spec(damaged)
    assert check_statistics(damaged, spec) == []
    document = load_document(
        damaged / STATS, STATS_FORMAT, version=STATS_VERSION, structure={}
    )
    document["splits"]["train"]["start_q"]["mean"][0] += 1e-9
    save_document(damaged / STATS, document)
    (finding,) = check_statistics(damaged, spec)
    assert (finding.file, finding.problem) == (
        STATS,
        "is not the summary of the records of the shards: splits differ",
    )
    report = validate_dataset(damaged, deep=True, workers=1)
    assert finding in report.findings
    finalize(damaged, spec)
    assert validate_dataset(damaged, deep=True, workers=1).findings == ()
