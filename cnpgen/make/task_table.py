"""Task tables: CSV or HDF5 files with dataset columns such as ``goal_xyz.x`` and ``hit_angle``."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, UsageError, nearest
from cnpgen.schema.arguments import numbers
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import machine_errors
from cnpgen.store.files.csv_table import read_csv_table
from cnpgen.store.files.hdf5 import opened_hdf5
from cnpgen.store.files.kind import is_hdf5
from cnpgen.store.paths import HDF5_KINDS, require_file

Array = NDArray[np.float64]


def read_tasks(path: Path, fields: Mapping[str, Field], *, flat: bool) -> dict[str, Array]:
    """Read tasks with known fields from a table; on a table (``flat``), positions need no z.

    The file is CSV with column names in the first line, or HDF5 whose datasets are columns or whole fields of shape (N,
    width), in SI units.

    Returns:
        Name -> values, shape (N,) or (N, width); (N, 2) for positions without z.

    Raises:
        UsageError: The file does not exist or is of another kind.
        DatasetError: The file is damaged, has no tasks, an unknown column, or a value that is not a finite number.
        MachineError: The file cannot be read.
    """
    require_file(path, "a table of tasks, CSV or HDF5", kinds=("a text file", *HDF5_KINDS))
    with machine_errors("read", path):
        columns = _hdf5_columns(path) if is_hdf5(path) else _csv_columns(path)
    if columns and not any(values.size for values in columns.values()):
        raise DatasetError(f"{path} has no tasks: it names columns ({', '.join(columns)}), but has no numbers")
    known = {**fields, **{column: field for field in fields.values() for column in field.columns}}
    for name, values in columns.items():
        if name not in known:
            hint = nearest(name, [column for field in fields.values() for column in field.columns])
            text = f"tasks of this pipeline cannot give {name!r}{hint or ', only ' + ', '.join(fields)}"
            raise DatasetError(f"{path}: {text}")
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values).reshape(len(values), -1).all(axis=1)))
            raise DatasetError(f"{path}: {name} must be a finite number in every task, got {values[row]} in task {row}")
    found = {name: values for name, values in columns.items() if name in fields}
    for field in fields.values():
        parts = [column for column in field.columns if field.width and column in columns]
        if parts:
            found[field.name] = _joined(path, field, parts, columns, flat=flat)
    return found


def _joined(path: Path, field: Field, parts: list[str], columns: Mapping[str, Array], *, flat: bool) -> Array:
    """Stack the components of a field; the height of a position on a table is optional."""
    without = {f"{field.name}.z"} if flat and field.name.endswith("_xyz") else set()
    missing = [column for column in field.columns if column not in {*parts, *without}]
    if missing:
        raise DatasetError(f"{path} lacks {', '.join(missing)} beside {', '.join(parts)}")
    return np.stack([columns[name] for name in parts], axis=1)


def _hdf5_columns(path: Path) -> dict[str, Array]:
    with opened_hdf5(path) as file:
        found = {name: column.read() for name, column in file.columns().items()}
    try:
        columns: dict[str, Array] = {name: numbers(name, values) for name, values in found.items()}
    except UsageError as error:
        raise DatasetError(f"{path}: {error}") from error
    if len({len(values) if values.ndim else -1 for values in columns.values()}) > 1:
        shapes = ", ".join(f"{name} {values.shape}" for name, values in columns.items())
        raise DatasetError(f"{path}: columns must have one value per task each, got {shapes}")
    return columns


def _csv_columns(path: Path) -> dict[str, Array]:
    table = read_csv_table(path, example="goal_xyz.x,goal_xyz.y")
    return {name: table.numbers(name) for name in table.names}
