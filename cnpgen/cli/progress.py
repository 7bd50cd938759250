"""Progress on stderr: a bar where somebody watches, a line at the start and one at the end where nobody does."""

import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cnpgen.outcome import Outcome


class Meter:
    """Counts rows, and what became of their draws.

    Args:
        quiet: Whether to show nothing.

    Attributes:
        rows: Rows counted so far, without ``initial``.
        outcome: The fates of their draws.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self.rows = 0
        self.outcome: Outcome | None = None
        self._quiet = quiet
        self._start = time.perf_counter()
        self._bar: Any = None

    def begin(self, title: str, total: int, initial: int = 0) -> None:
        """Show that something begins.

        Args:
            title: What is going on.
            total: Rows at the end.
            initial: Rows that are there already.
        """
        if not self._quiet and sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(
                desc=title, total=total, initial=initial, unit="row", unit_scale=True, dynamic_ncols=True, leave=False
            )
        elif not self._quiet:
            there = f", {initial:,} are there already" if initial else ""
            print(f"{title}: {total:,} rows{there}", file=sys.stderr, flush=True)

    @property
    def seconds(self) -> float:
        """Time since the meter was made [s]."""
        return time.perf_counter() - self._start

    def __call__(self, rows: int, outcome: "Outcome | None" = None) -> None:
        """Count the rows of a shard."""
        self.rows += rows
        if outcome is not None:
            self.outcome = outcome if self.outcome is None else self.outcome.merge(outcome)
        if self._bar is not None:
            if self.outcome is not None:
                share = self.outcome.accepted / max(self.outcome.tried, 1)
                self._bar.set_postfix_str(f"{share:.1%} of draws accepted", refresh=False)
            self._bar.update(rows)

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            with suppress(OSError):
                self._bar.close()
