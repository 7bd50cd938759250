"""The training log: one JSON object per line, in a file that a resumed run goes on with."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cnpgen.store.files import machine_error


class Journal:
    """Appends to a log.

    Args:
        path: The file.
        step: Lines of later steps are dropped: the run is resumed here and will write them again.
    """

    def __init__(self, path: Path, step: int = 0) -> None:
        self.path = path
        self.lines = [line for line in _lines(path) if json.loads(line).get("step", 0) <= step] if step else []
        try:
            path.write_text("".join(f"{line}\n" for line in self.lines), encoding="utf-8")
        except OSError as error:
            raise machine_error("write", path, error) from error

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

    def records(self) -> list[dict[str, Any]]:
        """The whole log, read."""
        return [json.loads(line) for line in self.lines]


def _lines(path: Path) -> list[str]:
    """Read the whole lines of a log; the last one may have been cut off."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    whole = text[: text.rfind("\n") + 1].splitlines()
    return [line for line in whole if _is_record(line)]


def _is_record(line: str) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except ValueError:
        return False
