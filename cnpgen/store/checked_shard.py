"""The only entry point for the rows of a shard: every property is compared with the specification and the record."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import machine_error
from cnpgen.store.intact import RERUN_HINT, require_intact, size_problem
from cnpgen.store.layout import SPECIFICATION
from cnpgen.store.scene_table import SCENE_ARRAYS, SCENE_ID, SceneTable, check_scenes, check_shapes
from cnpgen.store.shard import Placement, read_placements, read_shard, storage_dtype
from cnpgen.store.shard_record import ShardRecord

SAMPLE_ID = "sample_id"


@dataclass(frozen=True)
class Shard:
    """A shard with its recorded properties.

    Attributes:
        path: File of the shard.
        rows: Number of rows.
        first_row: Index of its first row within the split.
        size: Size of the file [bytes].
        sha256: sha256 of the file.
        key: Key of the specification, which the file contains, too.
        dtype: Stored type of float fields, "float64" or "float32".
        fields: Fields of the specification.
        scene_obstacles: Largest number of obstacles of a scene; 0 for a dataset without scenes.
        scene_families: Number of families of scenes.
    """

    path: Path
    rows: int
    first_row: int
    size: int
    sha256: str
    key: int
    dtype: str
    fields: tuple[Field, ...] = field(repr=False)
    scene_obstacles: int = 0
    scene_families: int = 0

    def problem(self) -> str:
        """Describe the problem of the file without opening it; empty if it has the recorded size."""
        return size_problem(self.path, self.size)


def recorded_shard(folder: Path, spec: DatasetSpec, task: ShardTask, *, size: int, sha256: str) -> Shard:
    """Return a shard of a dataset.

    Args:
        folder: Folder of the dataset.
        spec: Specification of the dataset.
        task: The shard.
        size: Recorded size of the file [bytes].
        sha256: Recorded sha256 of the file.
    """
    key = spec.version_with(task).key
    scenes = spec.scene_obstacles, len(spec.scene_families)
    path, fields = folder / task.file, tuple(spec.fields)
    return Shard(path, task.rows, task.first_row, size, sha256, key, spec.dtype, fields, *scenes)


def shard_of_record(folder: Path, spec: DatasetSpec, task: ShardTask, record: ShardRecord) -> Shard:
    """Return a shard of a dataset with the size and the sha256 of its sidecar."""
    return recorded_shard(folder, spec, task, size=record.bytes, sha256=record.sha256)


def read_checked(shard: Shard) -> dict[str, NDArray[Any]]:
    """Verify a shard and read its fields; see ``read_rows``."""
    require_intact(shard.path, size=shard.size, sha256=shard.sha256)
    return read_rows(shard)


def read_rows(shard: Shard, names: Iterable[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read and check fields of a shard whose sha256 was compared before.

    Args:
        shard: The shard.
        names: Names of the fields; all fields by default.

    Returns:
        Field name -> values as stored, shape (rows, width) or (rows,).

    Raises:
        DatasetError: The shard is missing or damaged, or differs from its record or the specification.
    """
    placements = check_header(shard)
    columns = read_columns(shard, placements, [item.name for item in shard.fields] if names is None else names)
    check_values(shard, columns)
    if names is None and shard.scene_obstacles:
        read_scenes(shard, placements)
    return columns


def read_scenes(shard: Shard, placements: Mapping[str, Placement] | None = None) -> SceneTable:
    """Read and check the scenes of a shard whose sha256 was compared before.

    Args:
        shard: The shard, of a dataset with scenes.
        placements: Result of ``check_header``, which is called by default.

    Raises:
        DatasetError: The scenes are missing or invalid.
    """
    placements = check_header(shard) if placements is None else placements
    names = [item.name for item in SCENE_ARRAYS]
    try:
        check_shapes({name: placements[name].shape for name in names if name in placements}, shard.scene_obstacles)
        columns = read_columns(shard, placements, [SCENE_ID, *names])
        table = SceneTable(**{name: columns[name] for name in names}).astype(shard.dtype)
        check_scenes(table, shard.scene_obstacles, columns[SCENE_ID], shard.scene_families)
    except DatasetError as error:
        raise DatasetError(f"{shard.path}: {error}") from error
    return table


def check_header(shard: Shard) -> dict[str, Placement]:
    """Compare position, fields, shapes, types and sample IDs of a shard with the specification.

    Returns:
        Field name -> location of its values.

    Raises:
        DatasetError: They differ, or the file is damaged.
    """
    placements, identity = read_placements(shard.path)
    if identity != {"specification_key": shard.key, "first_sample_id": shard.first_row, "rows": shard.rows}:
        raise DatasetError(f"{shard.path} is of another dataset or another position in it; {RERUN_HINT}")
    for item in shard.fields:
        check_field(shard, item, placements.get(item.name))
    if SAMPLE_ID in {item.name for item in shard.fields}:
        check_values(shard, read_columns(shard, placements, [SAMPLE_ID]))
    return placements


def check_field(shard: Shard, item: Field, placement: Placement | None) -> None:
    """Raise an error if a field of a shard does not have the shape and type of the specification."""
    shape = (shard.rows, item.width) if item.width else (shard.rows,)
    dtype = storage_dtype(item, shard.dtype)
    if placement is None or placement.shape != shape or placement.dtype.newbyteorder("<") != dtype:
        actual = "is missing" if placement is None else f"is {placement.dtype} of shape {placement.shape}"
        expected = f"expected {dtype} of shape {shape} by {SPECIFICATION}"
        raise DatasetError(f"{shard.path}: field {item.name!r} {actual}, {expected}")


def read_columns(shard: Shard, placements: Mapping[str, Placement], names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Read fields of a shard after ``check_header``; values that are contiguous in the file are read directly.

    Reading a file that is truncated meanwhile ends in an error; reading its memory map would end the process.

    Raises:
        DatasetError: The file is cut off.
    """
    selected = {name: placements[name] for name in names}
    if any(place.offset is None for place in selected.values()):
        return read_shard(shard.path, list(selected))
    columns: dict[str, NDArray[Any]] = {}
    try:
        with shard.path.open("rb", buffering=0) as file:
            for name, place in selected.items():
                columns[name] = np.empty(place.shape, place.dtype)
                file.seek(place.offset or 0)
                _fill(shard, file.readinto, columns[name].data.cast("B"))
    except OSError as error:
        raise machine_error("read", shard.path, error) from error
    return columns


def _fill(shard: Shard, readinto: Any, buffer: memoryview) -> None:
    """Fill a buffer; the system reads at most 2 GiB at once."""
    while buffer:
        if not (count := readinto(buffer)):
            raise DatasetError(f"{shard.path} was cut off while it was read; {RERUN_HINT}")
        buffer = buffer[count:]


def check_values(shard: Shard, columns: Mapping[str, NDArray[Any]]) -> None:
    """Check that all values are finite and that sample IDs are the indices of the rows.

    Raises:
        DatasetError: They are not.
    """
    for name, values in columns.items():
        if values.dtype.kind == "f" and not _is_finite(values):
            bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
            text = f"field {name!r} is not finite in {bad.sum()} rows, first in row {bad.argmax()}"
            raise DatasetError(f"{shard.path}: {text}")
    ids = columns.get(SAMPLE_ID)
    if ids is not None and not np.array_equal(ids, np.arange(shard.first_row, shard.first_row + shard.rows)):
        raise DatasetError(f"{shard.path}: sample_id is not the index of the row in the split")


def _is_finite(values: NDArray[Any]) -> bool:
    """Return whether all values are finite; their sum, which needs no memory, is infinite only by overflow."""
    with np.errstate(all="ignore"):
        return bool(np.isfinite(values.sum(dtype=np.float64)) or np.isfinite(values).all())
