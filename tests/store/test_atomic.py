"""Atomic writing: a file is complete or absent, even if the disk fails."""

import errno
import hashlib
import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from cnpgen.errors import DatasetError, MachineError
from cnpgen.store.files.atomic import (
    check_readable,
    check_writable,
    committing,
    file_sha256,
    read_file,
    write_file,
)
from tests.refusals import is_refused


def failing(code: int) -> Callable[..., None]:
    def fail(*_arguments: object, **_options: object) -> None:
        raise OSError(code, os.strerror(code))

    return fail


def test_a_written_file_is_complete_and_leaves_no_temporary_file(
    tmp_path: Path,
) -> None:
    write_file(tmp_path / "a" / "b.txt", "grün\n")
    write_file(tmp_path / "a" / "b.txt", b"again")
    assert (tmp_path / "a" / "b.txt").read_bytes() == b"again"
    assert list((tmp_path / "a").iterdir()) == [tmp_path / "a" / "b.txt"]


def test_the_file_is_flushed_before_it_is_renamed_and_its_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[str] = []
    sync, rename = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (steps.append("sync"), sync(fd))[1])
    monkeypatch.setattr(
        Path,
        "replace",
        lambda self, target: (steps.append("rename"), rename(self, target))[1],
    )
    write_file(tmp_path / "a", b"x")
    assert steps == ["sync", "rename", "sync"]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EIO])
@pytest.mark.parametrize("step", ["fsync", "write", "rename", "mkdir"])
def test_a_failing_disk_is_a_machine_error_that_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, code: int
) -> None:
    path = tmp_path / "a.txt"
    write_file(path, b"old")
    owner: object = os if step == "fsync" else Path
    name = {
        "fsync": "fsync",
        "write": "write_bytes",
        "rename": "replace",
        "mkdir": "mkdir",
    }[step]
    monkeypatch.setattr(owner, name, failing(code))
    with pytest.raises(MachineError) as caught:
        write_file(path, b"new")
    assert str(path) in str(caught.value)
    assert os.strerror(code) in str(caught.value)
    assert caught.value.exit_code == 3
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_error_for_a_full_disk_has_a_hint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", failing(errno.ENOSPC))
    with is_refused(MachineError):
        write_file(tmp_path / "a", b"new")


def test_a_write_that_exceeds_the_file_size_limit_leaves_no_file(
    tmp_path: Path,
) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
        with pytest.raises(MachineError, match="ulimit"):
            write_file(tmp_path / "a", bytes(10_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())


def test_a_folder_below_a_file_is_a_machine_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with is_refused(MachineError):
        write_file(tmp_path / "file" / "a", b"x")


def test_an_interrupted_write_leaves_no_file(tmp_path: Path) -> None:
    def interrupted() -> None:
        with committing(tmp_path / "a") as temporary:
            temporary.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not list(tmp_path.iterdir())


def test_two_writers_of_one_file_use_different_temporary_files(tmp_path: Path) -> None:
    with committing(tmp_path / "a") as first, committing(tmp_path / "a") as second:
        assert first != second
        assert first.parent == second.parent == tmp_path
        first.write_bytes(b"1")
        second.write_bytes(b"2")
    assert (tmp_path / "a").read_bytes() == b"1"


def test_sha256_is_that_of_the_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(bytes(300_000))
    assert file_sha256(tmp_path / "a") == hashlib.sha256(bytes(300_000)).hexdigest()


@pytest.mark.parametrize("read", [file_sha256, read_file])
def test_a_missing_file_is_a_dataset_error_and_an_unreadable_one_a_machine_error(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    with is_refused(DatasetError):
        read(tmp_path / "nothing")
    with is_refused(MachineError):
        read(tmp_path)


@pytest.mark.usefixtures("file_permissions")
def test_what_cannot_be_written_is_found_before_it_is_written(tmp_path: Path) -> None:
    check_writable(tmp_path / "new" / "file.h5")
    (tmp_path / "old").write_text("old")
    check_writable(tmp_path / "old")
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
    assert (tmp_path / "old").read_text() == "old"
    (tmp_path / "old").chmod(0o444)
    (tmp_path / "ro").mkdir(0o555)
    for path in ("old", "ro", "ro/file.h5", "ro/new/file.h5"):
        with is_refused(MachineError):
            check_writable(tmp_path / path)
    with is_refused(MachineError):
        check_writable(tmp_path / "old" / "file.h5")


@pytest.mark.usefixtures("file_permissions")
@pytest.mark.parametrize("mode", [0o000, 0o300, 0o600])
def test_a_folder_that_cannot_be_listed_and_entered_cannot_be_read(
    tmp_path: Path, mode: int
) -> None:
    (tmp_path / "folder").mkdir()
    check_readable(tmp_path / "folder")
    check_readable(tmp_path / "nothing")
    (tmp_path / "folder").chmod(mode)
    with is_refused(MachineError):
        check_readable(tmp_path / "folder")
    (tmp_path / "folder").chmod(0o700)
