"""``datasets`` of Hugging Face opens the folder of a dataset; in the extended run only."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from tests.examples.loader import columns, make

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of its imports
    pytest.importorskip(
        "datasets.config"
    )  # "datasets" alone is also a folder of this repository
    import datasets

pytestmark = [
    pytest.mark.extended,
    pytest.mark.filterwarnings("ignore"),
]  # of the library itself


@pytest.fixture(autouse=True)
def _offline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(datasets.config, "HF_DATASETS_OFFLINE", True)
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "cache")


@pytest.mark.parametrize("streaming", [False, True])
def test_the_folder_is_a_dataset_with_its_splits_and_rows(
    tmp_path: Path, streaming: bool
) -> None:
    folder = make(tmp_path / "two-shards-v1")
    found = datasets.load_dataset(
        str(folder), streaming=streaming, cache_dir=str(tmp_path / "cache")
    )
    assert set(found) == {"train", "validation"}
    for split in found:
        rows = sorted(found[split], key=lambda row: row["sample_id"])
        for name, values in columns(split).items():
            assert np.array_equal(np.array([row[name] for row in rows]), values)
