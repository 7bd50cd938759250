"""Parquet files of sampled trajectories as tables: those of exported plans, and any others with one row per sample."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.trajectories.array_tables import with_units
from cnpgen.addons.trajectories.load_options import LoadOptions
from cnpgen.addons.trajectories.text_tables import text_array
from cnpgen.addons.trajectories.trajectory_table import TrajectoryTable, Values
from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError, requires_extra
from cnpgen.plans.format import JOINT_NAMES_KEY, PLAN_COLUMN
from cnpgen.plans.stated_units import UNIT_ATTRIBUTES
from cnpgen.store.files.atomic import read_file
from cnpgen.store.files.size_limits import MAX_TABLE_BYTES, MAX_TEXT_ARRAY_BYTES

MAX_PARQUET_VALUES = (
    25_000_000  # of a table: they take up to 50 bytes each while it is read
)
MAX_UNPACKED_BYTES = 1 << 30  # of the columns of Parquet


def read_parquet_tables(path: Path, _: LoadOptions) -> Iterator[TrajectoryTable]:
    """Yield the plans of an exported file, or the table of another one."""
    table = read_parquet(path)
    try:
        names = tuple(
            map(
                str,
                json.loads((table.schema.metadata or {}).get(JOINT_NAMES_KEY, b"[]")),
            )
        )
    except (ValueError, TypeError, RecursionError) as error:
        raise UsageError(
            f"{path}: its names of joints are no list of texts, or are damaged: {error}"
        ) from error
    columns = {name: _parquet_column(table, name, path) for name in table.column_names}
    columns = with_units(columns, _parquet_units(table, path))
    held = _parquet_metadata(table, b"held_joints", path)
    if names and PLAN_COLUMN in columns:
        # A table of cnpgen.
        index = columns.pop(PLAN_COLUMN)
        columns.pop("sample_id", None)
        for plan in dict.fromkeys(index.tolist()):
            rows = {name: values[index == plan] for name, values in columns.items()}
            yield TrajectoryTable(f"{path}: plan {plan}", rows, names, held_joints=held)
        return
    yield TrajectoryTable(str(path), columns)


def _parquet_metadata(table: Any, key: bytes, path: Path) -> JsonObject:
    """Return an object in the metadata of a table; empty without it."""
    try:
        found = json.loads((table.schema.metadata or {}).get(key, b"{}"))
        if isinstance(found, dict):
            return found
    except (ValueError, RecursionError):
        pass
    raise UsageError(f"{path}: its metadata {key.decode()!r} must be an object")


def _parquet_units(table: Any, path: Path) -> dict[str, str]:
    """Return the units of columns: those of the table's metadata, or of the metadata of its fields."""
    units = {
        field.name: field.metadata[name.encode()].decode()
        for field in table.schema
        for name in UNIT_ATTRIBUTES
        if name.encode() in (field.metadata or {})
    }
    stated = _parquet_metadata(table, b"units", path)
    # Of several units, one per joint, those of exports are in SI.
    return units | {
        name: unit for name, unit in stated.items() if not _is_of_joints(unit)
    }


def _is_of_joints(unit: Any) -> bool:
    """Return whether a unit of an export differs from joint to joint."""
    return not isinstance(unit, str) or "," in unit


def read_parquet(path: Path) -> Any:
    """Read a Parquet file as a table of pyarrow.

    Raise UsageError if it is damaged or too large.
    """
    with requires_extra("parquet", "pyarrow"):
        import pyarrow
        import pyarrow.parquet
    content = read_file(path, max_bytes=MAX_TABLE_BYTES)
    try:
        file = pyarrow.parquet.ParquetFile(pyarrow.BufferReader(content))
        size, n_bytes = _unpacked_size(file)
        if size <= MAX_PARQUET_VALUES and n_bytes <= MAX_UNPACKED_BYTES:
            return _parquet_table(pyarrow, content, file.schema)
    except (
        pyarrow.ArrowException,
        OSError,
        ValueError,
    ) as error:
        # Damaged headers; texts that are not UTF-8.
        raise UsageError(
            f"{path} is not a Parquet file, or is damaged: {error}"
        ) from error
    raise UsageError(
        f"{path} holds {size:,} values in {n_bytes:,} bytes, expected at most"
        f" {MAX_PARQUET_VALUES:,} in {MAX_UNPACKED_BYTES:,}"
    )


def _unpacked_size(file: Any) -> tuple[int, int]:
    """Return the numbers of values and of bytes of all columns when they are unpacked."""
    metadata = file.metadata
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    size = metadata.num_rows * metadata.num_columns
    n_bytes = sum(group.total_byte_size for group in groups)
    if size > MAX_PARQUET_VALUES or n_bytes > MAX_UNPACKED_BYTES:
        return size, n_bytes
    # A reader raises errors for damaged properties of columns; pyarrow's access to these
    # properties would end the process instead.
    for i in range(len(groups)):
        next(file.iter_batches(batch_size=1, row_groups=[i]), None)
    parts = [group.column(i) for group in groups for i in range(group.num_columns)]
    # Values that repeat take no space in the file, so values are counted.
    size = max(size, sum(part.num_values for part in parts))
    return size, max(n_bytes, sum(part.total_uncompressed_size for part in parts))


def _parquet_table(pyarrow: Any, content: bytes, schema: Any) -> Any:
    """Read a table whose texts stay in dictionaries, so that repeated long ones take no space.

    Raises:
        ValueError: A column of texts would be too large as an array.
    """
    columns = [schema.column(i) for i in range(len(schema))]
    texts = [part.path for part in columns if part.physical_type == "BYTE_ARRAY"]
    file = pyarrow.parquet.ParquetFile(
        pyarrow.BufferReader(content), read_dictionary=texts
    )
    # Every row group has dictionaries of its own. LeRobot writes lists of texts in
    # several groups, which pyarrow cannot read at once.
    groups = [file.read_row_group(i) for i in range(file.num_row_groups)]
    table = pyarrow.concat_tables(groups) if groups else file.read()
    for name in table.column_names:
        chunks = table.column(name).chunks
        if texts and any(map(pyarrow.types.is_nested, [table.column(name).type])):
            chunks = [chunk.flatten() for chunk in chunks]
        for chunk in chunks:
            if not pyarrow.types.is_dictionary(chunk.type):
                continue
            longest = max(
                (len(text) for text in chunk.dictionary.to_pylist() if text), default=0
            )
            if len(chunk) * longest > MAX_TEXT_ARRAY_BYTES:
                raise ValueError(
                    f"column {name!r}: {len(chunk):,} texts of {longest:,}"
                )
    return table


def _parquet_column(table: Any, name: str, path: Path) -> Values:
    """Return a column of numbers, lists of equal lengths, or texts as an array."""
    values = table.column(name).to_pylist()
    if values and all(isinstance(value, str) for value in values):
        return text_array(values)
    try:
        return np.array(values)
    except ValueError as error:
        raise UsageError(
            f"{path}: column {name!r}: its rows have different lengths"
        ) from error


def number_column(table: Any, name: str, path: Path, width: int) -> Values:
    """Return a column of numbers, or of lists of them, shape (rows, width)."""
    values = _parquet_column(table, name, path)
    try:
        return values.astype(float).reshape(table.num_rows, width)
    except (TypeError, ValueError) as error:
        text = f"{width} numbers" if width > 1 else "a number"
        raise UsageError(f"{path}: column {name!r}: expected {text} per row") from error
