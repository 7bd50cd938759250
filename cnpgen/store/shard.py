"""A shard: an HDF5 file with one contiguous dataset per field and attributes that describe it.

The bytes of a shard depend only on its rows, fields and attributes and on the version
of HDF5, not on time, host or path.
"""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray, Columns
from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError, nearest
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import committing
from cnpgen.store.files.hdf5 import create_hdf5, open_hdf5
from cnpgen.store.scene_table import SceneTable, scene_attributes

SHARD_FORMAT = "cnpgen-shard"
SHARD_VERSION = 2
_STORAGE = {"float64": "<f8", "float32": "<f4", "int64": "<i8"}


def storage_dtype(field: Field, dtype: str) -> np.dtype[Any]:
    """Return the little-endian type of a field in a dataset of the float type "float64" or "float32"."""
    name = dtype if field.dtype == "float" else field.dtype
    if name not in _STORAGE:
        raise DatasetError(
            f"field {field.name!r} cannot be stored as {name!r}, only as one of {', '.join(_STORAGE)}"
        )
    return np.dtype(_STORAGE[name])


def field_attributes(field: Field) -> JsonObject:
    """Return the HDF5 attributes of a field; arrays have shape (max(width, 1),)."""
    attributes: JsonObject = {
        "units": field.unit,
        "long_name": field.long_name,
        "names": json.dumps(list(field.names)),
        "frame": field.frame,
        "role": field.role,
    }
    limits = {"valid_min": field.valid_min, "valid_max": field.valid_max}
    return attributes | {
        name: np.array(limit, "<f8")
        for name, limit in limits.items()
        if limit is not None
    }


def write_shard(
    path: Path,
    columns: Mapping[str, AnyArray],
    fields: Sequence[Field],
    attributes: Mapping[str, str | int],
    *,
    dtype: str = "float64",
    scenes: SceneTable | None = None,
    families: Sequence[str] = (),
    work: Path | None = None,
) -> int:
    """Write a shard atomically, and read it back before it is renamed; return the size of the file [bytes].

    Columns are finite, in their stored type, of shape (rows, width) or (rows,), one for
    every field; others raise DatasetError. The attribute "rows" must be their number.
    The scenes are in their stored types, too.
    """
    rows = int(attributes["rows"])
    _check_columns(columns, fields, rows, dtype)
    arrays = {} if scenes is None else dict(scenes.arrays())
    about_scenes = scene_attributes(families)
    parts = [
        (
            f.name,
            np.asarray(columns[f.name], storage_dtype(f, dtype)),
            field_attributes(f),
        )
        for f in fields
    ]
    parts += [(name, values, about_scenes[name]) for name, values in arrays.items()]
    content = _encode(parts, attributes)
    with committing(path, work) as temporary:
        temporary.write_bytes(content)
        # A file that cannot be read is never renamed.
        with open_hdf5(temporary) as file:
            shapes = {name: item.shape for name, item in file.columns().items()}
        expected = {field.name: field.shape(rows) for field in fields}
        if shapes != expected | {name: values.shape for name, values in arrays.items()}:
            raise DatasetError(
                f"{path} was not written correctly: it has the shapes {shapes}"
            )
    return len(content)


def _check_columns(
    columns: Mapping[str, AnyArray], fields: Sequence[Field], rows: int, dtype: str
) -> None:
    """Raise an error if the columns do not fit the fields."""
    names = {field.name for field in fields}
    if columns.keys() != names or rows < 1:
        missing = sorted(names - columns.keys())
        extra = sorted(columns.keys() - names)
        raise DatasetError(
            f"a shard needs rows and every field: {rows} rows, missing {missing}, unknown {extra}"
        )
    for field in fields:
        values = columns[field.name]
        shape = field.shape(rows)
        stored = storage_dtype(field, dtype)
        if values.shape != shape or values.dtype != stored:
            actual = f"{values.dtype} of shape {values.shape}"
            raise DatasetError(
                f"field {field.name!r} must be {stored} of shape {shape}, got {actual}"
            )
    if problem := finite_problem({field.name: columns[field.name] for field in fields}):
        raise DatasetError(problem)


def finite_problem(columns: Mapping[str, AnyArray]) -> str:
    """Describe the first column with a value that is not finite.

    Empty if there is none.
    """
    for name, values in columns.items():
        if values.dtype.kind == "f" and not _is_finite(values):
            bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
            return f"field {name!r} is not finite in {bad.sum()} rows, first in row {bad.argmax()}"
    return ""


def _is_finite(values: AnyArray) -> bool:
    """Return whether all values are finite.

    Their sum, which needs no memory, is infinite only by overflow.
    """
    with np.errstate(all="ignore"):
        return bool(
            np.isfinite(values.sum(dtype=np.float64)) or np.isfinite(values).all()
        )


def _encode(
    parts: Sequence[tuple[str, AnyArray, JsonObject]],
    attributes: Mapping[str, str | int],
) -> memoryview:
    """Build the file in memory: a full disk then causes a plain system error, and no partial file."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(create_hdf5(buffer)) as file:
        for name, values, about in parts:
            dataset = file.create_dataset(
                name, data=values, dtype=values.dtype, track_times=False
            )
            dataset.attrs.update(about)
        file.attrs.update(
            {"format": SHARD_FORMAT, "format_version": SHARD_VERSION, **attributes}
        )
    return buffer.getbuffer()


def read_shard(path: Path, fields: Sequence[str] | None = None) -> Columns:
    """Read whole fields of a shard, by default all: field name -> values, shape (rows, width) or (rows,).

    A damaged file and an unknown field raise DatasetError.
    """
    with open_hdf5(path) as file:
        known = list(file)
        for name in fields or ():
            if name not in known:
                raise DatasetError(
                    f"{path} has no field {name!r}{nearest(name, known)}"
                )
        return {
            name: file[name].read() for name in (known if fields is None else fields)
        }


def read_attributes(
    path: Path, names: Sequence[str] | None = None
) -> dict[str, str | int]:
    """Read attributes of a shard, by default all; a missing one raises DatasetError."""
    with open_hdf5(path) as file:
        values = {
            name: file.attributes[name]
            for name in (file.attributes if names is None else names)
        }
        return {
            name: value if isinstance(value, str) else int(value)
            for name, value in values.items()
        }


@dataclass(frozen=True, eq=False)
class StoredField:
    """Shape, stored type and attributes of an HDF5 dataset in a shard; without attributes if they were not read.

    The offset is the position of the first value in the file [bytes]; None for chunks,
    which cnpgen does not write.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    offset: int | None
    attributes: JsonObject


def read_schema(path: Path) -> dict[str, StoredField]:
    """Read the descriptions of the datasets of a shard, without their values."""
    with open_hdf5(path) as file:
        columns = file.columns().items()
        return {
            name: StoredField(
                item.shape, item.dtype, item.offset, item.attributes.all()
            )
            for name, item in columns
        }


def read_placements(path: Path) -> tuple[dict[str, StoredField], dict[str, int]]:
    """Read the locations of the fields of a shard, without their attributes, and the identity of the shard.

    The identity consists of the attributes ``specification_key``, ``first_sample_id``
    and ``rows`` of the file.
    """
    with open_hdf5(path) as file:
        columns = file.columns().items()
        placements = {
            name: StoredField(item.shape, item.dtype, item.offset, {})
            for name, item in columns
        }
        return placements, {
            name: int(file.attributes[name])
            for name in ("specification_key", "first_sample_id", "rows")
        }
