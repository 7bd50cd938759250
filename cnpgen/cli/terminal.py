r"""The output stream of every command: untrusted text must not control the terminal that shows it.

Titles, names and texts of files may hold control characters of terminals, or marks that turn the direction of writing.
They are printed as ``\u001b``, as JSON has them, so that output which is JSON stays the same JSON.
"""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

# What is not printed: control characters but newline and tab, and marks of direction (Unicode, bidirectional controls).
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    r"""Write the control characters of a text as ``\u001b``."""
    return _CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


class Printable:
    """A stream that prints what is printable; bars of progress, which move on a line, write to its ``terminal``."""

    def __init__(self, stream: TextIO) -> None:
        self.terminal = stream

    def write(self, text: str) -> int:
        """Write a text."""
        with self._named():
            self.terminal.write(printable(text))
        return len(text)

    def flush(self) -> None:
        """Write what is still to be written."""
        with self._named():
            self.terminal.flush()

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Say of an error which stream it is of: a disk may be full behind it."""
        try:
            yield
        except OSError as error:
            error.filename = error.filename or str(getattr(self.terminal, "name", "")).strip("<>")
            raise

    def __getattr__(self, name: str) -> Any:
        return getattr(self.terminal, name)


@contextmanager
def printing_safely() -> Iterator[None]:
    """Let stdout and stderr show only what is printable, as long as the block lasts."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (Printable(stream) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
