"""The sidecar of a shard: its commit record, written after the shard has been flushed to the disk."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

from cnpgen.arrays import AnyArray
from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import CnpgenError, DatasetError
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask, shard_attributes, shards
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.files.document_structure import (
    ANY_KEY,
    check_structure,
    structure_of,
)
from cnpgen.store.files.documents import load_document, save_document
from cnpgen.store.layout import WORK
from cnpgen.store.sampling_statistics import (
    SAMPLING_STRUCTURE,
    SamplingStatistics,
    sampling_from_json,
)
from cnpgen.store.scene_table import SCENE_ID, SceneTable, check_scenes
from cnpgen.store.shard import write_shard
from cnpgen.store.statistics import (
    STATISTICS_STRUCTURE,
    FieldStatistics,
    column_statistics,
    statistics_from_json,
)

SHARD_RECORD_FORMAT = "cnpgen-shard-record"
SHARD_RECORD_VERSION = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class ShardRecord:
    """The record of a finished shard and of how it was made.

    Attributes:
        file: Path of the shard, relative to the folder of the dataset.
        bytes: Size of the file [bytes].
        sha256: sha256 of the file.
        rows: Number of rows.
        first_sample_id: Index of its first row within the split.
        specification_fingerprint: Fingerprint of the specification of the shard.
        statistics: Field name -> statistics of its columns.
        sampling: Sampling statistics of the shard.
        started: Start time of the computation, ISO 8601 in UTC.
        seconds: Computing time [s].
        versions: Versions of cnpgen, Python and libraries that made the shard.
    """

    file: str
    bytes: int
    sha256: str
    rows: int
    first_sample_id: int
    specification_fingerprint: str
    statistics: Mapping[str, FieldStatistics]
    sampling: SamplingStatistics
    started: str = ""
    seconds: float = 0.0
    versions: Mapping[str, str] = field(default_factory=dict)


_RECORD_STRUCTURE = {
    **structure_of(ShardRecord),
    "sampling": SAMPLING_STRUCTURE,
    "statistics": {ANY_KEY: STATISTICS_STRUCTURE},
}
_PLAIN = tuple(
    item.name
    for item in fields(ShardRecord)
    if item.name not in {"statistics", "sampling"}
)


def record_to_json(record: ShardRecord) -> JsonObject:
    """Return a record as a JSON-able dict."""
    return {
        **{name: getattr(record, name) for name in _PLAIN},
        "sampling": record.sampling.to_json(),
        "statistics": {
            name: item.to_json() for name, item in record.statistics.items()
        },
    }


def record_from_json(content: JsonMapping) -> ShardRecord:
    """Rebuild a record from the result of ``record_to_json``.

    A missing key or a wrong type raises DatasetError.
    """
    try:
        check_structure(content, _RECORD_STRUCTURE)
        statistics = {
            name: statistics_from_json(item)
            for name, item in content["statistics"].items()
        }
        sampling = sampling_from_json(content["sampling"])
        return ShardRecord(
            **{name: content[name] for name in _PLAIN},
            statistics=statistics,
            sampling=sampling,
        )
    except ValueError as error:
        raise DatasetError(f"the shard's record is damaged: {error}") from error


def save_record(folder: Path, task: ShardTask, record: ShardRecord) -> ShardRecord:
    """Write a shard's sidecar, and return the record; from now on the shard counts as made."""
    document = {
        "format": SHARD_RECORD_FORMAT,
        "format_version": SHARD_RECORD_VERSION,
        **record_to_json(record),
    }
    save_document(folder / task.sidecar, document, work=folder / WORK)
    return record


def load_record(folder: Path, task: ShardTask) -> ShardRecord:
    """Read the sidecar of a shard.

    A missing or damaged one, and that of another shard, raise DatasetError.
    """
    path = folder / task.sidecar
    record = record_from_json(
        load_document(
            path, SHARD_RECORD_FORMAT, version=SHARD_RECORD_VERSION, structure={}
        )
    )
    if (record.file, record.rows, record.first_sample_id) != (
        task.file,
        task.rows,
        task.first_row,
    ):
        shard = f"{record.file}, {record.rows} rows from row {record.first_sample_id}"
        raise DatasetError(f"{path} is the record of another shard: {shard}")
    return record


def commit_shard(
    folder: Path,
    spec: DatasetSpec,
    task: ShardTask,
    *,
    columns: Mapping[str, AnyArray],
    sampling: SamplingStatistics,
    scenes: SceneTable | None = None,
    started: str = "",
    seconds: float = 0.0,
    versions: Mapping[str, str] | None = None,
) -> ShardRecord:
    """Write a shard and then its sidecar; a committed shard is not written again. Return the record of the shard.

    The columns are finite, in their stored type, of shape (rows, width) or (rows,), the
    scenes, too; others raise DatasetError. Other arguments become attributes of the
    record.
    """
    # Another process may have made the same shard.
    if is_committed(folder, spec, task):
        return load_record(folder, task)
    try:
        record = ShardRecord(
            file=task.file,
            bytes=_write(folder, spec, task, columns, scenes),
            # As the disk returns the file, not as the buffer has it.
            sha256=file_sha256(folder / task.file),
            rows=task.rows,
            first_sample_id=task.first_row,
            specification_fingerprint=spec.version_with(task).fingerprint,
            statistics=column_statistics(columns, spec.fields),
            sampling=sampling,
            started=started,
            seconds=seconds,
            versions=versions or {},
        )
        # Another process may already have summarized its record.
        if not is_committed(folder, spec, task):
            return save_record(folder, task, record)
    except CnpgenError:
        # Another process may have finished the dataset and removed temporary files.
        if not is_committed(folder, spec, task):
            raise
    return load_record(folder, task)


def _write(
    folder: Path,
    spec: DatasetSpec,
    task: ShardTask,
    columns: Mapping[str, AnyArray],
    scenes: SceneTable | None,
) -> int:
    """Check the scenes, write a shard, and return its number of bytes."""
    families = spec.scene_families
    if scenes is not None:
        check_scenes(scenes, spec.scene_obstacles, columns[SCENE_ID], len(families))
    return write_shard(
        folder / task.file,
        columns,
        spec.fields,
        shard_attributes(spec, task),
        dtype=spec.dtype,
        scenes=scenes,
        families=families,
        work=folder / WORK,
    )


def load_committed(folder: Path, spec: DatasetSpec, task: ShardTask) -> ShardRecord:
    """Read the sidecar of a shard, without the shard itself.

    Raise DatasetError if it is damaged or of another specification, or if the shard is
    missing or has another size.
    """
    record = load_record(folder, task)
    if record.specification_fingerprint != spec.version_with(task).fingerprint:
        raise DatasetError(
            f"{folder / task.sidecar} belongs to another specification "
            f"({record.specification_fingerprint[:12]}...)"
        )
    path = folder / task.file
    # The size is a quick check; the sha256 is compared where rows are read.
    size = path.stat().st_size if path.is_file() else None
    if size != record.bytes:
        problem = (
            "it is missing"
            if size is None
            else f"it has {size} bytes instead of {record.bytes}"
        )
        raise DatasetError(f"{path} is not the recorded file: {problem}")
    return record


def check_committed(folder: Path, spec: DatasetSpec, task: ShardTask) -> None:
    """Check a shard as ``load_committed``, and its sha256: a changed shard raises DatasetError."""
    record = load_committed(folder, spec, task)
    if file_sha256(folder / task.file) != record.sha256:
        raise DatasetError(
            f"{folder / task.file} was changed: its sha256 is not the recorded one"
        )


def is_committed(folder: Path, spec: DatasetSpec, task: ShardTask) -> bool:
    """Return whether the sidecar of a shard is valid and of this specification, and its file has the recorded size."""
    try:
        load_committed(folder, spec, task)
    except DatasetError:
        return False
    return True


def pending(folder: Path, spec: DatasetSpec) -> list[ShardTask]:
    """List the shards that are not committed, in order."""
    return [task for task in shards(spec) if not is_committed(folder, spec, task)]
