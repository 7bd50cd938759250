"""A journal of finished plans: what a long run has done survives whatever ends it, and the next run goes on."""

import hashlib
import io
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import MachineError
from cnpgen.refine.task import Outcome, Refined

_DIGEST = hashlib.sha256().digest_size


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

    def close(self, *, remove: bool = False) -> None:
        """Close the file, and remove it when its content is where it belongs."""
        self._file.close()
        if remove:
            with suppress(OSError):
                self.path.unlink()

    def _write(self, payload: bytes) -> None:
        try:
            self._file.write(len(payload).to_bytes(8, "little") + hashlib.sha256(payload).digest() + payload)
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise MachineError(f"{self.path}: {error.strerror or error}; what is in it already counts") from error


def open_journal(path: Path, identity: str) -> Journal:
    """Open the journal of a run, with what earlier runs of the same identity have finished.

    Args:
        path: The file; it is made if it is missing, and emptied if it is of another run.
        identity: What distinguishes the run: plans, options, version.

    Raises:
        MachineError: The file cannot be opened.
    """
    try:
        file = path.open("r+b" if path.exists() else "w+b")
    except OSError as error:
        raise MachineError(f"{path}: {error.strerror or error}") from error
    frames, end = _read_frames(file)
    journal = Journal(path, {}, file)
    if frames and frames[0] == identity.encode():
        for frame in frames[1:]:
            journal.finished |= _unpack(frame)
        file.truncate(end)
    else:
        file.seek(0)
        file.truncate()
        journal._write(identity.encode())
    return journal


def _read_frames(file: IO[bytes]) -> tuple[list[bytes], int]:
    """Return the whole frames at the beginning of a file, and where they end."""
    frames, end = [], 0
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
        numbers, reasons = json.loads(arrays["words"].tobytes())
        path, rate, cost = (arrays[name] for name in ("path", "rate", "cost"))
    return {
        plan: Refined(path[i], rate[i], Outcome(outcome), reasons[i], iterations, float(cost[i]))
        for i, (plan, outcome, iterations) in enumerate(numbers)
    }
