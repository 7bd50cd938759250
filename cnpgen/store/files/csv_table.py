"""CSV tables of untrusted origin: named columns, read cell by cell with the place of every error."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import DatasetError
from cnpgen.store.files.size_limits import MAX_TABLE_COLUMNS, MAX_TEXT_TABLE_BYTES


@dataclass(frozen=True)
class CsvTable:
    """Table with different column names in its first line.

    The other lines have their number in the file.
    """

    path: Path
    names: tuple[str, ...]
    lines: tuple[tuple[int, list[str]], ...]

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column."""
        index = self.names.index(name)
        return [row[index].strip() for _, row in self.lines]

    def numbers(self, name: str) -> Array:
        """Return the numbers of a column, shape (rows,).

        Other cells raise DatasetError.
        """
        values = []
        for (line, _), cell in zip(self.lines, self.texts(name), strict=True):
            try:
                values.append(float(cell))
            except ValueError as error:
                raise DatasetError(
                    f"{self.path}: line {line}: {name} must be a number, got {cell!r:.60}"
                ) from error
        return np.array(values, np.float64)


def read_csv_table(path: Path, *, example: str) -> CsvTable:
    """Read a CSV table; messages name the columns of ``example``.

    A table that is too large, not UTF-8, or has no columns, equal ones, or rows of
    another length raises DatasetError.
    """
    if (size := path.stat().st_size) > MAX_TEXT_TABLE_BYTES:
        raise DatasetError(
            f"{path} has {size:,} bytes, expected a table of at most {MAX_TEXT_TABLE_BYTES:,}"
        )
    try:
        # Spreadsheets write a byte order mark.
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = [
                (number, row)
                for number, row in enumerate(csv.reader(file), 1)
                if any(map(str.strip, row))
            ]
    except (UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path} is not a CSV table in UTF-8: {error}") from error
    if not lines:
        raise DatasetError(
            f"{path} is empty: its first line must name columns, such as {example}"
        )
    names = [cell.strip() for cell in lines[0][1]]
    # With these separators, decimal commas would be read as columns.
    if other := next((mark for mark in ";\t" if mark in "".join(names)), None):
        raise DatasetError(
            f"{path}: line 1: columns are separated by ',', got {other!r}; numbers have '.', as in 0.5"
        )
    if len(names) > MAX_TABLE_COLUMNS:
        raise DatasetError(
            f"{path}: line 1 names {len(names):,} columns, expected at most {MAX_TABLE_COLUMNS:,}"
        )
    if twice := [name for name in names if names.count(name) > 1]:
        raise DatasetError(f"{path}: the column {twice[0]!r} is there more than once")
    for number, row in lines[1:]:
        if len(row) != len(names):
            raise DatasetError(
                f"{path}: line {number} has {len(row)} values, the first line names {len(names)} "
                "columns"
            )
    return CsvTable(path, tuple(names), tuple(lines[1:]))
