"""Opening a dataset: what is not whole is refused."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.shards import Shard, ShardReader
from cnpgen.schema.arguments import flag
from cnpgen.store.blueprint import Blueprint, ShardTask, shards
from cnpgen.store.files.documents import load_document
from cnpgen.store.files.limits import ALWAYS, EXPANSION
from cnpgen.store.intact import AGAIN
from cnpgen.store.layout import PLAN, STATS
from cnpgen.store.manifest import data_fingerprint
from cnpgen.store.reader import open_dataset
from cnpgen.store.shard import storage_dtype
from cnpgen.store.statistics import FieldStatistics, are_of, statistics_from_json
from cnpgen.store.summary import STATS_FORM, STATS_FORMAT, STATS_FORMAT_VERSION, Summary, summarise

Statistics = dict[str, dict[str, FieldStatistics]]


def load_dataset(folder: str | Path, *, allow_incomplete: bool = False, verify: bool = True) -> Dataset:
    """Open a dataset: its rows in batches for training, as arrays or a table, one by one.

    That the shards are there and have their sizes is checked now; header and sha256 of each when it is first read.

    Args:
        folder: Its folder.
        allow_incomplete: Take the shards that are there, if the dataset is unfinished or has lost some.
        verify: Compare the sha256 of every shard, once, when it is first read.

    Raises:
        UsageError: There is no such folder, or an option is neither True nor False.
        DatasetError: It holds no dataset, it is unfinished, or a part of it is missing or damaged.
        MachineError: The system would not let us read something.
    """
    folder, verify = Path(folder), flag("verify", verify)
    stored = open_dataset(folder, allow_incomplete=flag("allow_incomplete", allow_incomplete))
    if stored.manifest is None:
        summary = summarise(folder, stored.blueprint, allow_incomplete=True)
        listed, statistics = _recorded(folder, summary), summary.statistics
    else:
        listed, statistics = (
            _listed(folder, stored.blueprint, stored.manifest),
            _load_statistics(folder, stored.blueprint),
        )
    _check_rows(stored.blueprint, listed)
    present = _present(folder, listed, allow_incomplete=allow_incomplete)
    fingerprint = data_fingerprint(
        (shard.path.relative_to(folder).as_posix(), shard.sha256) for part in present.values() for shard in part
    )
    return Dataset(folder, stored.blueprint, fingerprint, present, statistics, ShardReader(verify=verify))


def _recorded(folder: Path, summary: Summary) -> dict[str, list[Shard]]:
    """List the shards of an unfinished dataset by their sidecars."""
    blueprint = summary.blueprint
    return {
        split: [
            _shard(folder, blueprint, task, record.bytes, record.sha256) for task, record in summary.of_split(split)
        ]
        for split in blueprint.splits
    }


def _listed(folder: Path, blueprint: Blueprint, manifest: Mapping[str, Any]) -> dict[str, list[Shard]]:
    """List the shards of a finished dataset by its manifest."""
    tasks = {task.file: task for task in shards(blueprint)}
    return {
        split: [
            _shard(folder, blueprint, tasks[entry["file"]], entry["bytes"], entry["sha256"])
            for entry in content["shards"]
        ]
        for split, content in manifest["splits"].items()
    }


def _shard(folder: Path, blueprint: Blueprint, task: ShardTask, size: int, sha256: str) -> Shard:
    return Shard(folder / task.file, task.rows, task.first_row, size, sha256, blueprint.of(task).key)


def _load_statistics(folder: Path, blueprint: Blueprint) -> Statistics:
    """Read the statistics of a finished dataset."""
    path = folder / STATS
    document = load_document(path, STATS_FORMAT, version=STATS_FORMAT_VERSION, form=STATS_FORM)
    if document["plan_fingerprint"] != blueprint.fingerprint:
        raise DatasetError(f"{path} is of another blueprint than {PLAN}; {AGAIN}")
    try:
        found = {
            split: {name: statistics_from_json(content) for name, content in fields.items()}
            for split, fields in document["splits"].items()
        }
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: {error}; {AGAIN}") from error
    if not all(are_of(statistics, blueprint.fields) for statistics in found.values()):
        raise DatasetError(f"{path} is of other fields than {PLAN}; {AGAIN}")
    return found


def _check_rows(blueprint: Blueprint, shards: Mapping[str, list[Shard]]) -> None:
    """Refuse shards that cannot have as many rows as is recorded, before room is made for them."""
    width = sum(max(field.width, 1) * storage_dtype(field, blueprint.dtype).itemsize for field in blueprint.fields)
    for shard in (each for part in shards.values() for each in part):
        if shard.rows * width > max(EXPANSION * shard.size, ALWAYS):
            raise DatasetError(f"{shard.path} has {shard.size:,} bytes, too few for the {shard.rows:,} rows of {PLAN}")


def _present(
    folder: Path, shards: Mapping[str, list[Shard]], *, allow_incomplete: bool
) -> dict[str, tuple[Shard, ...]]:
    """Return the shards that are there; refuse, unless it is allowed, to do without the others."""
    problems = [problem for part in shards.values() for shard in part if (problem := shard.problem())]
    if problems and not allow_incomplete:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise DatasetError(
            f"{folder} is damaged: {problems[0]}{more}; {AGAIN}, or pass allow_incomplete=True to do without"
        )
    return {split: tuple(shard for shard in part if not shard.problem()) for split, part in shards.items()}
