"""Findings on blocks that differ after their regeneration."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.store.dataset_spec import GENERATOR_REVISION, load_dataset_spec, shards
from cnpgen.validate import validate_dataset
from cnpgen.validate.validate_dataset import Regeneration, regenerate_blocks


@pytest.fixture
def different(damaged: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset that another version would compute differently."""
    real = validate_dataset.shard_columns

    def shard_columns(*arguments):
        for columns, sampling, scenes in real(*arguments):
            yield {**columns, "start_q": columns["start_q"] + 1e-3}, sampling, scenes

    monkeypatch.setattr(validate_dataset, "shard_columns", shard_columns)
    return damaged


def problem_of(folder: Path) -> str:
    spec = load_dataset_spec(folder)
    found = regenerate_blocks(folder, spec, shards(spec)[:1], 3)
    assert (found.made, found.blocks, found.identical) == (1, 1, 0)
    (finding,) = found.findings
    return finding.problem


def test_the_field_and_the_size_of_a_difference_are_named(different):
    assert (
        problem_of(different)
        == "block 0 made again from the seed: start_q differs by 0.001"
    )


def test_another_revision_of_the_generator_is_an_explanation(different, monkeypatch):
    monkeypatch.setattr(validate_dataset, "GENERATOR_REVISION", GENERATOR_REVISION + 1)
    expected = f"(made with other versions: revision of the generator {GENERATOR_REVISION} -> {GENERATOR_REVISION + 1})"
    assert problem_of(different).endswith(expected)


def test_other_libraries_are_an_explanation(different, monkeypatch):
    monkeypatch.setattr(
        validate_dataset,
        "versions",
        lambda: {**load_dataset_spec(different).versions, "numpy": "0.1"},
    )
    assert problem_of(different).endswith(f"numpy {np.__version__} -> 0.1)")


def test_the_same_code_gives_identical_blocks(damaged):
    spec = load_dataset_spec(damaged)
    assert regenerate_blocks(damaged, spec, shards(spec), 2) == Regeneration(
        made=2, blocks=4, identical=2
    )
