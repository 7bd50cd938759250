"""Damaged variable-length texts: an error instead of a hang of HDF5."""

import io
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import DatasetError
from cnpgen.plans import load_plans
from cnpgen.store.files.hdf5 import open_hdf5
from cnpgen.store.files.heaps import check_heaps
from tests.plans.test_plans import write_minimal
from tests.refusals import is_refused


@pytest.fixture
def file(tmp_path: Path) -> tuple[Path, int]:
    """A file with text attributes, and the position of its global heap."""
    path = write_minimal(
        tmp_path / "theirs.h5", attributes={"note": "x" * 300, "other": "y"}
    )
    return path, path.read_bytes().index(b"GCOL\x01\0\0\0")


def changed(path: Path, at: int, content: bytes) -> None:
    data = bytearray(path.read_bytes())
    data[at : at + len(content)] = content
    path.write_bytes(data)


def test_undamaged_files_are_read(file: tuple[Path, int]) -> None:
    path, _ = file
    assert check_heaps(path, io.BytesIO(path.read_bytes())) == path.stat().st_size
    assert len(load_plans(path)) == 3


@pytest.mark.parametrize(
    ("offset", "size"),
    [(9, b"\x20"), (24, b"\x25"), (24, b"\xff" * 8), (8, b"\xff" * 8)],
)
def test_a_heap_with_inconsistent_sizes_is_damage(
    file: tuple[Path, int], offset: int, size: bytes
) -> None:
    path, begin = file
    changed(path, begin + offset, size)
    with is_refused(DatasetError):
        load_plans(path)


def test_a_heap_that_is_cut_off_is_damage(file: tuple[Path, int]) -> None:
    path, begin = file
    with is_refused(DatasetError):
        check_heaps(path, io.BytesIO(path.read_bytes()[begin : begin + 8]))


def test_numbers_that_look_like_a_heap_are_numbers(tmp_path: Path) -> None:
    """The signature alone may occur in control points; followed by a version, it is no realistic number."""
    values = np.frombuffer(b"GCOL" + b"\x01\x00\x00\x40", "<f8")
    path = write_minimal(tmp_path / "numbers.h5", loss=np.repeat(values, 3))
    assert load_plans(path).columns["loss"][0] == values[0]


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.h5").touch()
    with (
        is_refused(DatasetError),
        open_hdf5(tmp_path / "empty.h5"),
    ):
        pass
