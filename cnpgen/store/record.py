"""The sidecar of a shard: its commit record, written after the shard itself is safely on the disk."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cnpgen.errors import CnpgenError, DatasetError
from cnpgen.store.blueprint import Blueprint, ShardTask, shard_attributes, shards
from cnpgen.store.fates import FATES_FORM, Fates, fates_from_json
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.files.documents import load_document, save_document
from cnpgen.store.files.forms import EVERY, NUMBER, TEXT, WHOLE, check_form
from cnpgen.store.layout import WORK
from cnpgen.store.shard import write_shard
from cnpgen.store.statistics import STATISTICS_FORM, FieldStatistics, column_statistics, statistics_from_json

FORMAT = "cnpgen-shard-record"
FORMAT_VERSION = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class ShardRecord:
    """What is known of a finished shard, and how it came about.

    Attributes:
        file: Path of the shard, relative to the dataset's folder.
        bytes: Its size.
        sha256: Its digest.
        rows: Its rows.
        first_sample_id: Index of its first row within the split.
        plan_fingerprint: Fingerprint of the blueprint it belongs to.
        statistics: Field name -> statistics of its columns.
        fates: Fates of the draws that were made for it.
        started: When the work on it began, ISO 8601 in UTC.
        seconds: How long the work took [s].
        versions: Versions of cnpgen, Python and libraries that made it.
    """

    file: str
    bytes: int
    sha256: str
    rows: int
    first_sample_id: int
    plan_fingerprint: str
    statistics: Mapping[str, FieldStatistics]
    fates: Fates
    started: str = ""
    seconds: float = 0.0
    versions: Mapping[str, str] = field(default_factory=dict)


_FORM = {  # looked at where a record is rebuilt
    **dict.fromkeys(("file", "sha256", "plan_fingerprint", "started"), TEXT),
    **dict.fromkeys(("bytes", "rows", "first_sample_id"), WHOLE),
    "seconds": NUMBER,
    "versions": {EVERY: TEXT},
    "outcome": FATES_FORM,
    "statistics": {EVERY: STATISTICS_FORM},
}
_PLAIN = ("file", "bytes", "sha256", "rows", "first_sample_id", "plan_fingerprint", "started", "seconds", "versions")


def record_to_json(record: ShardRecord) -> dict[str, Any]:
    """Return a record as a JSON-able dict."""
    return {
        **{name: getattr(record, name) for name in _PLAIN},
        "outcome": record.fates.to_json(),
        "statistics": {name: item.to_json() for name, item in record.statistics.items()},
    }


def record_from_json(content: Mapping[str, Any]) -> ShardRecord:
    """Rebuild a record from its JSON form.

    Raises:
        DatasetError: A key is missing or has the wrong type.
    """
    try:
        check_form(content, _FORM)
        statistics = {name: statistics_from_json(item) for name, item in content["statistics"].items()}
        fates = fates_from_json(content["outcome"])
        return ShardRecord(**{name: content[name] for name in _PLAIN}, statistics=statistics, fates=fates)
    except ValueError as error:
        raise DatasetError(f"the shard's record is damaged: {error}") from error


def save_record(folder: Path, task: ShardTask, record: ShardRecord) -> None:
    """Write a shard's sidecar; from now on the shard counts as made.

    Raises:
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    document = {"format": FORMAT, "format_version": FORMAT_VERSION, **record_to_json(record)}
    save_document(folder / task.sidecar, document, work=folder / WORK)


def load_record(folder: Path, task: ShardTask) -> ShardRecord:
    """Read a shard's sidecar.

    Raises:
        DatasetError: It is missing, damaged, written by a newer cnpgen or of another shard.
        MachineError: The system would not let us read it.
    """
    path = folder / task.sidecar
    record = record_from_json(load_document(path, FORMAT, version=FORMAT_VERSION, form={}))
    found = (record.file, record.rows, record.first_sample_id)
    if found != (task.file, task.rows, task.first_row):
        raise DatasetError(f"{path} is the record of another shard: {found[0]}, {found[1]} rows from row {found[2]}")
    return record


def commit_shard(
    folder: Path,
    blueprint: Blueprint,
    task: ShardTask,
    *,
    columns: Mapping[str, NDArray[Any]],
    fates: Fates,
    started: str = "",
    seconds: float = 0.0,
    versions: Mapping[str, str] | None = None,
) -> ShardRecord:
    """Write a shard and then its sidecar; doing it twice is harmless: what is committed stays as it is.

    Args:
        folder: The dataset's folder.
        blueprint: Its blueprint.
        task: Which shard.
        columns: Field name -> values in their stored type, shape (rows, width) or (rows,).
        fates: Fates of the draws that were made for it.
        started: When the work on it began, ISO 8601 in UTC.
        seconds: How long the work took [s].
        versions: Versions of cnpgen, Python and libraries that made it.

    Returns:
        The shard's record.

    Raises:
        DatasetError: The columns are not what the blueprint says, or not finite.
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    if is_committed(folder, blueprint, task):  # by somebody to whom the same work was given
        return load_record(folder, task)
    about = {"fates": fates, "started": started, "seconds": seconds, "versions": versions or {}}
    try:
        return _write(folder, blueprint, task, columns, about)
    except CnpgenError:
        # somebody may have committed it meanwhile, finished the dataset and swept our temporary file away with theirs
        if is_committed(folder, blueprint, task):
            return load_record(folder, task)
        raise


def _write(
    folder: Path,
    blueprint: Blueprint,
    task: ShardTask,
    columns: Mapping[str, NDArray[Any]],
    about: Mapping[str, Any],
) -> ShardRecord:
    """Write a shard and then its sidecar, which says how the shard came about, unless somebody else has meanwhile."""
    path = folder / task.file
    size = write_shard(
        path, columns, blueprint.fields, shard_attributes(blueprint, task), dtype=blueprint.dtype, work=folder / WORK
    )
    record = ShardRecord(
        file=task.file,
        bytes=size,
        sha256=file_sha256(path),
        rows=task.rows,
        first_sample_id=task.first_row,
        plan_fingerprint=blueprint.of(task).fingerprint,
        statistics=column_statistics(columns, blueprint.fields),
        **about,
    )
    if is_committed(folder, blueprint, task):  # meanwhile, by somebody who may have summed up their record
        return load_record(folder, task)
    save_record(folder, task, record)
    return record


def load_committed(folder: Path, blueprint: Blueprint, task: ShardTask) -> ShardRecord:
    """Read a shard's sidecar and make sure that it stands for a shard of this blueprint; the shard itself is not read.

    Args:
        folder: The dataset's folder.
        blueprint: Its blueprint.
        task: Which shard.

    Raises:
        DatasetError: The sidecar is missing, damaged or of another blueprint, or the shard is missing or of another
            size.
        MachineError: The system would not let us read it.
    """
    record = load_record(folder, task)
    if record.plan_fingerprint != blueprint.of(task).fingerprint:
        raise DatasetError(f"{folder / task.sidecar} belongs to another blueprint ({record.plan_fingerprint[:12]}...)")
    path = folder / task.file
    size = path.stat().st_size if path.is_file() else None
    if size != record.bytes:
        found = "it is missing" if size is None else f"it has {size} bytes instead of {record.bytes}"
        raise DatasetError(f"{path} is not the recorded file: {found}")
    return record


def check_committed(folder: Path, blueprint: Blueprint, task: ShardTask) -> None:
    """Read a shard's sidecar and the shard itself and make sure that they are what was written.

    Args:
        folder: The dataset's folder.
        blueprint: Its blueprint.
        task: Which shard.

    Raises:
        DatasetError: Like :func:`load_committed`, or the shard was changed.
        MachineError: The system would not let us read it.
    """
    record = load_committed(folder, blueprint, task)
    if file_sha256(folder / task.file) != record.sha256:
        raise DatasetError(f"{folder / task.file} was changed: its sha256 is not the recorded one")


def is_committed(folder: Path, blueprint: Blueprint, task: ShardTask) -> bool:
    """Whether a shard is made: its sidecar is whole and of this blueprint, and its file has the recorded size."""
    try:
        load_committed(folder, blueprint, task)
    except DatasetError:
        return False
    return True


def pending(folder: Path, blueprint: Blueprint) -> list[ShardTask]:
    """List the shards that are still to be made, in order."""
    return [task for task in shards(blueprint) if not is_committed(folder, blueprint, task)]
