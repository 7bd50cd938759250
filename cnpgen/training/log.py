"""The training log: one JSON object per line, in a file for who watches; what counts is in the checkpoint."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cnpgen.store.files.atomic import machine_error, write_file
from cnpgen.store.files.documents import parse_json

OURS = {"step", "epoch", "learning_rate", "seconds", "lost"}  # keys of the first line of every log


class TrainingLog:
    """Appends to a log.

    Args:
        path: The file; what is in it is replaced by ``lines``.
        lines: The log so far; new lines are appended to this very list, too.

    Raises:
        MachineError: The disk is full, read-only or otherwise unwilling.
    """

    def __init__(self, path: Path, lines: list[str]) -> None:
        self.path, self.lines = path, lines
        write_file(path, self.text)

    def write(self, record: Mapping[str, Any]) -> None:
        """Append a record.

        Raises:
            MachineError: The disk is full, read-only or otherwise unwilling.
        """
        line = json.dumps(record, allow_nan=False)
        self.lines.append(line)
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
        except OSError as error:
            raise machine_error("write", self.path, error) from error

    @property
    def text(self) -> str:
        """The whole log."""
        return "".join(f"{line}\n" for line in self.lines)


def is_log(path: Path) -> bool:
    """Whether a file is a training log, by its first line, or holds nothing yet."""
    try:
        with path.open("rb") as file:
            first = file.readline(1 << 16)
        record = parse_json(first.decode() or "null")
    except (OSError, ValueError):
        return False
    return not first or (isinstance(record, dict) and record.keys() >= OURS)
