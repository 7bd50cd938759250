"""Parts of a dataset from separate folders: one dataset of the same bytes, or a refusal by name."""

import os
import re
import shutil
from pathlib import Path

import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.make.merge import merge_datasets
from cnpgen.store.files import atomic
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import some
from tests.examples.tiny_datasets import SHARDS, digests, flip, make_tiny, snapshot
from tests.refusals import is_refused


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> list[Path]:
    """Three parts of a dataset of four shards; not to be changed."""
    folder = tmp_path_factory.mktemp("parts")
    return [make_tiny(folder / f"part{k}", part=(k, 3)).folder for k in range(3)]


@pytest.fixture
def parts(made, tmp_path) -> list[Path]:
    return [shutil.copytree(folder, tmp_path / folder.name) for folder in made]


def test_parts_become_the_dataset_that_was_made_at_once(tiny, made, tmp_path):
    before, said = [snapshot(part) for part in made], []
    merged = cnpgen.merge_datasets(
        made,
        tmp_path / "out",
        begin=lambda *x: said.append(x),
        progress=lambda *x: said.append(x),
    )
    assert merged.complete
    assert merged.rows == {"train": 600, "validation": 60}
    assert merged.made == 660
    assert said == [
        ("merging", tmp_path / "out", 660, 0),
        (250, None),
        (250, None),
        (100, None),
        (60, None),
    ]
    assert digests(tmp_path / "out") == digests(tiny("airhockey-hit"))
    assert [snapshot(part) for part in made] == before
    assert validate_dataset(tmp_path / "out", deep=True, regenerate=2).ok
    assert not (tmp_path / "out" / "_work").exists()
    for name in ("specification.json", "stats.json"):
        assert (tmp_path / "out" / name).read_bytes() == (
            tiny("airhockey-hit") / name
        ).read_bytes()


def test_the_card_has_the_notes_of_the_shipped_recipe(tiny, made, tmp_path):
    merge_datasets(made, tmp_path / "airhockey-hit")
    assert (tmp_path / "airhockey-hit" / "README.md").read_bytes() == (
        tiny("airhockey-hit") / "README.md"
    ).read_bytes()


def test_a_merged_dataset_is_left_as_it_is(made, tmp_path):
    merge_datasets(made, tmp_path / "out")
    before = snapshot(tmp_path / "out")
    again = merge_datasets(made, tmp_path / "out")
    assert (again.complete, again.made, again.repaired) == (True, 0, ())
    assert snapshot(tmp_path / "out") == before


def test_one_of_the_parts_may_be_where_the_others_go(tiny, parts, tmp_path):
    assert merge_datasets(parts, parts[1]).complete
    assert digests(parts[1]) == digests(tiny("airhockey-hit"))


def test_a_merge_that_is_cut_off_goes_on(tiny, made, tmp_path, monkeypatch):
    copied: list[Path] = []

    def full(path: Path) -> None:
        copied.append(path)
        if len(copied) == 9:
            raise OSError(28, os.strerror(28))

    monkeypatch.setattr(atomic, "_synchronize", full)
    with is_refused(MachineError):
        merge_datasets(made, tmp_path / "out")
    monkeypatch.undo()
    assert 1 <= len(digests(tmp_path / "out")) < SHARDS
    assert not (tmp_path / "out" / "manifest.json").exists()
    assert merge_datasets(made, tmp_path / "out").complete
    assert digests(tmp_path / "out") == digests(tiny("airhockey-hit"))


def refused(parts: list[Path], out: Path, error: type[Exception], text: str) -> None:
    before = [snapshot(part) for part in parts]
    with pytest.raises(error, match=re.escape(text)):
        merge_datasets(parts, out)
    assert [snapshot(part) for part in parts] == before
    assert not digests(out)


def test_gaps_overlaps_and_damage_are_refused_by_name(parts, tmp_path):
    out = tmp_path / "out"
    refused(
        parts[:1],
        out,
        DatasetError,
        "no part has train/shard-00001.h5, train/shard-00002.h5, validation/shard-0",
    )
    refused(
        parts[1:],
        out,
        DatasetError,
        "no part has train/shard-00000.h5: make the missing shards first",
    )
    twice = shutil.copytree(parts[0], tmp_path / "twice")
    text = (
        f"{parts[0]} and {twice} both have train/shard-00000.h5: parts must not overlap"
    )
    refused([*parts, twice], out, UsageError, text)
    flip(parts[0] / "train" / "shard-00000.h5")
    text = f"{parts[0]}/train/shard-00000.h5 was changed: its sha256 is not the recorded one"
    refused(parts, out, DatasetError, text)


@pytest.mark.parametrize(
    ("options", "text"),
    some(
        [
            ({"seed": 3}, "seed 3 instead of 2026"),
            ({"dtype": "float32"}, "dtype float32 instead of float64"),
            ({"name": "airhockey-replan"}, "another recipe"),
            (
                {"n": 700},
                "{'train': 637, 'validation': 63} rows instead of {'train': 600, 'validation': 60}",
            ),
        ],
        1,
        "slow",
    ),
)
def test_a_part_of_another_dataset_is_refused_by_name(made, tmp_path, options, text):
    other = make_tiny(tmp_path / "other", part=(2, 3), **options).folder
    with pytest.raises(
        UsageError, match=re.escape(f"{other} is of another dataset than {made[0]}: ")
    ) as caught:
        merge_datasets([*made[:2], other], tmp_path / "out")
    assert text in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_places_that_hold_no_dataset_or_another_one_are_refused(made, tmp_path):
    (tmp_path / "empty").mkdir()
    with is_refused(UsageError, argument="parts"):
        merge_datasets([*made, tmp_path / "empty"], tmp_path / "out")
    with is_refused(UsageError, argument="parts"):
        merge_datasets([tmp_path / "nothing"], tmp_path / "out")
    with is_refused(UsageError, argument="parts"):
        merge_datasets([], tmp_path / "out")
    make_tiny(tmp_path / "out", seed=3)
    before = snapshot(tmp_path / "out")
    with is_refused(UsageError, argument="out"):
        merge_datasets(made, tmp_path / "out")
    assert snapshot(tmp_path / "out") == before


def test_the_command_says_what_it_did(made, tmp_path, capsys):
    assert main(["merge", *map(str, made), "-o", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert said.out == f"{tmp_path / 'out'}\n"
    assert "merged 660 rows (train 600, validation 60)" in said.err
    assert main(["merge", *map(str, made), "-o", str(tmp_path / "out")]) == 0
    assert "already complete: 660 rows" in capsys.readouterr().err
    assert main(["merge", *map(str, made[1:]), "-o", str(tmp_path / "other")]) == 1
    assert "no part has train/shard-00000.h5" in capsys.readouterr().err
