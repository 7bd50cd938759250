"""Journal of finished plans, from which an interrupted run resumes."""

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cnpgen.arrays import Columns
from cnpgen.errors import DatasetError, UsageError, counted
from cnpgen.refine.task import Attempt, Outcome
from cnpgen.store.files.archives import read_arrays
from cnpgen.store.files.documents import differences, parse_json
from cnpgen.store.files.journal import JournalFile, open_journal_file

JOURNAL_MAGIC = b"cnpgen journal 1\n"
# Errors of NumPy and Python for a record with a valid checksum that cnpgen has not
# written.
_RECORD_ERRORS = (
    ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError,
)  # fmt: skip


@dataclass
class Journal:
    """Finished plans of a run in an append-only file.

    The first record identifies the run.
    """

    path: Path  # path of the file
    # Results of earlier runs, index of the plan -> judged attempt.
    finished: dict[int, Attempt]
    _file: JournalFile

    def append(self, indices: Sequence[int], results: Sequence[Attempt]) -> None:
        """Append finished plans.

        Raises:
            MachineError: The file cannot be written.
        """
        self._file.append(_pack(indices, results))

    def close(self) -> None:
        """Close and unlock the file."""
        self._file.close()


def open_journal(path: Path, identity: str, *, discard: bool = False) -> Journal:
    """Open the journal of a run with the results of earlier runs of the same identity; create it if it is missing.

    The identity is a JSON text: plans, options, version. Finished plans of another run
        are lost only if ``discard``.

    Raises:
        UsageError: The file is no journal, holds another run's plans, or is in use.
        MachineError: The file cannot be opened.
    """
    try:
        file = open_journal_file(path, JOURNAL_MAGIC)
    except DatasetError as error:
        raise UsageError(
            f"{path} is not a journal of cnpgen: remove it, or choose another output",
            concerns="journal",
        ) from error
    try:
        return _resume(path, file, identity, discard=discard)
    except BaseException:
        file.close()
        raise


def _resume(path: Path, file: JournalFile, identity: str, *, discard: bool) -> Journal:
    """Read the finished plans; start a new run if there are none of this identity."""
    journal = Journal(path, {}, file)
    # The first record is the identity of the run.
    for record in file.records[1:]:
        try:
            journal.finished |= _unpack(record)
        except _RECORD_ERRORS as error:
            raise UsageError(
                f"{path} is not a journal that cnpgen has written: {error}",
                concerns="journal",
            ) from error
    if file.records and file.records[0] == identity.encode():
        return journal
    if journal.finished and not discard:
        raise UsageError(
            f"{path} holds {counted(len(journal.finished), 'finished plan')} of another run"
            f" ({', '.join(_changed(file.records[0], identity))}): {{discard}} discards them,"
            " another output keeps them",
            remedies={"discard": True},
        )
    journal.finished.clear()
    file.clear()
    file.append(identity.encode())
    return journal


def _changed(old: bytes, new: str) -> list[str]:
    """List the differences of two runs, with short values.

    Those of plans are checksums.
    """
    try:
        changed = differences(parse_json(old.decode()), json.loads(new))
    except ValueError:
        return ["another version"]
    return [
        f"{item.key} {item.old}, now {item.new}"
        if item.is_short
        else f"other {item.key}"
        for item in changed
    ]


def _pack(indices: Sequence[int], results: Sequence[Attempt]) -> bytes:
    arrays: Columns = {
        "path": np.stack([result.path for result in results]),
        "rate": np.stack([result.rate for result in results]),
        "cost": np.array([result.cost for result in results]),
    }
    numbers = [
        [int(index), int(result.outcome), result.iterations]
        for index, result in zip(indices, results, strict=True)
    ]
    words = json.dumps([numbers, [str(result.reason) for result in results]]).encode()
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, words=np.frombuffer(words, np.uint8), **arrays)
    return buffer.getvalue()


def _unpack(record: bytes) -> dict[int, Attempt]:
    # Compressed arrays are refused: a few bytes could expand to gigabytes.
    arrays = read_arrays(record, max_bytes=8 * len(record), stored=True)
    numbers, reasons = parse_json(arrays["words"].tobytes().decode())
    path, rate, cost = (arrays[name] for name in ("path", "rate", "cost"))
    return {
        index: Attempt(
            path=path[i],
            rate=rate[i],
            cost=float(cost[i]),
            outcome=Outcome(outcome),
            iterations=iterations,
            reason=reasons[i],
        )
        for i, (index, outcome, iterations) in enumerate(numbers)
    }
