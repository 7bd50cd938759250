"""``cnpgen publish``: the repository, what is refused, and the upload with a replaced client."""

import hashlib
import json
import re
import sys
import warnings
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import create_autospec

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.hub.card_problem import limits_table, what_samples_prove
from cnpgen.addons.hub.publish import publish_dataset, upload_files
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.make.make_dataset import make_dataset
from cnpgen.store.field import Field
from cnpgen.store.files.written_files import LIST
from tests.examples.store import SPEC
from tests.refusals import assert_said, is_refused

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
    return make_dataset(
        folder / "hits.toml", folder / "hits", workers=1, shard_size=4096
    ).folder


@pytest.mark.slow
def test_a_dry_run_writes_card_tables_and_dataset(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "repository"
    assert (
        main(["publish", str(dataset), "--to", "lab/hits", "--dry-run", "-o", str(out)])
        == 0
    )
    assert capsys.readouterr().out.strip() == str(out)
    table = parquet.read_table(out / "parquet" / "train" / "00000.parquet")
    rows = cnpgen.load_dataset(dataset).arrays("train", fields=["start_q", "hit_speed"])
    assert np.array_equal(np.array(table["start_q"].to_pylist()), rows["start_q"])
    assert np.array_equal(table["hit_speed"].to_numpy(), rows["hit_speed"])
    unit = table.schema.field("start_q").metadata
    assert unit[b"unit"] == b"rad"
    assert (
        tuple(json.loads(unit[b"names"]))
        == cnpgen.load_dataset(dataset).fields["start_q"].names
    )
    assert cnpgen.validate_dataset(out / "hdf5").ok
    card = (out / "README.md").read_text()
    for text in ('license: "mit"', 'path: "parquet/train/*.parquet"', "Made by A. Author.", "@misc{hits}",
                 "Notes of the author.", 'load_dataset("lab/hits")', 'f"hdf5/{split}/shard',
                 'cnpgen.load_dataset("hf://datasets/lab/hits@main")', "](picture.png)"):  # fmt: skip
        assert text in card, text
    assert (out / "picture.png").read_bytes().startswith(b"\x89PNG")
    before = (out / "parquet" / "train" / "00000.parquet").stat().st_mtime_ns
    assert (
        main(["publish", str(dataset), "--to", "lab/hits", "--dry-run", "-o", str(out)])
        == 0
    )
    assert (out / "parquet" / "train" / "00000.parquet").stat().st_mtime_ns == before


def test_the_card_states_limits_constraints_frame_date_and_what_a_sample_proves(
    dataset: Path,
) -> None:
    card = (dataset / "README.md").read_text()
    robot = cnpgen.load_dataset(dataset).spec.robot
    for name, limit in zip(
        robot["joint_names"], robot["limits"]["velocity_limit"], strict=True
    ):
        assert re.search(rf"\| `{name}` \|.* \| {limit:.5g} rad/s \|", card)
    assert "| `table` | tolerance 0.001, x [0.6, 2], y [-0.45, 0.45]" in card
    assert "- torque: rigid body\n" in card
    assert "- frame: positions in the frame `world`, tip link `striker_tip`" in card
    created = json.loads((dataset / "manifest.json").read_text())["created"]
    assert f"- date: {created[:10]}" in card
    assert "does not prove that a valid motion connects" in card
    assert "picture.png" not in card  # only a published repository has the file


def test_a_card_of_certified_samples_claims_a_plan() -> None:
    spec = replace(SPEC, recipe={"pipeline": {"stage": [{"use": "certified-plan"}]}})
    assert "Every sample has a plan" in what_samples_prove(spec)
    assert "does not prove that a valid motion" not in what_samples_prove(spec)


def test_limits_of_sliding_joints_are_in_meters() -> None:
    fields = [Field("start_q", "rad, m", "positions", 2, ("turn", "slide"))]
    keys = ["position_lower", "position_upper", "velocity_limit"]
    keys += ["acceleration_limit", "torque_limit"]
    limits = {key: [1.0, 2.0] for key in keys}
    robot = {"joint_names": ["turn", "slide"], "limits": limits}
    table = limits_table(replace(SPEC, fields=tuple(fields), robot=robot))
    assert "| `slide` | 2 ... 2 m | 2 m/s | 2 m/s^2 | 2 N |" in table


def test_croissant_has_creator_citation_record_sets_and_components_before_publishing(
    dataset: Path,
) -> None:
    croissant = json.loads((dataset / "croissant.json").read_text())
    assert croissant["creator"]["name"] == "A. Author"
    assert croissant["citeAs"] == "@misc{hits}"
    assert [item["name"] for item in croissant["recordSet"]] == ["train", "validation"]
    names = {item["@id"] for item in croissant["distribution"]}
    fields = cnpgen.load_dataset(dataset).spec.fields
    for records in croissant["recordSet"]:
        assert [item["name"] for item in records["field"]] == [f.name for f in fields]
        assert {item["source"]["fileSet"]["@id"] for item in records["field"]} <= names
    measured = {item["name"]: item for item in croissant["variableMeasured"]}
    field = cnpgen.load_dataset(dataset).fields["start_xyz"]
    assert field.valid_min is not None
    assert field.valid_max is not None
    for name, low, high in zip("xyz", field.valid_min, field.valid_max, strict=True):
        item = measured[f"start_xyz.{name}"]
        assert (item["minValue"], item["maxValue"]) == (low, high)
        assert item["unitText"] == "m"


@pytest.mark.slow
def test_croissant_describes_the_columns_of_all_tables(
    dataset: Path, tmp_path: Path
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    publish_dataset(dataset, "lab/hits", out=tmp_path, dry_run=True)
    assert not (tmp_path / "hdf5" / "croissant.json").exists()
    croissant = json.loads((tmp_path / "croissant.json").read_text())
    files = {
        item["@id"]: item
        for item in croissant["distribution"]
        if item["@type"] == "cr:FileObject"
    }
    for path, item in files.items():
        assert (
            item["sha256"] == hashlib.sha256((tmp_path / path).read_bytes()).hexdigest()
        )
    sets = {
        item["@id"]: item
        for item in croissant["distribution"]
        if item["@type"] == "cr:FileSet"
    }
    assert [item["name"] for item in croissant["recordSet"]] == ["train", "validation"]
    for records in croissant["recordSet"]:
        for field in records["field"]:
            contained = sets[field["source"]["fileSet"]["@id"]]["containedIn"]
            for name in (item["@id"] for item in contained):
                assert name.startswith(f"parquet/{records['name']}/")
                column = parquet.read_schema(tmp_path / name).field(
                    field["source"]["extract"]["column"]
                )
                width = getattr(column.type, "list_size", None)
                assert field.get("arrayShape") == (
                    None if width is None else str(width)
                )


@pytest.mark.extended
def test_mlcroissant_iterates_the_record_sets(dataset: Path, tmp_path: Path) -> None:
    mlcroissant = pytest.importorskip("mlcroissant")
    publish_dataset(dataset, "lab/hits", out=tmp_path, dry_run=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of mlcroissant's libraries
        opened = mlcroissant.Dataset(tmp_path / "croissant.json")
        for split, count in (("train", 40), ("validation", 10)):
            records = list(opened.records(split))
            assert len(records) == count
            names = ["sample_id", "start_q", "hit_speed"]
            rows = cnpgen.load_dataset(dataset).arrays(split, fields=names)
            for name in names:
                found = np.array([record[f"{split}/{name}"] for record in records])
                np.testing.assert_array_equal(found, rows[name])


@pytest.mark.slow
def test_files_of_an_earlier_state_are_removed_and_others_refused_by_name(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pyarrow")
    private, card = tmp_path / ".env", tmp_path / "README.md"
    private.write_text("KEY=1")
    card.write_text("mine")
    arguments = ["publish", str(dataset), "--to", "lab/hits", "--dry-run"]
    arguments += ["-o", str(tmp_path)]
    assert main(arguments) == 2
    message = capsys.readouterr().err
    assert "that were edited since: .env, README.md; choose another" in message
    assert "or --force" in message
    assert card.read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == [".env", "README.md"]
    assert main([*arguments, "--force"]) == 0
    assert private.read_text() == "KEY=1"
    assert card.read_text() != "mine"
    private.unlink()
    listing = json.loads((tmp_path / LIST).read_text())
    stale = ["parquet/gone/00007.parquet", "hdf5/train/shard-00007.h5"]
    for name in stale:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("earlier")
        listing["files"][name] = ""
    (tmp_path / LIST).write_text(json.dumps(listing))
    assert main(arguments) == 0
    assert not [name for name in stale if (tmp_path / name).exists()]
    assert not (tmp_path / "parquet" / "gone").exists()
    assert (tmp_path / "hdf5" / "train" / "shard-00000.h5").exists()
    card.write_text("edited since")
    assert main(arguments) == 2
    assert_said(capsys.readouterr().err)


@pytest.mark.parametrize("inside", [".", "hub", "train/hub"])
def test_a_repository_inside_the_dataset_is_refused(
    inside: str, tmp_path: Path
) -> None:
    with is_refused(UsageError, argument="out"):
        publish_dataset(tmp_path, "lab/hits", out=tmp_path / inside, dry_run=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_repository_is_created_and_uploaded(
    dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("pyarrow")
    calls: list[tuple[str, Any]] = []
    stale = {
        "parquet/train/00009.parquet",
        "hdf5/train/shard-00009.h5",
        "hdf5/gone/shard-00000.json",
    }
    others = {".gitattributes", "figures/one.png"}
    remote = {*stale, *others}

    class Api:
        def __init__(self, **_: Any) -> None:
            self.fails = False

        def create_repo(self, name: str, **options: Any) -> str:
            calls.append((name, options))
            return f"https://hub.example.org/{name}"

        def upload_folder(self, **options: Any) -> None:
            calls.append(("upload", options))
            if len(calls) > 2:
                raise OSError("connection lost")
            patterns, local = options["delete_patterns"], Path(options["folder_path"])
            matching = {
                name
                for name in remote
                for pattern in patterns
                if fnmatch(name, pattern)
            }
            present = {
                name
                for path in local.rglob("*")
                if path.is_file()
                for name in [path.relative_to(local).as_posix()]
                if any(fnmatch(name, each) for each in options["allow_patterns"])
            }
            remote.difference_update(matching - present)
            remote.update(present)

    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(HfApi=Api))
    arguments = [
        "publish",
        str(dataset),
        "--to",
        "lab/hits",
        "--private",
        "-o",
        str(tmp_path / "out"),
    ]
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "id_rsa").write_text("private")
    arguments.append("--force")
    assert main(arguments) == 0
    assert capsys.readouterr().out.strip() == "https://hub.example.org/lab/hits"
    assert calls[0] == (
        "lab/hits",
        {"repo_type": "dataset", "private": True, "exist_ok": True},
    )
    assert calls[1][1]["folder_path"] == tmp_path / "out"
    assert remote & {*stale, *others} == others
    assert not {"id_rsa", LIST} & remote
    assert {
        "README.md",
        "parquet/train/00000.parquet",
        "hdf5/train/shard-00000.h5",
    } <= remote
    assert main(arguments) == 3
    assert_said(capsys.readouterr().err)


def test_the_client_accepts_the_arguments(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    huggingface_hub = pytest.importorskip("huggingface_hub")
    calls = []
    for name in ("create_repo", "upload_folder"):
        function = create_autospec(getattr(huggingface_hub.HfApi, name))
        function.side_effect = lambda *_, **options: (
            calls.append(options) or "https://hub.example.org/lab/hits"
        )
        monkeypatch.setattr(huggingface_hub.HfApi, name, function)
    assert (
        upload_files(tmp_path, ["README.md"], "lab/hits", private=True)
        == "https://hub.example.org/lab/hits"
    )
    assert [options["repo_type"] for options in calls] == ["dataset", "dataset"]


def test_a_dataset_without_a_license_and_a_wrong_name_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "hits.toml").write_text(RECIPE.format(keys=""))
    folder = make_dataset(tmp_path / "hits.toml", tmp_path / "hits", workers=1).folder
    assert "license" not in (folder / "README.md").read_text().partition("---\n# ")[0]
    assert main(["publish", str(folder), "--to", "lab/hits", "--dry-run"]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["publish", str(folder), "--to", "hits", "--dry-run"]) == 2
    assert_said(capsys.readouterr().err)
