"""One shard: an HDF5 file with one contiguous dataset per field and attributes that say what the numbers are.

The bytes of a shard depend on its rows, fields and attributes only, within one version of HDF5: no time, host or path.
"""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, nearest
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import committing
from cnpgen.store.files.hdf5 import create_hdf5, opened_hdf5

FORMAT = "cnpgen-shard"
FORMAT_VERSION = 1
_STORAGE = {"float64": "<f8", "float32": "<f4", "int64": "<i8"}


def storage_dtype(field: Field, dtype: str) -> np.dtype[Any]:
    """Return the little-endian type that a field is stored in.

    Args:
        field: The field.
        dtype: The dataset's float type, "float64" or "float32".

    Raises:
        DatasetError: There is no such type.
    """
    name = dtype if field.dtype == "float" else field.dtype
    if name not in _STORAGE:
        raise DatasetError(f"field {field.name!r} cannot be stored as {name!r}, only as one of {', '.join(_STORAGE)}")
    return np.dtype(_STORAGE[name])


def field_attributes(field: Field) -> dict[str, Any]:
    """Say what the numbers of a field are; arrays have shape (max(width, 1),)."""
    attributes: dict[str, Any] = {
        "units": field.unit,
        "long_name": field.long_name,
        "names": json.dumps(list(field.names)),
        "frame": field.frame,
        "role": field.role,
    }
    limits = {"valid_min": field.valid_min, "valid_max": field.valid_max}
    return attributes | {name: np.array(limit, "<f8") for name, limit in limits.items() if limit is not None}


def write_shard(
    path: Path,
    columns: Mapping[str, NDArray[Any]],
    fields: Sequence[Field],
    attributes: Mapping[str, str | int],
    *,
    dtype: str = "float64",
    work: Path | None = None,
) -> int:
    """Write a shard atomically; it is read back before it gets its name.

    Args:
        path: Where to.
        columns: Field name -> finite values, shape (rows, width) or (rows,), already in the type they are stored in.
        fields: The fields, in order; every one must have a column.
        attributes: File attributes; "rows" must be the number of rows.
        dtype: The dataset's float type, "float64" or "float32".
        work: Folder for the temporary file.

    Returns:
        Number of bytes written.

    Raises:
        DatasetError: The columns are not what the fields say, or not finite.
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    rows = int(attributes["rows"])
    _check_columns(columns, fields, rows, dtype)
    content = _encode(columns, fields, attributes, dtype)
    with committing(path, work) as temporary:
        temporary.write_bytes(content)
        with opened_hdf5(temporary) as file:
            shapes = {name: item.shape for name, item in file.columns().items()}
        if shapes != {field.name: _shape(field, rows) for field in fields}:
            raise DatasetError(f"{path} was not written as it was meant: found {shapes}")
    return len(content)


def _shape(field: Field, rows: int) -> tuple[int, ...]:
    return (rows, field.width) if field.width else (rows,)


def _check_columns(columns: Mapping[str, NDArray[Any]], fields: Sequence[Field], rows: int, dtype: str) -> None:
    """Refuse columns that do not fit the fields."""
    names = {field.name for field in fields}
    if columns.keys() != names or rows < 1:
        missing, extra = sorted(names - columns.keys()), sorted(columns.keys() - names)
        raise DatasetError(f"a shard needs rows and every field: {rows} rows, missing {missing}, unknown {extra}")
    for field in fields:
        values, shape, stored = columns[field.name], _shape(field, rows), storage_dtype(field, dtype)
        if values.shape != shape or values.dtype != stored:
            found = f"{values.dtype} of shape {values.shape}"
            raise DatasetError(f"field {field.name!r} must be {stored} of shape {shape}, got {found}")
        finite = np.isfinite(values)
        if not finite.all():
            bad = ~finite.reshape(rows, -1).all(axis=1)
            raise DatasetError(f"field {field.name!r} is not finite in {bad.sum()} rows, first in row {bad.argmax()}")


def _encode(
    columns: Mapping[str, NDArray[Any]], fields: Sequence[Field], attributes: Mapping[str, str | int], dtype: str
) -> memoryview:
    """Build the file in memory, where a full disk cannot leave half of it and errors are the system's own."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(create_hdf5(buffer)) as file:
        for field in fields:
            stored = storage_dtype(field, dtype)
            dataset = file.create_dataset(field.name, data=columns[field.name], dtype=stored, track_times=False)
            dataset.attrs.update(field_attributes(field))
        file.attrs.update({"format": FORMAT, "format_version": FORMAT_VERSION, **attributes})
    return buffer.getbuffer()


def read_shard(path: Path, fields: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read whole fields of a shard.

    Args:
        path: The shard.
        fields: Names of the fields; all by default.

    Returns:
        Field name -> values, shape (rows, width) or (rows,).

    Raises:
        DatasetError: The file is missing, damaged or cut off, or has no such field.
        MachineError: The system would not let us read it.
    """
    with opened_hdf5(path) as file:
        known = list(file)
        for name in fields or ():
            if name not in known:
                raise DatasetError(f"{path} has no field {name!r}{nearest(name, known)}")
        return {name: file[name].read() for name in (known if fields is None else fields)}


def read_attributes(path: Path, names: Sequence[str] | None = None) -> dict[str, str | int]:
    """Read a shard's file attributes.

    Args:
        path: The shard.
        names: Names of the attributes; all by default.

    Returns:
        Name -> value.

    Raises:
        DatasetError: The file is missing, damaged or cut off, or has no such attribute.
        MachineError: The system would not let us read it.
    """
    with opened_hdf5(path) as file:
        values = {name: file.attributes[name] for name in (file.attributes if names is None else names)}
        return {name: value if isinstance(value, str) else int(value) for name, value in values.items()}


@dataclass(frozen=True, eq=False)
class StoredField:
    """What a shard says about one of its datasets.

    Attributes:
        shape: Shape of the dataset.
        dtype: Its stored type.
        attributes: Its attributes.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    attributes: dict[str, Any]


def read_schema(path: Path) -> dict[str, StoredField]:
    """Read what a shard says about its datasets, without their values.

    Raises:
        DatasetError: The file is missing, damaged or cut off.
        MachineError: The system would not let us read it.
    """
    with opened_hdf5(path) as file:
        columns = file.columns()
        return {name: StoredField(item.shape, item.dtype, item.attributes.all()) for name, item in columns.items()}


@dataclass(frozen=True)
class Placement:
    """Where a shard keeps the values of a field.

    Attributes:
        shape: Shape of the values.
        dtype: Their stored type.
        offset: Where they begin in the file [bytes]; None if they are not there in one piece, as cnpgen writes them,
            but in chunks, maybe compressed.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    offset: int | None


def read_placements(path: Path) -> tuple[dict[str, Placement], dict[str, int]]:
    """Read where a shard keeps its fields, so that they can be mapped into memory, and which shard it is.

    Returns:
        Field name -> its place; and the file's attributes ``plan_key``, ``first_sample_id`` and ``rows``.

    Raises:
        DatasetError: The file is missing, damaged or cut off.
        MachineError: The system would not let us read it.
    """
    with opened_hdf5(path) as file:
        places = {name: Placement(item.shape, item.dtype, item.offset) for name, item in file.columns().items()}
        return places, {name: int(file.attributes[name]) for name in ("plan_key", "first_sample_id", "rows")}
