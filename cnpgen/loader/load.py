"""Opening a dataset for training; incomplete and damaged datasets are refused."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.scene_columns import problem_obstacles
from cnpgen.loader.shard_reader import ShardReader
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import flag
from cnpgen.store.checked_shard import Shard
from cnpgen.store.dataset_spec import DatasetSpec, shards
from cnpgen.store.dataset_summary import (
    STATS_FORMAT,
    STATS_STRUCTURE,
    STATS_VERSION,
    DatasetSummary,
    summarize_dataset,
)
from cnpgen.store.files.documents import load_document
from cnpgen.store.files.size_limits import MAX_EXPANSION, MIN_EXPANSION_LIMIT_BYTES
from cnpgen.store.intact import RERUN_HINT
from cnpgen.store.layout import SPECIFICATION, STATS
from cnpgen.store.manifest import data_fingerprint
from cnpgen.store.reader import open_dataset
from cnpgen.store.shard import storage_dtype
from cnpgen.store.statistics import FieldStatistics, are_of, statistics_from_json

Statistics = dict[str, dict[str, FieldStatistics]]


@checked_arguments
def load_dataset(folder: str | Path, *, allow_incomplete: bool = False, verify: bool = True) -> Dataset:
    """Open a dataset: its rows as batches for training, arrays, tables or one by one.

    Existence and sizes of all shards are checked now, header and sha256 of each when it is read for the first time.

    Args:
        folder: Folder of the dataset.
        allow_incomplete: Whether to open the existing shards of a dataset that is unfinished or has missing shards.
        verify: Whether to verify the sha256 of every shard when it is read for the first time.

    Raises:
        UsageError: The folder does not exist or contains no dataset, or an option is not a bool.
        DatasetError: The dataset is unfinished, or a part is missing or damaged.
        MachineError: A file cannot be read.
    """
    folder, verify = Path(folder), flag("verify", verify)
    stored = open_dataset(folder, allow_incomplete=flag("allow_incomplete", allow_incomplete))
    if stored.manifest is None:
        summary = summarize_dataset(folder, stored.spec, allow_incomplete=True)
        listed, statistics = _recorded(folder, summary), summary.statistics
    else:
        listed, statistics = (
            _listed(folder, stored.spec, stored.manifest),
            _load_statistics(folder, stored.spec),
        )
    _check_rows(stored.spec, listed)
    present = _present(folder, listed, allow_incomplete=allow_incomplete)
    fingerprint = data_fingerprint(
        (shard.path.relative_to(folder).as_posix(), shard.sha256) for part in present.values() for shard in part
    )
    reader = ShardReader(verify=verify, obstacles=problem_obstacles(stored.spec))
    return Dataset(folder, stored.spec, fingerprint, present, statistics, reader)


def _recorded(folder: Path, summary: DatasetSummary) -> dict[str, list[Shard]]:
    """Return the shards of an unfinished dataset, from their sidecars."""
    spec = summary.spec
    return {
        split: [Shard(folder, spec, task, record.bytes, record.sha256) for task, record in summary.of_split(split)]
        for split in spec.splits
    }


def _listed(folder: Path, spec: DatasetSpec, manifest: Mapping[str, Any]) -> dict[str, list[Shard]]:
    """Return the shards of a finished dataset, from its manifest."""
    tasks = {task.file: task for task in shards(spec)}
    return {
        split: [
            Shard(folder, spec, tasks[entry["file"]], entry["bytes"], entry["sha256"]) for entry in content["shards"]
        ]
        for split, content in manifest["splits"].items()
    }


def _load_statistics(folder: Path, spec: DatasetSpec) -> Statistics:
    """Read the statistics of a finished dataset."""
    path = folder / STATS
    document = load_document(path, STATS_FORMAT, version=STATS_VERSION, structure=STATS_STRUCTURE)
    if document["specification_fingerprint"] != spec.fingerprint:
        raise DatasetError(f"{path} is of another specification than {SPECIFICATION}; {RERUN_HINT}")
    try:
        statistics = {
            split: {name: statistics_from_json(content) for name, content in fields.items()}
            for split, fields in document["splits"].items()
        }
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: {error}; {RERUN_HINT}") from error
    if not all(are_of(items, spec.fields) for items in statistics.values()):
        raise DatasetError(f"{path} is of other fields than {SPECIFICATION}; {RERUN_HINT}")
    return statistics


def _check_rows(spec: DatasetSpec, shards: Mapping[str, list[Shard]]) -> None:
    """Raise an error, before memory is allocated, if shards are too small for their recorded number of rows."""
    width = sum(max(field.width, 1) * storage_dtype(field, spec.dtype).itemsize for field in spec.fields)
    for shard in (shard for part in shards.values() for shard in part):
        if shard.rows * width > max(MAX_EXPANSION * shard.size, MIN_EXPANSION_LIMIT_BYTES):
            raise DatasetError(
                f"{shard.path} has {shard.size:,} bytes, too few for the {shard.rows:,} rows of {SPECIFICATION}"
            )


def _present(
    folder: Path, shards: Mapping[str, list[Shard]], *, allow_incomplete: bool
) -> dict[str, tuple[Shard, ...]]:
    """Return the existing shards; raise an error if others are missing, unless this is allowed."""
    problems = [problem for part in shards.values() for shard in part if (problem := shard.problem())]
    if problems and not allow_incomplete:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise DatasetError(
            f"{folder} is damaged: {problems[0]}{more}; {RERUN_HINT}, or omit the shard with allow_incomplete=True"
        )
    return {split: tuple(shard for shard in part if not shard.problem()) for split, part in shards.items()}
