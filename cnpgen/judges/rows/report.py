"""What verification found: the worst value of every check, and which rows fail any of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import End

ENDS: tuple[End, End] = ("start", "goal")

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Check:
    """One named check over all states that were verified.

    Attributes:
        name: What was checked, as its condition is named.
        unit: SI unit of ``worst`` and ``allowed``.
        worst: The violation that exceeds what is allowed by the largest factor; inf if it could not be evaluated.
        allowed: What is allowed there.
        rows_out: Number of rows with a violation larger than allowed, at either end.
        worst_row: The row of ``worst``, -1 if no row was checked.
        worst_end: The end of the motion of ``worst``.
    """

    name: str
    unit: str
    worst: float
    allowed: float
    rows_out: int
    worst_row: int
    worst_end: End

    @property
    def severity(self) -> float:
        """How many times larger than allowed the worst violation is."""
        if self.allowed > 0:
            return self.worst / self.allowed
        return math.inf if self.worst > 0 else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the check for JSON, which knows no infinity: an infinite ``worst`` is None."""
        worst = self.worst if math.isfinite(self.worst) else None
        return {**vars(self), "worst": worst}


@dataclass(frozen=True)
class RowReport:
    """What verification found in a number of rows.

    Attributes:
        rows: Number of rows.
        checks: The checks, in the order in which they were made.
        out: The rows that fail any check, ascending, shape (n_out,).
    """

    rows: int
    checks: tuple[Check, ...]
    out: Index

    @property
    def ok(self) -> bool:
        """Whether every row passes every check."""
        return len(self.out) == 0

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that some row fails."""
        return tuple(check for check in self.checks if check.rows_out)

    def to_dict(self) -> dict[str, Any]:
        """Return the report for JSON."""
        return {"rows": self.rows, "out": self.out.tolist(), "checks": [check.to_dict() for check in self.checks]}


def compare(name: str, unit: str, *, violation: Array, allowed: Array, row: Index, end: Index) -> tuple[Check, Index]:
    """Compare measured violations with what is allowed.

    Args:
        name: What is checked.
        unit: SI unit of the violations.
        violation: How far each value is out of its bounds, shape (k,); nan counts as infinite.
        allowed: What is allowed, shape (k,).
        row: The row of each value, shape (k,).
        end: Its end as an index of ``ENDS``, shape (k,).

    Returns:
        The check and the rows that fail it, ascending.
    """
    if violation.size == 0:
        return Check(name, unit, 0.0, 0.0, 0, -1, "start"), np.empty(0, np.int64)
    violation = np.where(np.isnan(violation), np.inf, violation)
    out = np.unique(row[violation > allowed])
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        severity = np.where(violation > 0, violation / allowed, 0.0)
    worst = int(np.argmax(severity))
    where = int(row[worst]), ENDS[int(end[worst])]
    return Check(name, unit, float(violation[worst]), float(allowed[worst]), len(out), *where), out


def merge(reports: Sequence[RowReport]) -> RowReport:
    """Join the reports of consecutive blocks of rows into one of them all; rows count from the first block's first."""
    first = np.cumsum([0, *(report.rows for report in reports)])
    checks: dict[tuple[str, str], Check] = {}
    for report, shift in zip(reports, first.tolist(), strict=False):
        for check in report.checks:
            key = check.name, check.unit
            checks[key] = _joined(checks.get(key), check, shift)
    out = [report.out + shift for report, shift in zip(reports, first[:-1], strict=True)]
    return RowReport(int(first[-1]), tuple(checks.values()), np.concatenate([np.empty(0, np.int64), *out]))


def _joined(before: Check | None, check: Check, shift: int) -> Check:
    """Add a check of rows that begin at ``shift`` to the same check of the rows before."""
    row = check.worst_row + shift if check.worst_row >= 0 else -1
    rows_out = check.rows_out + (before.rows_out if before else 0)
    keep = before is not None and before.worst_row >= 0 and (row < 0 or before.severity >= check.severity)
    worst, row = (before, before.worst_row) if before is not None and keep else (check, row)
    return Check(check.name, check.unit, worst.worst, worst.allowed, rows_out, row, worst.worst_end)
