"""The finished shards of a dataset, taken together in shard order."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError
from cnpgen.store.blueprint import Blueprint, ShardTask, shards
from cnpgen.store.fates import DENSITIES_FORM, Fates, densities_to_json, merge_fates
from cnpgen.store.files.forms import EVERY, TEXT
from cnpgen.store.intact import AGAIN
from cnpgen.store.layout import PLAN
from cnpgen.store.record import ShardRecord, load_committed
from cnpgen.store.statistics import STATISTICS_FORM, FieldStatistics, are_of, merge_statistics

STATS_FORMAT = "cnpgen-stats"
STATS_FORMAT_VERSION = 1
STATS_FORM = {
    "plan_fingerprint": TEXT,
    "splits": {EVERY: {EVERY: STATISTICS_FORM}},
    "densities": {EVERY: DENSITIES_FORM},
}
_N_SHOWN = 5


@dataclass(frozen=True, eq=False)
class Summary:
    """A blueprint and the records of its shards.

    Attributes:
        blueprint: The blueprint.
        records: Every finished shard and its record, in the blueprint's order.
        problems: Why each of the others is not finished.
    """

    blueprint: Blueprint
    records: tuple[tuple[ShardTask, ShardRecord], ...]
    problems: tuple[str, ...] = ()

    @property
    def n_shards(self) -> int:
        """Number of shards of the blueprint."""
        return len(self.records) + len(self.problems)

    def of_split(self, split: str) -> list[tuple[ShardTask, ShardRecord]]:
        """List the finished shards of a split, in order."""
        return [(task, record) for task, record in self.records if task.split == split]

    @cached_property
    def fates_by_split(self) -> dict[str, Fates]:
        """The fates of the draws, split by split."""
        return {split: merge_fates([item.fates for _, item in self.of_split(split)]) for split in self.blueprint.splits}

    @cached_property
    def fates(self) -> Fates:
        """The fates of all draws."""
        return merge_fates(list(self.fates_by_split.values()))

    @cached_property
    def statistics(self) -> dict[str, dict[str, FieldStatistics]]:
        """The statistics of every split that has finished shards: split -> field -> statistics."""
        parts = {split: [item.statistics for _, item in self.of_split(split)] for split in self.blueprint.splits}
        return {split: merge_statistics(items) for split, items in parts.items() if items}


def summarise(folder: Path, blueprint: Blueprint, *, allow_incomplete: bool = False) -> Summary:
    """Read the sidecars of a dataset.

    Args:
        folder: The dataset's folder.
        blueprint: Its blueprint.
        allow_incomplete: Take what is there instead of refusing.

    Raises:
        DatasetError: A shard is missing, damaged or of another blueprint; the message says which.
        MachineError: The system would not let us read something.
    """
    records, problems = [], []
    for task in shards(blueprint):
        try:
            records.append((task, _fitting(folder, blueprint, task)))
        except DatasetError as error:
            problems.append(str(error))
    summary = Summary(blueprint, tuple(records), tuple(problems))
    if problems and not allow_incomplete:
        more = [f"and {len(problems) - _N_SHOWN} more"] if len(problems) > _N_SHOWN else []
        shown = "\n  ".join([*problems[:_N_SHOWN], *more])
        raise DatasetError(f"{folder} is {unfinished(summary)}:\n  {shown}")
    return summary


def _fitting(folder: Path, blueprint: Blueprint, task: ShardTask) -> ShardRecord:
    """Read a sidecar, which must be of the blueprint's fields."""
    record = load_committed(folder, blueprint, task)
    if not are_of(record.statistics, blueprint.fields):
        raise DatasetError(f"{folder / task.sidecar} has statistics of other fields than {PLAN}")
    return record


def unfinished(summary: Summary) -> str:
    """Say how far an unfinished dataset is and what to do."""
    return f"unfinished: {progress_text(summary)}; {AGAIN}"


def progress_text(summary: Summary) -> str:
    """Say how many shards of an unfinished dataset are there."""
    if summary.problems:
        return f"{len(summary.records)} of {summary.n_shards} shards are there"
    return "all shards are there, but they were not summed up"


def stats_document(summary: Summary) -> dict[str, Any]:
    """Return the content of ``stats.json``: statistics of every field and the density maps, split by split."""
    return {
        "format": STATS_FORMAT,
        "format_version": STATS_FORMAT_VERSION,
        "plan_fingerprint": summary.blueprint.fingerprint,
        "splits": {split: _fields_json(fields) for split, fields in summary.statistics.items()},
        "densities": {split: densities_to_json(item.densities) for split, item in summary.fates_by_split.items()},
    }


def _fields_json(fields: Mapping[str, FieldStatistics]) -> dict[str, Any]:
    return {name: item.to_json() for name, item in fields.items()}
