"""Progress on stderr: a bar on a terminal, otherwise one line at the start and one at the end."""

import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from cnpgen.errors import counted

if TYPE_CHECKING:
    from cnpgen.store.sampling_statistics import SamplingStatistics


class Meter:
    """Counts items, named by a noun, and their sampling statistics since the last ``begin``; prints unless quiet."""

    def __init__(self, *, quiet: bool = False, noun: str = "row") -> None:
        self.rows = 0
        self.sampling: SamplingStatistics | None = None
        self._quiet, self._noun = quiet, noun
        self._start = self._begun = time.perf_counter()
        self._bar: Any = None

    def begin(self, title: str, total: int, initial: int = 0) -> None:
        """Show the start of a step with ``total`` samples, of which ``initial`` exist; the previous step is over."""
        self.close()
        self.rows, self.sampling, self._begun = 0, None, time.perf_counter()
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
            print(f"{title}: {counted(total, self._noun)}{there}", file=sys.stderr, flush=True)

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
            self.sampling = sampling if self.sampling is None else self.sampling.merge(sampling)
        if self._bar is not None:
            if self.sampling is not None:
                tried = self._bar.format_sizeof(self.sampling.tried)
                share = self.sampling.accepted / max(self.sampling.tried, 1)
                self._bar.set_postfix_str(f"{tried} tried, {share:.1%} accepted", refresh=False)
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
