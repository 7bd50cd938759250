"""The entry point for HDF5: plain numbers in the file itself are read, everything else is refused and named."""

import ast
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import cnpgen
from cnpgen.errors import DatasetError
from cnpgen.plans import load_plans
from cnpgen.store.files.checksum_file import (
    HEADER_BYTES,
    read_with_checksum,
    with_checksum,
)
from cnpgen.store.files.hdf5 import open_hdf5
from cnpgen.store.files.size_limits import MAX_EXPANSION, MIN_EXPANSION_LIMIT_BYTES
from cnpgen.store.shard import read_placements, read_shard
from tests.plans.test_plans import write_minimal
from tests.refusals import is_refused

Change = Callable[[Any, Path], None]
SECRET = "the private key of a user"


def outside(file: Any, folder: Path) -> None:
    private = folder / "private.txt"
    private.write_text(SECRET)
    file.create_dataset(
        "note", shape=(3, 9), dtype="u1", external=[(str(private), 0, 27)]
    )


def linked_outside(file: Any, folder: Path) -> None:
    with h5py.File(folder / "other.h5", "w") as other:
        other["note"] = np.arange(3.0)
    file["note"] = h5py.ExternalLink(str(folder / "other.h5"), "note")


def linked(file: Any, folder: Path) -> None:
    file["note"] = h5py.SoftLink("/start_q")


def virtual(file: Any, folder: Path) -> None:
    linked_outside(file, folder)
    del file["note"]
    layout = h5py.VirtualLayout(shape=(3,), dtype="f8")
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "note", shape=(3,))
    file.create_virtual_dataset("note", layout)


def references(file: Any, folder: Path) -> None:
    file.create_dataset("note", data=[file["start_q"].ref] * 3, dtype=h5py.ref_dtype)


def ragged(file: Any, folder: Path) -> None:
    file.create_dataset("note", shape=(3,), dtype=h5py.vlen_dtype(np.float64))


def texts(file: Any, folder: Path) -> None:
    file["note"] = ["a", "b", "c"]


def compound(file: Any, folder: Path) -> None:
    file["note"] = np.zeros(3, [("a", "f8"), ("b", "i4")])


def many_dimensions(file: Any, folder: Path) -> None:
    file["note"] = np.zeros((3, 1, 1, 1, 1))


def nothing(file: Any, folder: Path) -> None:
    file["note"] = h5py.Empty("f8")


def never_written(file: Any, folder: Path) -> None:
    file.create_dataset("note", shape=(10**12,), dtype="f8")


def packed(file: Any, folder: Path) -> None:
    file.create_dataset(
        "note", shape=(3, 10**8), dtype="f8", compression="gzip", chunks=(1, 10**6)
    )


def large_chunks(file: Any, folder: Path) -> None:
    file.create_dataset(
        "note", shape=(3, 1), dtype="f8", chunks=(3, 10**7), maxshape=(3, None)
    )


def scaled(file: Any, folder: Path) -> None:
    file.create_dataset("note", data=np.arange(3), chunks=(3,), scaleoffset=4)


REFUSED: dict[str, tuple[Change, str]] = {
    "storage in another file": (outside, "the numbers of note are in another file"),
    "a virtual dataset": (virtual, "the numbers of note are in another file"),
    "a link to another file": (linked_outside, "its 'note' is a link"),
    "a link within the file": (linked, "its 'note' is a link"),
    "references to objects": (references, "note must hold numbers, got object"),
    "lists of variable length": (ragged, "note must hold numbers, got object"),
    "texts": (texts, "note must hold numbers, got object"),
    "tables": (compound, "note must hold numbers, got"),
    "too many dimensions": (many_dimensions, "note must have at most 4 dimensions"),
    "no space": (nothing, "note must have at most 4 dimensions, got None"),
    "numbers that were not written": (
        never_written,
        r"note declares the shape \(1000000000000,\)",
    ),
    "much out of little": (
        packed,
        "note declares the shape .* more than 100 times as many",
    ),
    "chunks that are larger than what they hold": (
        large_chunks,
        "note declares the shape",
    ),
    "another filter": (
        scaled,
        r"note is packed with filter \[6\], expected gzip, shuffle",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_datasets_that_are_not_plain_are_refused_and_named(
    tmp_path: Path, what: str
) -> None:
    change, message = REFUSED[what]
    path = write_minimal(tmp_path / "theirs.h5")
    with h5py.File(path, "a") as file:
        change(file, tmp_path)
    for read in (load_plans, read_shard, read_placements):
        with pytest.raises(DatasetError, match=rf"theirs\.h5.*{message}"):
            read(path)


@pytest.mark.parametrize("what", REFUSED)
def test_datasets_that_are_not_plain_are_refused_in_files_with_a_checksum(
    tmp_path: Path, what: str
) -> None:
    change, message = REFUSED[what]
    path = tmp_path / "model.h5"
    with h5py.File(path, "w", userblock_size=HEADER_BYTES) as file:
        file["start_q"] = np.zeros((3, 6))
        change(file, tmp_path)
    path.write_bytes(with_checksum(path.read_bytes(), kind="cnpgen-model", version=1))
    with pytest.raises(DatasetError, match=rf"model\.h5.*{message}"):
        read_with_checksum(path, kind="cnpgen-model", version=1)


def test_datasets_that_are_not_read_are_not_checked(tmp_path: Path) -> None:
    path = write_minimal(tmp_path / "theirs.h5")
    with h5py.File(path, "a") as file:
        outside(file, tmp_path)
        file["group/inside"] = h5py.SoftLink("/nowhere")
    with open_hdf5(path) as file:
        assert "note" in file
        assert file["start_q"].read().shape == (3, 6)
        assert "group" not in set(file)
        with is_refused(DatasetError):
            file["group"]


@pytest.mark.parametrize(
    "how",
    [
        {"compression": "gzip"},
        {"compression": "lzf"},
        {"shuffle": True, "fletcher32": True},
        {"chunks": (1, 2)},
    ],
)
def test_compressed_datasets_are_read(tmp_path: Path, how: dict[str, Any]) -> None:
    path = write_minimal(tmp_path / "theirs.h5")
    values = np.arange(12.0).reshape(3, 4)
    with h5py.File(path, "a") as file:
        file.create_dataset("note", data=values, **how)
    assert load_plans(path).columns["note"].tolist() == values.tolist()


def test_the_size_limit_applies_to_all_datasets_together(tmp_path: Path) -> None:
    path = tmp_path / "many.h5"
    each = MIN_EXPANSION_LIMIT_BYTES // 8 // 4 + 1
    with h5py.File(path, "w") as file:
        for index in range(4):
            file.create_dataset(f"note{index}", shape=(each,), dtype="f8")
    assert MAX_EXPANSION * path.stat().st_size < MIN_EXPANSION_LIMIT_BYTES
    with open_hdf5(path) as file:
        assert len({name: file[name] for name in ("note0", "note1", "note2")}) == 3
        # The size of the file depends on the HDF5 library.
        with pytest.raises(DatasetError, match="note3 declares the shape"):
            file["note3"]


@pytest.mark.parametrize(
    "value",
    [["a", "b"], h5py.Empty("f8"), np.zeros(2, [("a", "f8")]), np.array([True])],
    ids=["texts", "nothing", "a table", "yes or no"],
)
def test_attributes_other_than_texts_and_numbers_are_refused(
    tmp_path: Path, value: Any
) -> None:
    path = write_minimal(tmp_path / "theirs.h5")
    with h5py.File(path, "a") as file:
        file.attrs["degree"] = value
    with is_refused(DatasetError):
        load_plans(path)


def test_a_name_that_is_not_utf8_is_damage(tmp_path: Path) -> None:
    path = write_minimal(tmp_path / "theirs.h5")
    with h5py.File(path, "a") as file:
        h5py.h5d.create(
            file.id, b"\xff", h5py.h5t.NATIVE_DOUBLE, h5py.h5s.create_simple((3,))
        )
    with is_refused(DatasetError):
        load_plans(path)


def test_a_device_is_not_a_file() -> None:
    with (
        is_refused(DatasetError),
        open_hdf5(Path("/dev/zero")),
    ):
        pass


def test_a_huge_sparse_file_is_refused(tmp_path: Path) -> None:
    """A sparse file needs no space on a disk or in an archive."""
    theirs, has_checksum = (
        write_minimal(tmp_path / "theirs.h5"),
        tmp_path / "with a checksum.h5",
    )
    has_checksum.write_bytes(
        with_checksum(
            bytes(HEADER_BYTES) + theirs.read_bytes(), kind="cnpgen-plans", version=1
        )
    )
    for path, read in (
        (theirs, load_plans),
        (has_checksum, load_plans),
        (
            has_checksum,
            lambda path: read_with_checksum(path, kind="cnpgen-model", version=1),
        ),
    ):
        os.truncate(path, 1 << 40)
        with is_refused(DatasetError):
            read(path)


def test_heaps_at_the_end_of_a_file_are_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_minimal(tmp_path / "theirs.h5", attributes={"note": "x" * 300})
    content = bytearray(path.read_bytes())
    content[content.index(b"GCOL\x01\0\0\0") + 9] ^= 0x20
    path.write_bytes(content)
    monkeypatch.setattr("cnpgen.store.files.heaps._CHUNK_BYTES", 56)
    with is_refused(DatasetError), open_hdf5(path):
        pass


def test_nothing_else_in_the_package_opens_hdf5() -> None:
    """Files are made in memory by what ``create_hdf5`` returns; only the entry point reads."""
    package = Path(cnpgen.__file__).parent
    opened = []
    texts = {path: path.read_text(encoding="utf-8") for path in package.rglob("*.py")}
    for path, text in texts.items():
        for node in ast.walk(ast.parse(text)) if "h5" in text else ():
            if (
                isinstance(node, ast.Attribute)
                and node.attr == "File"
                and ast.unparse(node.value) == "h5py"
            ):
                opened.append((path.relative_to(package).as_posix(), node.lineno))
            if isinstance(node, ast.Attribute) and ast.unparse(node) in {
                "h5f.open",
                "h5py.h5f.open",
            }:
                opened.append((path.relative_to(package).as_posix(), node.lineno))
            if isinstance(node, ast.ImportFrom) and node.module == "h5py":
                assert (
                    not {alias.name for alias in node.names} & {"File", "h5f"}
                    or path.name == "hdf5.py"
                )
    makers = {
        "store/files/checksum_file.py",
        "store/shard.py",
        "plans/plan_file.py",
        "addons/scene_files/mpinets_scenes.py",
        "plans/formats.py",
    }
    assert {name for name, _ in opened} == makers | {"store/files/hdf5.py"}
    for name, line in opened:
        read = texts[package / name].splitlines()[line - 1]
        assert name == "store/files/hdf5.py" or "h5py.File(create_hdf5(" in read
