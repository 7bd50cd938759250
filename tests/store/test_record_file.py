"""Files of records: valid records survive, an incomplete or damaged end is removed, other runs are refused by name."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.store.files.record_file import (
    RecordFormat,
    open_records,
    pack_arrays,
    unpack_arrays,
)
from tests.refusals import is_refused

FORMAT = RecordFormat(
    "cnpgen-journal",
    7,
    "a journal of cnpgen",
    "{discard} removes it",
    "discard",
    lambda record: record,
)
TEXT = replace(FORMAT, checked=False)
FORMATS = pytest.mark.parametrize("form", [FORMAT, TEXT], ids=["checked", "text"])
RUN = {"run": "one", "plans": 3}
RECORDS = [{"a": 1.5}, [], {"text": "\u00e4\t\n", "more": [None, True]}]


def written(path: Path, records: list[Any], form: RecordFormat = FORMAT) -> bytes:
    """Append records to a file; return its content."""
    file = open_records(path, form, RUN)
    for record in records:
        file.append(record)
    file.close()
    return path.read_bytes()


def reopened(path: Path, form: RecordFormat = FORMAT) -> list[Any]:
    file = open_records(path, form, RUN)
    file.close()
    return file.records


@FORMATS
def test_records_are_read_in_order_and_appended_after_the_last_one(
    tmp_path: Path, form: RecordFormat
) -> None:
    path = tmp_path / "journal"
    assert written(path, RECORDS, form).startswith(b'{"format": "cnpgen-journal"')
    written(path, [5], form)
    assert reopened(path, form) == [*RECORDS, 5]
    assert form.read(path) == (form.head(RUN), [*RECORDS, 5])


@FORMATS
def test_every_truncation_leaves_the_complete_records(
    tmp_path: Path, form: RecordFormat
) -> None:
    path = tmp_path / "journal"
    ends = [
        len(written(path, [], form)),
        *(len(written(path, [record], form)) for record in RECORDS),
    ]
    content = path.read_bytes()
    for length in range(len(content)):
        path.write_bytes(content[:length])
        complete = sum(end <= length for end in ends)
        assert reopened(path, form) == RECORDS[: max(complete - 1, 0)]
        assert path.stat().st_size == ends[max(complete - 1, 0)]


def test_every_changed_byte_ends_the_records(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    head = len(written(path, []))
    content = written(path, RECORDS[:1])
    for index in range(len(content)):
        changed = bytearray(content)
        changed[index] ^= 1
        path.write_bytes(changed)
        if index < head:
            with pytest.raises(DatasetError):
                open_records(path, FORMAT, RUN)
            assert path.read_bytes() == changed
        else:
            assert reopened(path) == []
            assert path.read_bytes() == content[:head]


def test_a_cleared_file_has_no_records(tmp_path: Path) -> None:
    file = open_records(tmp_path / "journal", FORMAT, RUN)
    file.append("old")
    file.clear()
    file.append("new")
    file.close()
    assert reopened(tmp_path / "journal") == ["new"]


def test_a_replaced_file_has_one_record(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    for record in (RECORDS[0], RECORDS[2]):
        FORMAT.replace(path, RUN, record)
        assert FORMAT.read(path) == (FORMAT.head(RUN), [record])
    assert [each.name for each in tmp_path.iterdir()] == ["checkpoint"]


@FORMATS
def test_records_of_another_run_are_kept_without_discard(
    tmp_path: Path, form: RecordFormat
) -> None:
    path = tmp_path / "journal"
    content = written(path, RECORDS, form)
    other = {"run": "x" * 80, "plans": 4}
    with is_refused(UsageError, argument="discard"):
        open_records(path, form, other)
    assert path.read_bytes() == content
    file = open_records(path, form, other, discard=True)
    assert file.records == []
    file.close()
    # A head alone is no loss.
    assert reopened(path, form) == []


@pytest.mark.parametrize("line", [b"cnpgen journal 1\n", b"cnpgen-journal 1\n"])
def test_a_file_of_version_1_0_is_another_run(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "journal"
    path.write_bytes(line + b"\0\xff binary records")
    with is_refused(UsageError, argument="discard"):
        open_records(path, FORMAT, RUN)
    open_records(path, FORMAT, RUN, discard=True).close()
    assert reopened(path) == []


@pytest.mark.parametrize(
    "content", [b"thesis", b"thesis\n", b"5\n", b'{"format": "cnpgen-model"}\n']
)
def test_files_of_other_formats_are_refused_and_unchanged(
    tmp_path: Path, content: bytes
) -> None:
    path = tmp_path / "journal"
    path.write_bytes(content)
    for form in (FORMAT, TEXT):
        with is_refused(DatasetError):
            open_records(path, form, RUN, discard=True)
    assert path.read_bytes() == content


@pytest.mark.skipif(os.name == "nt", reason="needs flock")
def test_a_file_in_use_is_refused(tmp_path: Path) -> None:
    file = open_records(tmp_path / "journal", FORMAT, RUN)
    with is_refused(UsageError):
        open_records(tmp_path / "journal", FORMAT, RUN)
    file.close()
    assert reopened(tmp_path / "journal") == []


def test_a_full_disk_is_a_machine_error_and_the_record_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    file = open_records(tmp_path / "journal", FORMAT, RUN)
    monkeypatch.setattr(os, "fsync", full)
    with is_refused(MachineError):
        file.append("record")
    file.close()
    with is_refused(MachineError):
        open_records(tmp_path / "no" / "journal", FORMAT, RUN)


@pytest.mark.parametrize(
    "error", [ValueError("odd"), KeyError("odd"), TypeError("odd")]
)
def test_a_record_that_cannot_be_converted_is_named(
    tmp_path: Path, error: Exception
) -> None:
    def unpack(record: Any) -> Any:
        if record == RECORDS[1]:
            raise error
        return record

    path = tmp_path / "journal"
    for form in (FORMAT, TEXT):
        path.unlink(missing_ok=True)
        content = written(path, RECORDS, form)
        with is_refused(DatasetError):
            open_records(path, replace(form, unpack=unpack), RUN)
        assert path.read_bytes() == content
        assert reopened(path, form) == RECORDS


def test_arrays_are_read_back_bit_by_bit_and_other_content_is_refused() -> None:
    arrays = {"x": np.array([[0.1, np.nan]]), "n": np.arange(3, dtype=np.float32)}
    found = unpack_arrays(pack_arrays(arrays))
    assert found.keys() == arrays.keys()
    for name, values in arrays.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_array_equal(found[name], values)
    for text in ("", "?", "thesis", pack_arrays(arrays)[:-40]):
        with pytest.raises(ValueError, match=r"."):
            unpack_arrays(text)
