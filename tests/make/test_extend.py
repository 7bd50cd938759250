"""Datasets that grow: the rows of a larger one beside shards that are not touched."""

import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.make import extend as extend_module
from cnpgen.make import recipe as load_module
from cnpgen.make.extend import extend_dataset
from cnpgen.store.dataset_spec import load_dataset_spec, shards
from cnpgen.store.inspection import inspect_dataset
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import columns_of
from tests.examples.tiny_datasets import digests, flip, make_tiny, snapshot
from tests.refusals import assert_said, is_refused

ROWS = 1320  # train 1200, validation 120


def times(folder: Path) -> dict[str, int]:
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns
        for path in folder.glob("*/shard-*")
    }


@pytest.fixture(scope="module")
def at_once(tmp_path_factory) -> Path:
    return make_tiny(tmp_path_factory.mktemp("at-once") / "out", n=ROWS).folder


@pytest.fixture(scope="module")
def grown(tmp_path_factory, tiny) -> Path:
    """A dataset that was extended once; not to be changed."""
    folder = tmp_path_factory.mktemp("grown") / "airhockey-hit"
    shutil.copytree(tiny("airhockey-hit"), folder)
    extend_dataset(folder, ROWS, workers=1)
    return folder


def test_an_extended_dataset_has_the_rows_of_one_made_at_once_beside_shards_that_stay(
    damaged, at_once
):
    before, content = times(damaged), snapshot(damaged)
    made = cnpgen.extend_dataset(damaged, ROWS, workers=1)
    assert made.complete
    assert (made.made, made.rows) == (660, {"train": 1200, "validation": 120})
    after = times(damaged)
    assert {name: after[name] for name in before} == before
    assert {name: (damaged / name).read_bytes() for name in before} == {
        name: content[name] for name in before
    }
    tasks = [
        task for task in shards(load_dataset_spec(damaged)) if task.split == "train"
    ]
    assert [(task.first_row, task.rows) for task in tasks] == [
        (0, 250),
        (250, 250),
        (500, 100),  # the short last shard of before
        (600, 150),
        (750, 250),
        (1000, 200),
    ]
    for split in ("train", "validation"):
        larger = columns_of(at_once, split)
        for name, values in columns_of(damaged, split).items():
            np.testing.assert_array_equal(values, larger[name])


@pytest.mark.slow
def test_it_is_proven_like_any_other_and_its_documents_are_of_all_rows(grown, at_once):
    report = validate_dataset(grown, deep=True, regenerate=10)
    assert report.ok, report.findings
    assert (report.rows, report.identical, report.blocks) == (
        ROWS,
        report.regenerated,
        8,
    )
    found, expected = inspect_dataset(grown), inspect_dataset(at_once)
    assert found.state == "complete"
    assert found.sampling.to_json()["tried"] == expected.sampling.to_json()["tried"]
    assert found.sampling.rejections == expected.sampling.rejections
    for name, statistics in found.statistics.items():
        np.testing.assert_allclose(
            statistics.mean, expected.statistics[name].mean, rtol=1e-12, atol=1e-15
        )
        np.testing.assert_array_equal(
            statistics.minimum, expected.statistics[name].minimum
        )


def test_it_is_loaded_like_any_other(grown, at_once):
    rows = {
        name: cnpgen.load_dataset(folder).arrays("train")
        for name, folder in (("a", grown), ("b", at_once))
    }
    for name, values in rows["a"].items():
        np.testing.assert_array_equal(values, rows["b"][name])
    batch = next(iter(cnpgen.load_dataset(grown).batches(64, seed=0)))
    assert len(batch["start_q"]) == 64
    problems = cnpgen.load_boundary_problems(grown / "train" / "shard-00000.h5")
    assert len(problems) == 250


def test_the_notes_in_its_card_stay(tiny, grown):
    card = (grown / "README.md").read_text(encoding="utf-8")
    before = (tiny("airhockey-hit") / "README.md").read_text(encoding="utf-8")
    notes = before[
        before.index("| `validation`") : before.index("## How it was made")
    ].partition("\n")[2]
    assert len(notes) > 100
    assert notes in card
    assert "| `train` | 1,200 | 6 |" in card


@pytest.mark.parametrize("what", ["a pipe", "a link to a private file", "too large"])
def test_a_card_that_is_no_card_gives_no_notes(tiny, tmp_path, what):
    folder, card, private = (
        tmp_path / "set",
        tmp_path / "set" / "README.md",
        tmp_path / "private",
    )
    shutil.copytree(tiny("airhockey-hit"), folder)
    text = card.read_text(encoding="utf-8")
    before = text[text.index("## How it was made") :]
    secret = text.replace(before, f"a secret\n\n{before}")
    card.unlink()
    if what == "a pipe":
        os.mkfifo(card)
    elif what == "too large":
        card.write_text(
            secret.replace("a secret", "a secret " * 200_000), encoding="utf-8"
        )
    else:
        private.write_text(secret, encoding="utf-8")
        card.symlink_to(private)
    extend_dataset(folder, ROWS, workers=1)
    assert "a secret" not in card.read_text(encoding="utf-8")


def test_the_same_call_again_and_the_recipe_of_that_size_leave_it_as_it_is(grown):
    before = snapshot(grown)
    assert extend_dataset(grown, ROWS).made == 0
    again = make_tiny(grown, n=ROWS)
    assert (again.complete, again.made) == (True, 0)
    assert snapshot(grown) == before


@pytest.mark.slow
def test_it_can_be_extended_again_and_damaged_shards_of_any_age_are_made_again(
    grown, tmp_path
):
    folder = shutil.copytree(grown, tmp_path / "airhockey-hit")
    assert extend_dataset(folder, 1500, workers=1).complete
    before = digests(folder)
    for name in (
        "train/shard-00000.h5",
        "train/shard-00003.h5",
        "train/shard-00006.h5",
    ):
        flip(folder / name)
    with pytest.warns(RuntimeWarning, match="3 shards are damaged and are made again"):
        assert make_tiny(folder, n=1500).complete
    assert digests(folder) == before
    assert validate_dataset(folder, deep=True).ok
    larger = make_tiny(tmp_path / "larger", n=1500).folder
    np.testing.assert_array_equal(
        columns_of(folder)["start_q"], columns_of(larger)["start_q"]
    )


def test_an_extension_that_is_cut_off_goes_on(damaged, grown):
    class Enough(Exception):
        pass

    def stop(_rows: int, sampling: object) -> None:
        if sampling is not None:
            raise Enough

    with pytest.raises(Enough):
        extend_dataset(damaged, ROWS, workers=1, progress=stop)
    assert not (damaged / "manifest.json").exists()
    with is_refused(UsageError):
        extend_dataset(damaged, 2 * ROWS)
    assert extend_dataset(damaged, ROWS).complete
    assert digests(damaged) == digests(grown)
    assert (damaged / "README.md").read_bytes() == (grown / "README.md").read_bytes()


def test_a_run_that_ends_before_the_new_specification_is_written_loses_no_data(
    damaged, grown, monkeypatch
):
    monkeypatch.setattr(extend_module, "write_dataset_spec", None)
    with pytest.raises(TypeError):
        extend_dataset(damaged, ROWS)
    monkeypatch.undo()
    assert extend_dataset(damaged, ROWS).complete
    assert digests(damaged) == digests(grown)


@pytest.mark.slow
def test_splits_that_were_too_small_to_be_there_appear(tmp_path):
    folder = make_tiny(tmp_path / "out", n=5).folder
    assert load_dataset_spec(folder).splits == {"train": 5}
    extend_dataset(folder, 44, workers=1)
    assert load_dataset_spec(folder).splits == {"train": 40, "validation": 4}
    assert validate_dataset(folder, deep=True, regenerate=3).ok


def test_what_cannot_be_extended_is_refused_and_left_as_it_is(
    damaged, tmp_path, monkeypatch
):
    before = snapshot(damaged)
    for n, text in (
        (659, "has 660 rows: choose a larger n=, got 659"),
        (0, "n must be an integer from 1 to"),
    ):
        with pytest.raises(UsageError, match=text):
            extend_dataset(damaged, n)
    with is_refused(UsageError, argument="folder"):
        extend_dataset(tmp_path / "nothing", 1000)
    (tmp_path / "empty").mkdir()
    with is_refused(UsageError, argument="folder"):
        extend_dataset(tmp_path / "empty", 1000)
    monkeypatch.setattr(load_module, "GENERATOR_REVISION", 3)
    with is_refused(UsageError):
        extend_dataset(damaged, ROWS)
    assert snapshot(damaged) == before


def test_a_specification_with_smaller_splits_raises_an_error(tiny):
    spec = load_dataset_spec(tiny("airhockey-hit"))
    text = re.escape(
        "the splits of a dataset must not shrink: they had {'train': 700}, then"
    )
    with pytest.raises(UsageError, match=text):
        replace(spec, previous_splits=({"train": 700},))


def test_the_command_says_what_it_did(damaged, capsys):
    assert main(["extend", str(damaged), "--n", "700", "--workers", "1"]) == 0
    said = capsys.readouterr()
    assert said.out == f"{damaged}\n"
    assert "made the missing 40 of 700 rows (train 637, validation 63)" in said.err
    assert main(["extend", str(damaged), "--n", "10"]) == 2
    assert_said(capsys.readouterr().err)
