"""The append-only journal: valid records survive, an incomplete or damaged tail is removed."""

import os
from pathlib import Path

import pytest

from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.store.files.journal import open_journal_file
from tests.refusals import is_refused

MAGIC = b"cnpgen test-journal 1\n"
RECORDS = [b"identity", b"", bytes(range(256))]


def written(path: Path, records: list[bytes]) -> bytes:
    """Write a journal; return the content of its file."""
    journal = open_journal_file(path, MAGIC)
    for record in records:
        journal.append(record)
    journal.close()
    return path.read_bytes()


def reopened(path: Path) -> list[bytes]:
    journal = open_journal_file(path, MAGIC)
    journal.close()
    return journal.records


def test_records_are_read_in_order_and_appended_after_the_last_one(
    tmp_path: Path,
) -> None:
    path = tmp_path / "journal"
    assert written(path, RECORDS).startswith(MAGIC)
    written(path, [b"more"])
    assert reopened(path) == [*RECORDS, b"more"]


def test_every_truncation_leaves_the_complete_records(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    ends = [
        len(written(path, [])),
        *(len(written(path, [record])) for record in RECORDS),
    ]
    content = path.read_bytes()
    for length in range(len(content)):
        path.write_bytes(content[:length])
        assert (
            reopened(path) == RECORDS[: max(sum(end <= length for end in ends) - 1, 0)]
        )
        assert path.stat().st_size == max(
            [ends[0], *(end for end in ends if end <= length)]
        )


def test_records_after_a_damaged_one_are_removed(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    content = bytearray(written(path, RECORDS))
    content[len(MAGIC) + 8 + 32] ^= 1  # of the first record
    path.write_bytes(content)
    assert reopened(path) == []
    assert path.read_bytes() == MAGIC


def test_a_cleared_journal_has_no_records(tmp_path: Path) -> None:
    journal = open_journal_file(tmp_path / "journal", MAGIC)
    journal.append(b"old")
    journal.clear()
    journal.append(b"new")
    journal.close()
    assert reopened(tmp_path / "journal") == [b"new"]


def test_files_of_other_formats_are_refused_and_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    path.write_bytes(b"thesis")
    with is_refused(DatasetError):
        open_journal_file(path, MAGIC)
    assert path.read_bytes() == b"thesis"


@pytest.mark.skipif(os.name == "nt", reason="needs flock")
def test_a_journal_in_use_is_refused(tmp_path: Path) -> None:
    journal = open_journal_file(tmp_path / "journal", MAGIC)
    with is_refused(UsageError):
        open_journal_file(tmp_path / "journal", MAGIC)
    journal.close()
    assert reopened(tmp_path / "journal") == []


def test_a_full_disk_is_a_machine_error_and_the_record_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    journal = open_journal_file(tmp_path / "journal", MAGIC)
    monkeypatch.setattr(os, "fsync", full)
    with is_refused(MachineError):
        journal.append(b"record")
    assert journal.records == []
    journal.close()
    with is_refused(MachineError):
        open_journal_file(tmp_path / "no" / "journal", MAGIC)
