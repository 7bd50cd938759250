"""Links that lead out of a dataset: validate reports them, merge and all writers refuse them."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from cnpgen.errors import DatasetError, UsageError
from cnpgen.make.extend import extend_dataset
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.merge import merge_datasets
from cnpgen.store.layout import DOCUMENTS, WORK
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import tiny_recipe
from tests.refusals import is_refused

SHARD = "train/shard-00001.h5"
FILES = (*DOCUMENTS, SHARD, "train/shard-00001.json", "train", WORK)


def linked(folder: Path, name: str, outside: Path) -> None:
    """Replace a file or a folder of a dataset by a link to a copy elsewhere."""
    if name == WORK:
        outside.mkdir()
    else:
        shutil.move(folder / name, outside)
    (folder / name).symlink_to(outside)


@pytest.mark.parametrize("name", FILES)
def test_validate_reports_a_link_out_of_the_dataset(
    damaged: Path, tmp_path: Path, name: str
) -> None:
    linked(damaged, name, tmp_path / "outside")
    report = validate_dataset(damaged)
    assert not report.ok
    found = [
        finding.file
        for finding in report.findings
        if "leads outside the folder" in finding.problem
    ]
    assert name in found or (name == "train" and SHARD in found)


@pytest.mark.parametrize("name", FILES)
def test_merge_refuses_a_link_out_of_a_part(
    tiny: Callable[[str], Path], damaged: Path, tmp_path: Path, name: str
) -> None:
    linked(damaged, name, tmp_path / "outside")
    with is_refused(DatasetError):
        merge_datasets([damaged], tmp_path / "out")
    assert not list((tmp_path / "out").glob("train/*.h5"))


@pytest.mark.parametrize("name", ["train", WORK])
def test_no_dataset_is_made_through_a_link(
    damaged: Path, tmp_path: Path, name: str
) -> None:
    linked(damaged, name, tmp_path / "outside")
    before = sorted(path.name for path in tmp_path.rglob("*"))
    for make in (
        lambda: extend_dataset(damaged, 700, workers=1),
        lambda: make_dataset(
            tiny_recipe("airhockey-hit"), damaged, shard_size=250, workers=1
        ),
    ):
        with is_refused(UsageError):
            make()
    assert sorted(path.name for path in tmp_path.rglob("*")) == before


def test_a_link_within_the_dataset_is_no_finding(damaged: Path) -> None:
    (damaged / SHARD).rename(damaged / "train" / "kept")
    (damaged / SHARD).symlink_to("kept")
    assert validate_dataset(damaged).ok


def test_a_circular_link_is_reported(damaged: Path) -> None:
    (damaged / "README.md").unlink()
    (damaged / "README.md").symlink_to("README.md")
    assert not validate_dataset(damaged).ok
