"""The only entry point for the rows of a shard: every property is compared with the specification and the record."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from cnpgen.arrays import AnyArray, Columns
from cnpgen.errors import DatasetError
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import machine_errors
from cnpgen.store.intact import RERUN_HINT, require_intact, size_problem
from cnpgen.store.layout import SPECIFICATION
from cnpgen.store.scene_table import (
    SCENE_ARRAYS,
    SCENE_ID,
    SceneTable,
    check_scenes,
    check_shapes,
)
from cnpgen.store.shard import (
    StoredField,
    finite_problem,
    read_placements,
    read_shard,
    storage_dtype,
)

SAMPLE_ID = "sample_id"
PARAMETERS = "parameters"
STORED_ROUNDING = 1e-6  # relative


@dataclass(frozen=True, eq=False)
class Shard:
    """A shard of a dataset with its recorded size [bytes] and sha256, which are not needed to read its rows."""

    folder: Path
    spec: DatasetSpec
    task: ShardTask
    size: int = 0
    sha256: str = ""

    @cached_property
    def path(self) -> Path:
        """File of the shard."""
        return self.folder / self.task.file

    @property
    def rows(self) -> int:
        """Number of rows."""
        return self.task.rows

    def problem(self) -> str:
        """Describe the problem of the file without opening it.

        Empty if it has the recorded size.
        """
        return size_problem(self.path, self.size)


def read_checked(shard: Shard) -> Columns:
    """Verify a shard and read its fields; see ``read_rows``."""
    require_intact(shard.path, size=shard.size, sha256=shard.sha256)
    return read_rows(shard)


def read_rows(shard: Shard, names: Iterable[str] | None = None) -> Columns:
    """Read and check fields of a shard, by default all, after its sha256 was compared.

    The result is field name -> values as stored, shape (rows, width) or (rows,). A
    missing or damaged shard, and one that differs from the specification, raises
    DatasetError.
    """
    placements = check_header(shard)
    columns = read_columns(
        shard,
        placements,
        [item.name for item in shard.spec.fields] if names is None else names,
    )
    check_values(shard, columns)
    if names is None and shard.spec.scene_obstacles:
        read_scenes(shard, placements)
    return columns


def read_scenes(
    shard: Shard, placements: Mapping[str, StoredField] | None = None
) -> SceneTable:
    """Read and check the scenes of a shard after its sha256 was compared.

    ``check_header`` returns the placements.
    """
    placements = check_header(shard) if placements is None else placements
    names = [item.name for item in SCENE_ARRAYS]
    spec = shard.spec
    try:
        check_shapes(
            {name: placements[name].shape for name in names if name in placements},
            spec.scene_obstacles,
        )
        columns = read_columns(shard, placements, [SCENE_ID, *names])
        table = SceneTable(**{name: columns[name] for name in names}).astype(spec.dtype)
        check_scenes(
            table, spec.scene_obstacles, columns[SCENE_ID], len(spec.scene_families)
        )
    except DatasetError as error:
        raise DatasetError(f"{shard.path}: {error}") from error
    return table


def check_header(shard: Shard) -> dict[str, StoredField]:
    """Return the stored fields of a shard.

    Raise DatasetError if position, fields, shapes, types or sample IDs are not those of
    the specification.
    """
    placements, identity = read_placements(shard.path)
    spec = shard.spec
    task = shard.task
    # A shard of an extended dataset has the key of the version that first contained it.
    key = spec.version_with(task).key
    if identity != {
        "specification_key": key,
        "first_sample_id": task.first_row,
        "rows": task.rows,
    }:
        raise DatasetError(
            f"{shard.path} is of another dataset or another position in it; {RERUN_HINT}"
        )
    for item in spec.fields:
        check_field(shard, item, placements.get(item.name))
    if SAMPLE_ID in {item.name for item in spec.fields}:
        check_values(shard, read_columns(shard, placements, [SAMPLE_ID]))
    return placements


def check_field(shard: Shard, item: Field, placement: StoredField | None) -> None:
    """Raise an error if a field of a shard does not have the shape and type of the specification."""
    shape = item.shape(shard.rows)
    dtype = storage_dtype(item, shard.spec.dtype)
    if (
        placement is None
        or placement.shape != shape
        # The byte order of the file does not matter where it is that of the machine.
        or placement.dtype.newbyteorder("<") != dtype
    ):
        actual = (
            "is missing"
            if placement is None
            else f"is {placement.dtype} of shape {placement.shape}"
        )
        expected = f"expected {dtype} of shape {shape} by {SPECIFICATION}"
        raise DatasetError(f"{shard.path}: field {item.name!r} {actual}, {expected}")


def read_columns(
    shard: Shard, placements: Mapping[str, StoredField], names: Iterable[str]
) -> Columns:
    """Read fields of a shard after ``check_header``; values that are contiguous in the file are read directly.

    Reading a file that is truncated meanwhile raises DatasetError; reading its memory
    map would end the process.
    """
    selected = {name: placements[name] for name in names}
    # Chunked and packed datasets have no single position; HDF5 reads them.
    if any(place.offset is None for place in selected.values()):
        return read_shard(shard.path, list(selected))
    columns: Columns = {}
    with machine_errors("read", shard.path), shard.path.open("rb", buffering=0) as file:
        for name, place in selected.items():
            columns[name] = np.empty(place.shape, place.dtype)
            file.seek(place.offset or 0)
            buffer = columns[name].data.cast("B")
            while buffer:
                # The system reads at most 2 GiB at once.
                if not (count := file.readinto(buffer)):
                    raise DatasetError(
                        f"{shard.path} was cut off while it was read; {RERUN_HINT}"
                    )
                buffer = buffer[count:]
    return columns


def check_values(shard: Shard, columns: Mapping[str, AnyArray]) -> None:
    """Raise DatasetError for values that are not finite, parameters out of range, and wrong sample IDs."""
    problem = finite_problem(columns) or _range_problem(shard.spec, columns)
    if problem:
        raise DatasetError(f"{shard.path}: {problem}")
    ids = columns.get(SAMPLE_ID)
    if ids is not None and not np.array_equal(
        ids, shard.task.first_row + np.arange(shard.rows)
    ):
        raise DatasetError(
            f"{shard.path}: sample_id is not the index of the row in the split"
        )


def _range_problem(spec: DatasetSpec, columns: Mapping[str, AnyArray]) -> str:
    """Describe the first parameter of the problem with a value outside of its range; empty if there is none."""
    fields = {field.name: field for field in spec.fields if field.valid_max}
    if PARAMETERS not in columns.keys() & fields.keys():
        return ""
    rows = columns[PARAMETERS]
    field = fields[PARAMETERS]
    low = np.array(field.valid_min)
    high = np.array(field.valid_max)
    # Ends of a range may be rounded to float32.
    slack = STORED_ROUNDING * np.maximum(np.abs(low), np.abs(high))
    outside = (rows < low - slack) | (rows > high + slack)
    if not outside.any():
        return ""
    row, column = np.argwhere(outside)[0]
    name = field.names[column] if field.names else PARAMETERS
    expected = f"from {low[column]:g} to {high[column]:g}"
    return f"{name} must be {expected}, got {rows[row, column]:g} in row {row}"
