"""``cnpgen publish``: the repository, what is refused, and the upload with a replaced client."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.publish import publish_dataset

RECIPE = """
name = "hits"
pipeline = "airhockey-hit"
{keys}
[splits]
train = 40
validation = 10
"""
KEYS = 'license = "MIT"\ncreator = "A. Author"\ncitation = "@misc{hits}"\n'


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("publish")
    (folder / "hits.toml").write_text(RECIPE.format(keys=KEYS))
    (folder / "hits.md").write_text("Notes of the author.")
    return make_dataset(folder / "hits.toml", folder / "hits", workers=1, shard_size=4096).folder


@pytest.mark.slow
def test_a_dry_run_writes_card_tables_and_dataset(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "repository"
    assert main(["publish", str(dataset), "--to", "lab/hits", "--dry-run", "-o", str(out)]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    table = parquet.read_table(out / "parquet" / "train" / "00000.parquet")
    rows = cnpgen.load_dataset(dataset).arrays("train", fields=["start_q", "hit_speed"])
    assert np.array_equal(np.array(table["start_q"].to_pylist()), rows["start_q"])
    assert np.array_equal(table["hit_speed"].to_numpy(), rows["hit_speed"])
    unit = table.schema.field("start_q").metadata
    assert unit[b"unit"] == b"rad"
    assert tuple(json.loads(unit[b"names"])) == cnpgen.load_dataset(dataset).fields["start_q"].names
    assert cnpgen.validate_dataset(out / "hdf5").ok
    card = (out / "README.md").read_text()
    for text in ('license: "mit"', 'path: "parquet/train/*.parquet"', "Made by A. Author.", "@misc{hits}",
                 "Notes of the author.", 'load_dataset("lab/hits")', 'f"hdf5/{split}/shard'):  # fmt: skip
        assert text in card, text
    before = (out / "parquet" / "train" / "00000.parquet").stat().st_mtime_ns
    assert main(["publish", str(dataset), "--to", "lab/hits", "--dry-run", "-o", str(out)]) == 0
    assert (out / "parquet" / "train" / "00000.parquet").stat().st_mtime_ns == before


@pytest.mark.slow
def test_files_of_an_earlier_state_are_removed_and_others_kept(dataset: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    old = ["parquet/train/00007.parquet", "parquet/gone/00000.parquet", "hdf5/train/shard-00007.h5"]
    old += ["hdf5/gone/shard-00000.h5", "hdf5/gone/shard-00000.json"]
    own = ["parquet/train/notes.txt", "hdf5/gone/notes.md", "figures/train/00007.parquet"]
    for name in old + own:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("earlier")
    publish_dataset(dataset, "lab/hits", out=tmp_path, dry_run=True)
    assert not [name for name in old if (tmp_path / name).exists()]
    assert all((tmp_path / name).exists() for name in own)
    assert not (tmp_path / "parquet" / "gone").exists()
    assert (tmp_path / "hdf5" / "train" / "shard-00000.h5").exists()


@pytest.mark.parametrize("inside", [".", "hub", "train/hub"])
def test_a_repository_inside_the_dataset_is_refused(inside: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="out must be a folder outside the dataset"):
        publish_dataset(tmp_path, "lab/hits", out=tmp_path / inside, dry_run=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_repository_is_created_and_uploaded(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pyarrow")
    calls: list[tuple[str, Any]] = []

    class Api:
        def __init__(self, **_: Any) -> None:
            self.fails = False

        def create_repo(self, name: str, **options: Any) -> str:
            calls.append((name, options))
            return f"https://hub.example.org/{name}"

        def upload_large_folder(self, **options: Any) -> None:
            calls.append(("upload", options))
            if len(calls) > 2:
                raise OSError("connection lost")

    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(HfApi=Api))
    arguments = ["publish", str(dataset), "--to", "lab/hits", "--private", "-o", str(tmp_path / "out")]
    assert main(arguments) == 0
    assert capsys.readouterr().out.strip() == "https://hub.example.org/lab/hits"
    assert calls[0] == ("lab/hits", {"repo_type": "dataset", "private": True, "exist_ok": True})
    assert calls[1][1]["folder_path"] == tmp_path / "out"
    assert main(arguments) == 3
    assert "lab/hits was not uploaded: connection lost" in capsys.readouterr().err


def test_a_dataset_without_a_license_and_a_wrong_name_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "hits.toml").write_text(RECIPE.format(keys=""))
    folder = make_dataset(tmp_path / "hits.toml", tmp_path / "hits", workers=1).folder
    assert "license" not in (folder / "README.md").read_text().partition("---\n# ")[0]
    assert main(["publish", str(folder), "--to", "lab/hits", "--dry-run"]) == 2
    assert "has no license: add license" in capsys.readouterr().err
    assert main(["publish", str(folder), "--to", "hits", "--dry-run"]) == 2
    assert "--to must be the name of a repository, USER/NAME, got 'hits'" in capsys.readouterr().err
