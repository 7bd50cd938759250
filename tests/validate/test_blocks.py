"""What is said of blocks that come out differently when they are made again."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.store.blueprint import REVISION, load_blueprint, shards
from cnpgen.validate import blocks
from cnpgen.validate.blocks import Regeneration, make_again


@pytest.fixture
def different(damaged: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset whose draws another version would solve differently."""
    real = blocks.shard_columns

    def shard_columns(*arguments):
        for columns, fates in real(*arguments):
            yield {**columns, "start_q": columns["start_q"] + 1e-3}, fates

    monkeypatch.setattr(blocks, "shard_columns", shard_columns)
    return damaged


def problem_of(folder: Path) -> str:
    plan = load_blueprint(folder)
    found = make_again(folder, plan, shards(plan)[:1], 3)
    assert (found.made, found.blocks, found.identical) == (1, 1, 0)
    (finding,) = found.findings
    return finding.problem


def test_what_differs_is_named_and_by_how_much(different):
    assert problem_of(different) == "block 0 made again from the seed: start_q differs by 0.001"


def test_another_revision_of_the_generator_is_an_explanation(different, monkeypatch):
    monkeypatch.setattr(blocks, "REVISION", REVISION + 1)
    expected = f"(made with other versions: revision of the generator {REVISION} -> {REVISION + 1})"
    assert problem_of(different).endswith(expected)


def test_other_libraries_are_an_explanation(different, monkeypatch):
    monkeypatch.setattr(blocks, "versions", lambda: {**load_blueprint(different).versions, "numpy": "0.1"})
    assert problem_of(different).endswith(f"numpy {np.__version__} -> 0.1)")


def test_the_same_code_makes_the_same_bits(damaged):
    plan = load_blueprint(damaged)
    assert make_again(damaged, plan, shards(plan), 2) == Regeneration(made=2, blocks=4, identical=2)
