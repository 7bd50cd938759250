"""Progress on stderr: a bar where somebody watches, a line at the start and one at the end where nobody does."""

import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from cnpgen.errors import counted

if TYPE_CHECKING:
    from cnpgen.store.fates import Fates


class Meter:
    """Counts rows, and what became of their draws.

    Args:
        quiet: Whether to show nothing.
        noun: What is counted.

    Attributes:
        rows: Rows counted since the last beginning, without ``initial``.
        fates: The fates of their draws.
    """

    def __init__(self, *, quiet: bool = False, noun: str = "row") -> None:
        self.rows = 0
        self.fates: Fates | None = None
        self._quiet, self._noun = quiet, noun
        self._start = self._begun = time.perf_counter()
        self._bar: Any = None

    def begin(self, title: str, total: int, initial: int = 0) -> None:
        """Show that something begins; what began before is over.

        Args:
            title: What is going on.
            total: Rows at the end.
            initial: Rows that are there already.
        """
        self.close()
        self.rows, self.fates, self._begun = 0, None, time.perf_counter()
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
            there = f", {initial:,} there already" if initial else ""
            print(f"{title}: {counted(total, self._noun)}{there}", file=sys.stderr, flush=True)

    @property
    def seconds(self) -> float:
        """Time since the meter was made [s]."""
        return time.perf_counter() - self._start

    @property
    def running(self) -> float:
        """Time since the last beginning [s]."""
        return time.perf_counter() - self._begun

    def __call__(self, rows: int, fates: "Fates | None" = None) -> None:
        """Count the rows of a shard."""
        self.rows += rows
        if fates is not None:
            self.fates = fates if self.fates is None else self.fates.merge(fates)
        if self._bar is not None:
            if self.fates is not None:
                tried = self._bar.format_sizeof(self.fates.tried)
                share = self.fates.accepted / max(self.fates.tried, 1)
                self._bar.set_postfix_str(f"{tried} tried, {share:.1%} accepted", refresh=False)
            self._bar.update(rows)

    def note(self, text: str) -> None:
        """Show a word beside the bar."""
        if self._bar is not None:
            self._bar.set_postfix_str(text, refresh=False)

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            with suppress(OSError):
                self._bar.close()
            self._bar = None
