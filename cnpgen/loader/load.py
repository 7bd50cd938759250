"""Opening a dataset for training; incomplete and damaged datasets are refused."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from cnpgen.errors import DatasetError
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.remote import local_folder
from cnpgen.loader.shard_reader import ShardReader, problem_obstacles
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import flag
from cnpgen.store.checked_shard import Shard
from cnpgen.store.dataset_spec import DatasetSpec, shards
from cnpgen.store.dataset_summary import load_stats_document, summarize_dataset
from cnpgen.store.files.size_limits import MAX_EXPANSION, MIN_EXPANSION_LIMIT_BYTES
from cnpgen.store.intact import RERUN_HINT
from cnpgen.store.layout import SPECIFICATION, STATS
from cnpgen.store.manifest import data_fingerprint
from cnpgen.store.reader import open_dataset
from cnpgen.store.shard import storage_dtype
from cnpgen.store.statistics import FieldStatistics, are_of, statistics_from_json

Statistics = dict[str, dict[str, FieldStatistics]]


@checked_arguments
def load_dataset(
    folder: str | Path, *, allow_incomplete: bool = False, verify: bool = True
) -> Dataset:
    """Open a dataset: its rows as batches for training, arrays, tables or one by one.

    Existence and sizes of all shards are checked now, header and sha256 of each when it
    is read for the first time.

    Args:
        folder: Folder of the dataset, or the URL of a published one as text:
            ``hf://datasets/USER/NAME@REVISION``, ``https://``, ``s3://`` or ``gs://``.
            It is downloaded once, into a local cache.
        allow_incomplete: Whether to open the existing shards of a dataset that is
            unfinished or has missing shards.
        verify: Whether to verify the sha256 of every shard when it is read for the
            first time.

    Raises:
        UsageError: The folder does not exist or contains no dataset, no installed
            package reads the URL, or an option is not a bool.
        DatasetError: The dataset is unfinished, or a part is missing or damaged.
        MachineError: A file cannot be read, or a server cannot be reached.
    """
    verify = flag("verify", verify)
    stored = open_dataset(
        Path(local_folder(folder)),
        allow_incomplete=flag("allow_incomplete", allow_incomplete),
    )
    # The working folder may change.
    folder = stored.folder.absolute()
    stored = replace(stored, folder=folder)
    if stored.manifest is None:
        summary = summarize_dataset(folder, stored.spec, allow_incomplete=True)
        # Without a manifest the sidecars are the only records.
        statistics = summary.statistics
        made = summary.records
        recorded = [
            Shard(folder, stored.spec, task, record.bytes, record.sha256)
            for task, record in made
        ]
    else:
        statistics = _load_statistics(folder, stored.spec)
        recorded = [stored.shard(task) for task in shards(stored.spec)]
    listed = {
        split: [shard for shard in recorded if shard.task.split == split]
        for split in stored.spec.splits
    }
    _check_rows(stored.spec, recorded)
    present = _present(folder, listed, allow_incomplete=allow_incomplete)
    # Only of the shards that exist, since a loader's state must belong to these rows.
    fingerprint = data_fingerprint(
        (shard.path.relative_to(folder).as_posix(), shard.sha256)
        for part in present.values()
        for shard in part
    )
    reader = ShardReader(verify=verify, obstacles=problem_obstacles(stored.spec))
    return Dataset(folder, stored.spec, fingerprint, present, statistics, reader)


def _load_statistics(folder: Path, spec: DatasetSpec) -> Statistics:
    """Read the statistics of a finished dataset."""
    path = folder / STATS
    document = load_stats_document(folder)
    if document["specification_fingerprint"] != spec.fingerprint:
        raise DatasetError(
            f"{path} is of another specification than {SPECIFICATION}; {RERUN_HINT}"
        )
    try:
        statistics = {
            split: {
                name: statistics_from_json(content) for name, content in fields.items()
            }
            for split, fields in document["splits"].items()
        }
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: {error}; {RERUN_HINT}") from error
    if not all(are_of(items, spec.fields) for items in statistics.values()):
        raise DatasetError(
            f"{path} is of other fields than {SPECIFICATION}; {RERUN_HINT}"
        )
    return statistics


def _check_rows(spec: DatasetSpec, shards: Iterable[Shard]) -> None:
    """Raise an error, before memory is allocated, if shards are too small for their recorded number of rows."""
    # Bytes of a row.
    width = sum(
        max(field.width, 1) * storage_dtype(field, spec.dtype).itemsize
        for field in spec.fields
    )
    for shard in shards:
        if shard.rows * width > max(
            MAX_EXPANSION * shard.size, MIN_EXPANSION_LIMIT_BYTES
        ):
            raise DatasetError(
                f"{shard.path} has {shard.size:,} bytes, too few for the {shard.rows:,} rows of "
                f"{SPECIFICATION}"
            )


def _present(
    folder: Path, shards: Mapping[str, list[Shard]], *, allow_incomplete: bool
) -> dict[str, tuple[Shard, ...]]:
    """Return the existing shards.

    Raise an error if others are missing, unless this is allowed.
    """
    problems = [
        problem
        for part in shards.values()
        for shard in part
        if (problem := shard.problem())
    ]
    if problems and not allow_incomplete:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise DatasetError(
            f"{folder} is damaged: {problems[0]}{more}; {RERUN_HINT}, or omit the shard with "
            "allow_incomplete=True"
        )
    return {
        split: tuple(shard for shard in part if not shard.problem())
        for split, part in shards.items()
    }
