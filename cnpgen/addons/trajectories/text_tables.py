"""Text files of sampled trajectories: columns separated by commas, semicolons, tabs or spaces, with or without a head."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cnpgen.addons.trajectories.table_columns import is_number
from cnpgen.addons.trajectories.trajectory_table import TrajectoryTable, Values
from cnpgen.errors import UsageError
from cnpgen.store.files.size_limits import (
    MAX_TABLE_COLUMNS,
    MAX_TEXT_ARRAY_BYTES,
    MAX_TEXT_TABLE_BYTES,
)

TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".dat")
_COMMENTS = "#%"  # of NumPy and MATLAB
_SEPARATORS = (",", ";", "\t")  # in the order in which they are found; otherwise spaces
_EXAMPLE = "t,joint_1,joint_2"

Line = tuple[int, list[str]]  # number in the file, cells


def read_text_table(path: Path, separator: str | None) -> TrajectoryTable:
    """Read a text file as one table.

    The head is the first line, unless it has numbers only, or the last comment before
    the rows if it has as many names as they have numbers. Columns without a head are
    numbered from 0.

    Raises:
        UsageError: The file is too large, not UTF-8, or empty, a row has another
            length, or a column is there more than once.
    """
    lines, comment = _lines(path)
    if not lines:
        raise UsageError(
            f"{path} is empty: its first line must name columns, such as {_EXAMPLE}"
        )
    separator = separator or _separator_of(lines[0][1])
    rows = _cells(path, lines, separator)
    head = None
    if not all(map(is_number, rows[0][1])):
        head = rows[0][1]
        rows = rows[1:]
    elif comment is not None:
        names = _cells(path, [comment], _separator_of(comment[1], separator))[0][1]
        head = names if len(names) == len(rows[0][1]) else None
    width = len(rows[0][1] if head is None else head)
    # A comma at the end of lines makes a column without a name.
    names = [f"column {k}" for k in range(1, width + 1)]
    names = (
        [*map(str, range(width))]
        if head is None
        else [name or number for name, number in zip(head, names, strict=True)]
    )
    _check(path, names, rows)
    return TrajectoryTable(
        str(path),
        {name: _column([row[k] for _, row in rows]) for k, name in enumerate(names)},
        lines=tuple(number for number, _ in rows),
        has_head=head is not None,
    )


def _lines(path: Path) -> tuple[list[tuple[int, str]], tuple[int, str] | None]:
    """Return the lines with their numbers, and the last comment before them."""
    if (size := path.stat().st_size) > MAX_TEXT_TABLE_BYTES:
        raise UsageError(
            f"{path} has {size:,} bytes, expected a table of at most {MAX_TEXT_TABLE_BYTES:,}"
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UsageError(f"{path} is not a table in UTF-8: {error}") from error
    lines = list[tuple[int, str]]()
    comment = None
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if stripped[:1] in {*_COMMENTS} and stripped:
            comment = comment if lines else (number, stripped.lstrip(_COMMENTS))
        elif stripped.strip(",;"):
            lines.append((number, line))
    return lines, comment


def _separator_of(line: str, default: str = " ") -> str:
    """Return the separator of a line: the first of those that it contains."""
    return next((mark for mark in _SEPARATORS if mark in line), default)


def _cells(path: Path, lines: Sequence[tuple[int, str]], separator: str) -> list[Line]:
    """Separate the cells of lines; several spaces are one separator."""
    numbers, texts = zip(*lines, strict=True)
    if separator.isspace() and separator != "\t":
        rows = [text.split() for text in texts]
    else:
        try:
            rows = list(csv.reader(texts, delimiter=separator, strict=True))
        except csv.Error as error:
            raise UsageError(f"{path} is not a table of texts: {error}") from error
        if len(rows) != len(lines):
            raise UsageError(f"{path}: a quoted text must end in its line")
    return [
        (number, [cell.strip() for cell in row])
        for number, row in zip(numbers, rows, strict=True)
    ]


def _check(path: Path, names: Sequence[str], rows: Sequence[Line]) -> None:
    """Check the names of columns and the lengths of rows."""
    if len(names) > MAX_TABLE_COLUMNS:
        raise UsageError(
            f"{path} has {len(names):,} columns, expected at most {MAX_TABLE_COLUMNS:,}"
        )
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"{path}: the column {twice[0]!r} is there more than once")
    for number, row in rows:
        if len(row) != len(names):
            text = f"{path}: line {number} has {len(row)} values, the first line names {len(names)} columns"
            raise UsageError(text)


def _column(cells: Sequence[str]) -> Values:
    """Return a column of numbers, or of texts, which are an error only if they are used."""
    try:
        return np.array([float(cell) for cell in cells])
    except ValueError:
        return text_array(cells)


def text_array(texts: Sequence[str]) -> Values:
    """Return texts as an array.

    Raises:
        UsageError: It would be too large, since all texts get the length of the longest.
    """
    longest = max(map(len, texts), default=0)
    if len(texts) * longest * np.dtype("U1").itemsize > MAX_TEXT_ARRAY_BYTES:
        raise UsageError(
            f"a column of {len(texts):,} texts has one of {longest:,} characters"
        )
    return np.array(texts, np.str_)
