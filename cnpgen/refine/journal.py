"""A journal of finished plans: what a long run has done survives whatever ends it, and the next run goes on."""

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError, counted
from cnpgen.refine.task import Outcome, Refined
from cnpgen.store.files.atomic import machine_error
from cnpgen.store.files.documents import differences, parse_json

MAGIC = b"cnpgen journal 1\n"
_DIGEST = hashlib.sha256().digest_size
# What NumPy and Python say of a frame whose digest is right and that cnpgen has not written.
_NOT_OURS = (
    ValueError, KeyError, TypeError, IndexError, EOFError, RuntimeError, MemoryError, OverflowError, zipfile.BadZipFile,
)  # fmt: skip
_MODE = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)  # nothing is emptied before it is locked


@dataclass
class Journal:
    """Frames appended to a file, each with its length and sha256; the first names the run.

    A frame that is cut or damaged, and what follows it, is as if it had never been written.

    Attributes:
        path: The file.
        finished: Plan -> what came of it, from earlier runs.
    """

    path: Path
    finished: dict[int, Refined]
    _file: IO[bytes]

    def append(self, plans: Sequence[int], refined: Sequence[Refined]) -> None:
        """Write finished plans down.

        Raises:
            MachineError: The disk is full, or otherwise unwilling.
        """
        self._write(_pack(plans, refined))

    def close(self) -> None:
        """Close the file; others may open it again."""
        with suppress(OSError):  # of what could not be written before, either; it does not count
            self._file.close()

    def _write(self, payload: bytes) -> None:
        try:
            self._file.write(len(payload).to_bytes(8, "little") + hashlib.sha256(payload).digest() + payload)
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise machine_error("write", self.path, error) from error


def open_journal(path: Path, identity: str, *, discard: bool = False) -> Journal:
    """Open the journal of a run, with what earlier runs of the same identity have finished.

    Args:
        path: The file; it is made if it is missing.
        identity: What distinguishes the run: plans, options, version.
        discard: Whether what another run has finished may be thrown away.

    Raises:
        UsageError: The file is no journal, holds another run's plans, or is in use.
        MachineError: The file cannot be opened.
    """
    try:
        file = os.fdopen(os.open(path, _MODE, 0o666), "r+b")
    except OSError as error:
        raise machine_error("write", path, error) from error
    try:
        return _begin(path, file, identity, discard=discard)
    except OSError as error:
        file.close()
        raise machine_error("write", path, error) from error
    except BaseException:
        file.close()
        raise


def _begin(path: Path, file: IO[bytes], identity: str, *, discard: bool) -> Journal:
    """Read what is in the file and put the end where the next frame goes."""
    _lock(path, file)
    if not MAGIC.startswith(head := file.read(len(MAGIC))):
        raise UsageError(f"{path} is not a journal of cnpgen: it must be removed, or another output be chosen")
    frames, end = _read_frames(file) if head == MAGIC else ([], 0)
    journal = Journal(path, {}, file)
    for frame in frames[1:]:
        try:
            journal.finished |= _unpack(frame)
        except _NOT_OURS as error:
            raise UsageError(f"{path} is no journal that cnpgen has written: {error}") from error
    if frames and frames[0] == identity.encode():
        file.truncate(end)
        return journal
    if journal.finished and not discard:
        raise UsageError(
            f"{path} holds {counted(len(journal.finished), 'finished plan')} of another run"
            f" ({', '.join(_changed(frames[0], identity))}): discard=True throws them away, another output keeps them"
        )
    journal.finished.clear()
    file.seek(0)
    file.truncate()
    file.write(MAGIC)
    journal._write(identity.encode())
    return journal


def _changed(found: bytes, mine: str) -> list[str]:
    """Say in what two runs differ, with the values where they are short: those of plans are digests."""
    try:
        changed = differences(parse_json(found.decode()), json.loads(mine))
    except ValueError:
        return ["another version"]
    return [f"{each.key} {each.found}, now {each.wanted}" if each.is_short else f"other {each.key}" for each in changed]


def _lock(path: Path, file: IO[bytes]) -> None:
    """Keep other processes from writing to the same journal, where the system can."""
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UsageError(f"{path} is in use: another process makes the same plans") from error
    except OSError:  # file systems without locks
        return


def _read_frames(file: IO[bytes]) -> tuple[list[bytes], int]:
    """Return the whole frames from here on, and where they end."""
    frames, end = [], file.tell()
    while len(head := file.read(8 + _DIGEST)) == 8 + _DIGEST:
        payload = file.read(min(int.from_bytes(head[:8], "little"), 1 << 30))
        if hashlib.sha256(payload).digest() != head[8:]:
            break
        frames.append(payload)
        end = file.tell()
    file.seek(end)
    return frames, end


def _pack(plans: Sequence[int], refined: Sequence[Refined]) -> bytes:
    arrays: dict[str, NDArray[Any]] = {
        "path": np.stack([each.path for each in refined]),
        "rate": np.stack([each.rate for each in refined]),
        "cost": np.array([each.cost for each in refined]),
    }
    numbers = [[int(plan), int(each.outcome), each.iterations] for plan, each in zip(plans, refined, strict=True)]
    words = json.dumps([numbers, [str(each.reason) for each in refined]]).encode()
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, words=np.frombuffer(words, np.uint8), **arrays)
    return buffer.getvalue()


def _unpack(frame: bytes) -> dict[int, Refined]:
    with np.load(io.BytesIO(frame), allow_pickle=False) as arrays:
        if any(member.compress_type != zipfile.ZIP_STORED for member in arrays.zip.infolist()):
            raise ValueError("its arrays are packed")  # ours are not: a few bytes could become gigabytes
        numbers, reasons = parse_json(arrays["words"].tobytes().decode())
        path, rate, cost = (arrays[name] for name in ("path", "rate", "cost"))
    return {
        plan: Refined(path[i], rate[i], Outcome(outcome), reasons[i], iterations, float(cost[i]))
        for i, (plan, outcome, iterations) in enumerate(numbers)
    }
