"""Summary of the finished shards of a dataset, in shard order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask, shards
from cnpgen.store.files.document_structure import ANY_KEY, TEXT
from cnpgen.store.files.documents import load_document
from cnpgen.store.intact import RERUN_HINT
from cnpgen.store.layout import SPECIFICATION, STATS
from cnpgen.store.sampling_statistics import (
    DENSITIES_STRUCTURE,
    SamplingStatistics,
    densities_to_json,
    merge_sampling,
)
from cnpgen.store.shard_record import ShardRecord, load_committed
from cnpgen.store.statistics import (
    STATISTICS_STRUCTURE,
    FieldStatistics,
    are_of,
    merge_statistics,
)

STATS_FORMAT = "cnpgen-stats"
STATS_VERSION = 2
STATS_STRUCTURE = {
    "specification_fingerprint": TEXT,
    "splits": {ANY_KEY: {ANY_KEY: STATISTICS_STRUCTURE}},
    "densities": {ANY_KEY: DENSITIES_STRUCTURE},
}
_MAX_SHOWN_PROBLEMS = 5


@dataclass(frozen=True, eq=False)
class DatasetSummary:
    """A dataset specification and the records of its shards.

    Attributes:
        spec: The specification.
        records: Every finished shard and its record, in the specification's order.
        problems: Reason why each of the other shards is not finished.
    """

    spec: DatasetSpec
    records: tuple[tuple[ShardTask, ShardRecord], ...]
    problems: tuple[str, ...] = ()

    @property
    def n_shards(self) -> int:
        """Number of shards of the specification."""
        return len(self.records) + len(self.problems)

    def of_split(self, split: str) -> list[tuple[ShardTask, ShardRecord]]:
        """List the finished shards of a split, in order."""
        return [(task, record) for task, record in self.records if task.split == split]

    @cached_property
    def sampling_by_split(self) -> dict[str, SamplingStatistics]:
        """Sampling statistics of every split."""
        return {
            split: merge_sampling([item.sampling for _, item in self.of_split(split)])
            for split in self.spec.splits
        }

    @cached_property
    def sampling(self) -> SamplingStatistics:
        """Sampling statistics of the whole dataset."""
        return merge_sampling(list(self.sampling_by_split.values()))

    @property
    def seconds(self) -> float:
        """Computing time of all processes together [s]."""
        return sum(record.seconds for _, record in self.records)

    @cached_property
    def environments(self) -> list[dict[str, str]]:
        """Different combinations of versions of cnpgen, Python and libraries that made the shards."""
        environments: list[dict[str, str]] = []
        for _, record in self.records:
            if (versions := dict(record.versions)) not in environments:
                environments.append(versions)
        return environments

    @cached_property
    def statistics(self) -> dict[str, dict[str, FieldStatistics]]:
        """Statistics of every split with finished shards: split -> field -> statistics."""
        parts = {
            split: [item.statistics for _, item in self.of_split(split)]
            for split in self.spec.splits
        }
        return {
            split: merge_statistics(items) for split, items in parts.items() if items
        }


def summarize_dataset(
    folder: Path, spec: DatasetSpec, *, allow_incomplete: bool = False
) -> DatasetSummary:
    """Read the sidecars of a dataset; of an incomplete one only with ``allow_incomplete``.

    Otherwise a shard that is missing, damaged or of another specification raises
    DatasetError, which names it.
    """
    records = []
    problems = []
    for task in shards(spec):
        try:
            records.append((task, _load_record_with_fields(folder, spec, task)))
        except DatasetError as error:
            problems.append(str(error))
    summary = DatasetSummary(spec, tuple(records), tuple(problems))
    if problems and not allow_incomplete:
        more = (
            [f"and {len(problems) - _MAX_SHOWN_PROBLEMS} more"]
            if len(problems) > _MAX_SHOWN_PROBLEMS
            else []
        )
        shown = "\n  ".join([*problems[:_MAX_SHOWN_PROBLEMS], *more])
        raise DatasetError(f"{folder} is {unfinished(summary)}:\n  {shown}")
    return summary


def _load_record_with_fields(
    folder: Path, spec: DatasetSpec, task: ShardTask
) -> ShardRecord:
    """Read a sidecar and check that its statistics are of the fields of the specification."""
    record = load_committed(folder, spec, task)
    if not are_of(record.statistics, spec.fields):
        raise DatasetError(
            f"{folder / task.sidecar} has other fields than {SPECIFICATION}"
        )
    return record


def unfinished(summary: DatasetSummary) -> str:
    """Describe the progress of an unfinished dataset, with a hint."""
    progress = "all shards are finished, but the manifest is missing"
    if summary.problems:
        progress = f"{len(summary.records)} of {summary.n_shards} shards are finished"
    return f"unfinished: {progress}; {RERUN_HINT}"


def stats_document(summary: DatasetSummary) -> JsonObject:
    """Return the content of ``stats.json``: statistics of every field and density maps, split by split."""
    return {
        "format": STATS_FORMAT,
        "format_version": STATS_VERSION,
        "specification_fingerprint": summary.spec.fingerprint,
        "splits": {
            split: {name: item.to_json() for name, item in fields.items()}
            for split, fields in summary.statistics.items()
        },
        "densities": {
            split: densities_to_json(item.densities)
            for split, item in summary.sampling_by_split.items()
        },
    }


def load_stats_document(folder: Path) -> JsonObject:
    """Read ``stats.json``; raise DatasetError if it is missing, damaged or of another format version."""
    return load_document(
        folder / STATS, STATS_FORMAT, version=STATS_VERSION, structure=STATS_STRUCTURE
    )
