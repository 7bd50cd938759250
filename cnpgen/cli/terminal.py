r"""The output streams of every command, progress and tables: untrusted text must not control a terminal.

Titles, names and texts of files may hold control characters of terminals, or marks that
turn the direction of writing. They are printed as ``\u001b``, as JSON has them, so that
output which is JSON stays the same JSON.
"""

import re
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from textwrap import TextWrapper
from typing import TYPE_CHECKING, Any, TextIO

from cnpgen.errors import counted

if TYPE_CHECKING:
    from cnpgen.store.sampling_statistics import SamplingStatistics

LINE_WIDTH = 100  # of tables and wrapped lines

# What is not printed: control characters but newline and tab, and marks of direction
# (Unicode, bidirectional controls).
_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]"
)


def printable(text: str) -> str:
    r"""Write the control characters of a text as ``\u001b``."""
    return _CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


class Printable:
    """A stream that prints what is printable.

    Bars of progress, which move on a line, write to its ``terminal``.
    """

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
            error.filename = error.filename or str(
                getattr(self.terminal, "name", "")
            ).strip("<>")
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


class Meter:
    """Counts items, named by a noun, and their sampling statistics since the last ``begin``; prints unless quiet.

    On a terminal it shows a bar, otherwise one line at the start of each step.
    """

    def __init__(self, *, quiet: bool = False, noun: str = "row") -> None:
        self.rows = 0
        self.sampling: SamplingStatistics | None = None
        self._quiet = quiet
        self._noun = noun
        self._start = self._begun = time.perf_counter()
        self._bar: Any = None

    def begin(self, title: str, total: int, initial: int = 0) -> None:
        """Show the start of a step with ``total`` samples, of which ``initial`` exist; the previous step is over."""
        self.close()
        self.rows = 0
        self.sampling = None
        self._begun = time.perf_counter()
        # A terminal has a bar that moves; a file or a pipe gets one line per step.
        if not self._quiet and sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(
                desc=title,
                total=total,
                initial=initial,
                unit=self._noun,
                unit_scale=True,
                leave=False,
                file=getattr(sys.stderr, "terminal", sys.stderr),
                dynamic_ncols=True,
            )
        elif not self._quiet:
            there = f", {initial:,} exist already" if initial else ""
            print(
                f"{title}: {counted(total, self._noun)}{there}",
                file=sys.stderr,
                flush=True,
            )

    @property
    def seconds(self) -> float:
        """Time since the meter was made [s]."""
        return time.perf_counter() - self._start

    @property
    def running(self) -> float:
        """Time since the last ``begin`` [s]."""
        return time.perf_counter() - self._begun

    def __call__(self, rows: int, sampling: "SamplingStatistics | None" = None) -> None:
        """Count the rows of a shard."""
        self.rows += rows
        if sampling is not None:
            self.sampling = (
                sampling if self.sampling is None else self.sampling.merge(sampling)
            )
        if self._bar is not None:
            if self.sampling is not None:
                tried = self._bar.format_sizeof(self.sampling.tried)
                # The number of draws may be 0 at the start.
                share = self.sampling.accepted / max(self.sampling.tried, 1)
                self._bar.set_postfix_str(
                    f"{tried} tried, {share:.1%} accepted", refresh=False
                )
            self._bar.update(rows)

    def note(self, text: str) -> None:
        """Show a text beside the bar."""
        if self._bar is not None:
            self._bar.set_postfix_str(text, refresh=False)

    def __enter__(self) -> "Meter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            with suppress(OSError):
                self._bar.close()
            self._bar = None


def table(
    rows: Sequence[Sequence[Any]],
    *,
    indent: str = "",
    right: Sequence[int] = (),
    one_line: bool = False,
    width: int = LINE_WIDTH,
) -> list[str]:
    """Lay out rows of the same length as aligned columns, those in ``right`` to the right; return the lines.

    The last column is wrapped to the width or, with ``one_line``, cut; a path in it
    stays in one piece, for scripts.
    """
    widths = [
        max(len(row[column]) for row in rows) for column in range(len(rows[0]) - 1)
    ]
    # Further lines of the last column begin below its first one: two spaces per column.
    hanging = indent + " " * (sum(widths) + 2 * len(widths))
    space = max(width - len(hanging), 30)
    count = 1 if one_line else None
    wrapper = TextWrapper(
        space,
        break_on_hyphens=False,
        break_long_words=one_line,
        max_lines=count,
        placeholder=" ...",
    )
    lines = []
    for *cells, last in rows:
        pairs = enumerate(zip(cells, widths, strict=True))
        head = indent + "".join(
            f"{text.rjust(w) if i in right else text.ljust(w)}  "
            for i, (text, w) in pairs
        )
        parts = [str(last)] if isinstance(last, Path) else wrapper.wrap(last)
        lines += [
            (head + (parts[0] if parts else "")).rstrip(),
            *(hanging + part for part in parts[1:]),
        ]
    return lines
