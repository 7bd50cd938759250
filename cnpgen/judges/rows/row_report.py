"""Results of the verification of rows: the worst value of every check, and the rows that fail."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.documents import JsonObject
from cnpgen.problems.constraints.constraint import End

ENDS: tuple[End, End] = ("start", "goal")

Index = NDArray[np.int64]


@dataclass(frozen=True)
class Check:
    """Result of one check over all states that were verified.

    Attributes:
        name: Name of the check, that of its condition.
        unit: SI unit of ``worst`` and ``tolerance``.
        worst: Violation with the largest ratio to its tolerance; inf if it could not be
            evaluated.
        tolerance: Tolerance of that violation.
        n_failed: Number of rows with a violation above its tolerance, at either end.
        worst_row: Row of ``worst``, -1 if no row was checked.
        worst_end: End of the motion of ``worst``.
    """

    name: str
    unit: str
    worst: float
    tolerance: float
    n_failed: int
    worst_row: int
    worst_end: End

    @property
    def severity(self) -> float:
        """Worst violation in multiples of its tolerance."""
        if self.tolerance > 0:
            return self.worst / self.tolerance
        return math.inf if self.worst > 0 else 0.0

    def to_dict(self) -> JsonObject:
        """Return the check for JSON; an infinite ``worst`` is None."""
        worst = self.worst if math.isfinite(self.worst) else None
        return {**vars(self), "worst": worst}


@dataclass(frozen=True)
class RowReport:
    """Result of the verification of rows.

    Attributes:
        rows: Number of rows.
        checks: Results of the checks, in the order in which they were made.
        failed_rows: Rows that fail any check, ascending, shape (n_failed,).
    """

    rows: int
    checks: tuple[Check, ...]
    failed_rows: Index

    @property
    def ok(self) -> bool:
        """Whether every row passes every check."""
        return len(self.failed_rows) == 0

    @property
    def failed(self) -> tuple[Check, ...]:
        """Checks that at least one row fails."""
        return tuple(check for check in self.checks if check.n_failed)

    def to_dict(self) -> JsonObject:
        """Return the report for JSON."""
        checks = [check.to_dict() for check in self.checks]
        return {
            "rows": self.rows,
            "failed_rows": self.failed_rows.tolist(),
            "checks": checks,
        }


def compare(
    name: str,
    unit: str,
    *,
    violation: Array,
    tolerance: Array | float,
    row: Index,
    end: Index | int = 1,
) -> tuple[Check, Index]:
    """Compare k violations of rows, shape (k,), with their tolerances; return also the rows that fail, ascending.

    A violation of nan counts as infinite. Tolerances, and ends as indices of ``ENDS``,
    have shape (k,) or are those of all; the end is the goal by default.
    """
    if violation.size == 0:
        return Check(name, unit, 0.0, 0.0, 0, -1, "start"), np.empty(0, np.int64)
    tolerance = np.broadcast_to(tolerance, violation.shape)
    end = np.broadcast_to(end, violation.shape)
    # A value that cannot be evaluated fails.
    violation = np.where(np.isnan(violation), np.inf, violation)
    failed = np.unique(row[violation > tolerance])
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        # A tolerance of zero: any violation is infinitely severe.
        severity = np.where(violation > 0, violation / tolerance, 0.0)
    worst = int(np.argmax(severity))
    worst_row = int(row[worst])
    worst_end = ENDS[int(end[worst])]
    check = Check(
        name,
        unit,
        float(violation[worst]),
        float(tolerance[worst]),
        len(failed),
        worst_row,
        worst_end,
    )
    return check, failed


def merge(reports: Sequence[RowReport]) -> RowReport:
    """Merge the reports of consecutive blocks of rows.

    Rows are counted from the start of the first block.
    """
    first = np.cumsum([0, *(report.rows for report in reports)])
    checks: dict[tuple[str, str], Check] = {}
    for report, shift in zip(reports, first.tolist(), strict=False):
        for check in report.checks:
            key = check.name, check.unit
            checks[key] = _joined(checks.get(key), check, shift)
    failed = [
        report.failed_rows + shift
        for report, shift in zip(reports, first[:-1], strict=True)
    ]
    return RowReport(
        int(first[-1]),
        tuple(checks.values()),
        np.concatenate([np.empty(0, np.int64), *failed]),
    )


def _joined(before: Check | None, check: Check, shift: int) -> Check:
    """Add the result for rows that start at ``shift`` to the result for the rows before."""
    row = check.worst_row + shift if check.worst_row >= 0 else -1
    n_failed = check.n_failed + (before.n_failed if before else 0)
    # The first of equal results stays, so that the report does not depend on the
    # blocks.
    keep_before = (
        before is not None
        and before.worst_row >= 0
        and (row < 0 or before.severity >= check.severity)
    )
    worst, row = (
        (before, before.worst_row)
        if before is not None and keep_before
        else (check, row)
    )
    return Check(
        check.name,
        check.unit,
        worst.worst,
        worst.tolerance,
        n_failed,
        row,
        worst.worst_end,
    )
