"""Error messages for files that are not HDF5 files name their apparent kind."""

import gzip
import io
import os
from collections.abc import Callable
from pathlib import Path
from unittest.mock import ANY

import h5py
import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.load import load_dataset
from cnpgen.planner.model_file import load_model
from cnpgen.plans import load_plans
from cnpgen.plans.boundary_problems import load_boundary_problems
from cnpgen.store.files.checksum_file import read_with_checksum
from cnpgen.store.files.hdf5 import open_hdf5
from cnpgen.store.files.kind import apparent_kind
from cnpgen.store.paths import file_kind
from cnpgen.store.shard import read_shard
from cnpgen.validate.validate_dataset import validate_dataset
from tests.refusals import is_refused


def archive() -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, q=np.zeros(3))
    return buffer.getvalue()


def array() -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(3))
    return buffer.getvalue()


FILES = {
    "text": (b"start_q, goal_q\n0.1, 0.2\n", ": it seems to be a text file"),
    "long text": (
        b"a" + "é".encode() * 1000,
        ": it seems to be a text file",
    ),  # cut within a character
    "npz": (archive(), ": it seems to be a zip archive, as .npz files are"),
    "npy": (array(), ": it seems to be an array of NumPy"),
    "gzip": (gzip.compress(b"1"), ": it seems to be a gzip archive"),
    "journal": (
        b'{"format": "cnpgen-journal", "format_version": 2}\t',
        ": it seems to be a journal of cnpgen",
    ),
    "old journal": (b"cnpgen journal 1\n\0\0", ": it seems to be a journal of cnpgen"),
    "empty": (b"", ": it is empty"),
    "noise": (bytes(range(1, 200)), ""),
}


@pytest.mark.parametrize("kind", FILES)
def test_files_of_other_kinds_are_named_by_their_kind(
    tmp_path: Path, kind: str
) -> None:
    content, apparent = FILES[kind]
    path = tmp_path / "given.h5"
    path.write_bytes(content)
    assert apparent_kind(path) == apparent
    with pytest.raises(DatasetError) as caught, open_hdf5(path):
        pass
    assert (
        str(caught.value)
        == f"{path} is not an HDF5 file, or its beginning is damaged{apparent}"
    )


def test_every_reader_names_the_apparent_kind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "notes.h5"
    path.write_text("mine")
    with is_refused(DatasetError):
        read_shard(path)
    for read in (load_plans, load_model, load_boundary_problems):
        with is_refused(UsageError, argument=ANY):
            read(path)
    with is_refused(DatasetError):
        read_with_checksum(path, kind="cnpgen-model", version=1)
    assert main(["evaluate", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("notes.h5 is a text file, expected a file of plans")


def test_a_cut_off_hdf5_file_is_reported_as_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "cut.h5"
    with h5py.File(path, "w") as file:
        file["x"] = np.arange(10_000.0)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(DatasetError, match=r"cut.h5 is damaged or cut off: Unable"):
        read_shard(path)


@pytest.mark.parametrize("read", [load_plans, load_model, load_boundary_problems])
def test_pipes_are_refused_without_blocking(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    os.mkfifo(tmp_path / "given.h5")
    with is_refused(UsageError, argument=ANY):
        read(tmp_path / "given.h5")


def test_a_pipe_in_place_of_the_specification_is_refused_without_blocking(
    tmp_path: Path,
) -> None:
    os.mkfifo(tmp_path / "specification.json")
    for read in (validate_dataset, load_dataset):
        with is_refused(UsageError, argument="folder"):
            read(tmp_path)


@pytest.mark.parametrize("block", [0, 512, 2048])
def test_hdf5_files_with_a_user_block_are_recognized(
    tmp_path: Path, block: int
) -> None:
    with h5py.File(tmp_path / "theirs.h5", "w", userblock_size=block) as file:
        file["path_control_points"] = file["rate_control_points"] = np.zeros(3)
    assert file_kind(tmp_path / "theirs.h5") == "a file of plans"
