"""The training log: one JSON object per line, in a file to follow the run; the checkpoint has a copy."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cnpgen.store.files.atomic import write_file
from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.journal import append_line

FIRST_LINE_KEYS = {"step", "epoch", "learning_rate", "seconds", "lost"}


class TrainingLog:
    """A log that records are appended to.

    Args:
        path: The file; its content is replaced by ``lines``.
        lines: Previous lines of the log; new lines are appended to this list, too.

    Raises:
        MachineError: The disk is full or read-only.
    """

    def __init__(self, path: Path, lines: list[str]) -> None:
        self.path, self.lines = path, lines
        write_file(path, self.text)

    def write(self, record: Mapping[str, Any]) -> None:
        """Append a record.

        Raises:
            MachineError: The disk is full or read-only.
        """
        line = json.dumps(record, allow_nan=False)
        self.lines.append(line)
        append_line(self.path, line)

    @property
    def text(self) -> str:
        """Text of the whole log."""
        return "".join(f"{line}\n" for line in self.lines)


def is_log(path: Path) -> bool:
    """Return whether a file is a training log, by its first line, or empty."""
    try:
        with path.open("rb") as file:
            first = file.readline(1 << 16)
        record = parse_json(first.decode() or "null")
    except (OSError, ValueError):
        return False
    return not first or (isinstance(record, dict) and record.keys() >= FIRST_LINE_KEYS)
