"""Inspection of a dataset: its content and origin, from its documents and sidecars.

No sample is read.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError
from cnpgen.store.check import check_documents
from cnpgen.store.dataset_spec import DatasetSpec, load_dataset_spec, shards
from cnpgen.store.dataset_summary import DatasetSummary, summarize_dataset, unfinished
from cnpgen.store.field import Field
from cnpgen.store.files.documents import plain
from cnpgen.store.layout import DOCUMENTS, MANIFEST
from cnpgen.store.paths import require_dataset
from cnpgen.store.sampling_statistics import SamplingStatistics, densities_to_json
from cnpgen.store.statistics import FieldStatistics, merge_statistics


@dataclass(frozen=True, eq=False)
class Inspection:
    """Description of a dataset, which may be unfinished.

    Attributes:
        folder: Folder of the dataset.
        summary: The specification and the records of the finished shards.
        is_finalized: Whether the manifest exists.
        bytes: Size of all files [bytes].
        damage: Problems of the documents of a finalized dataset, one per line; shards
            are not read.
    """

    folder: Path
    summary: DatasetSummary
    is_finalized: bool
    bytes: int
    damage: tuple[str, ...] = ()

    @property
    def spec(self) -> DatasetSpec:
        """The specification of the dataset."""
        return self.summary.spec

    @property
    def sampling(self) -> SamplingStatistics:
        """Sampling statistics of the finished shards."""
        return self.summary.sampling

    @property
    def complete(self) -> bool:
        """Whether all files exist and no document is damaged."""
        return self.is_finalized and not self.summary.problems and not self.damage

    @property
    def damaged(self) -> bool:
        """Whether the dataset is finalized and a document or a shard is missing or damaged."""
        return self.is_finalized and not self.complete

    @property
    def state(self) -> str:
        """The state of the dataset in a few words."""
        if self.complete:
            return "complete"
        if not self.is_finalized:
            return unfinished(self.summary)
        if self.summary.problems:
            problem = f"{len(self.summary.records)} of {self.summary.n_shards} shards are undamaged"
        else:
            problem = self.damage[0]
        return f"damaged: {problem}; for details run 'cnpgen validate'"

    @cached_property
    def rows(self) -> dict[str, int]:
        """Number of existing rows per split."""
        return {
            split: sum(record.rows for _, record in self.summary.of_split(split))
            for split in self.spec.splits
        }

    @cached_property
    def statistics(self) -> Mapping[str, FieldStatistics]:
        """Statistics of every field over all splits; empty if there are no rows."""
        parts = list(self.summary.statistics.values())
        return merge_statistics(parts) if parts else {}

    @property
    def seconds(self) -> float:
        """Computing time of all processes together [s]."""
        return self.summary.seconds

    @property
    def environments(self) -> list[dict[str, str]]:
        """Different combinations of versions of cnpgen, Python and libraries that made the shards."""
        return self.summary.environments

    def to_dict(self) -> JsonObject:
        """Return everything for JSON."""
        spec = self.spec
        content = {
            "folder": self.folder,
            **_attributes(spec, "name", "version", "title", "license"),
            **_attributes(self, "complete", "state", "bytes", "seconds"),
            "damage": [*self.summary.problems, *self.damage]
            if self.is_finalized
            else [],
            "shards": {
                "planned": self.summary.n_shards,
                "finished": len(self.summary.records),
            },
            "rows": {
                split: {"planned": spec.splits[split], "stored": rows}
                for split, rows in self.rows.items()
            },
            "fields": [self._field(field) for field in spec.fields],
            "yield": _yield(self.sampling),
            "yield_by_split": {
                split: _yield(sampling)
                for split, sampling in self.summary.sampling_by_split.items()
            },
            "densities": densities_to_json(self.sampling.densities),
            "verification": self.sampling.verification,
            "seed": str(spec.seed),
            **_attributes(spec, "generator", "backend", "dtype"),
            **_attributes(spec, "shard_size", "recipe_sha256"),
            "specification_fingerprint": spec.fingerprint,
            "versions": spec.versions,
            "environments": self.environments,
        }
        result: JsonObject = plain(content)
        return result

    def _field(self, field: Field) -> JsonObject:
        names = (
            "name",
            "unit",
            "long_name",
            "width",
            "names",
            "role",
            "frame",
            "dtype",
            "valid_min",
            "valid_max",
        )
        content = _attributes(field, *names)
        item = self.statistics.get(field.name)
        if item is None:
            return content
        return content | {
            "min": item.minimum,
            "mean": item.mean,
            "max": item.maximum,
            "std": item.std,
        }


def _attributes(item: object, *names: str) -> JsonObject:
    return {name: getattr(item, name) for name in names}


def _yield(sampling: SamplingStatistics) -> JsonObject:
    """Return the numbers of candidates and, in pipeline order, of rejections with the fractions that remain."""
    tried = max(sampling.tried, 1)
    left = sampling.tried
    steps = []
    for reason, count in sampling.rejections.items():
        # Each reason removes its candidates from those that earlier stages left.
        left -= count
        stage = sampling.stages.get(reason, "")
        steps.append(
            {
                "stage": stage,
                "reason": reason,
                "candidates": count,
                "share": count / tried,
                "left": left / tried,
            }
        )
    share = sampling.accepted / tried
    return {
        "tried": sampling.tried,
        "accepted": sampling.accepted,
        "acceptance": share,
        "rejections": steps,
    }


def inspect_dataset(folder: str | Path) -> Inspection:
    """Inspect a dataset, which may be unfinished.

    Args:
        folder: Folder of the dataset.

    Raises:
        UsageError: The folder does not exist, or contains no dataset.
        DatasetError: Its specification is damaged.
        MachineError: A file cannot be read.
    """
    folder = require_dataset(folder)
    try:
        spec = load_dataset_spec(folder)
    except DatasetError as error:
        raise DatasetError(f"{error}; for a remedy run 'cnpgen validate'") from error
    summary = summarize_dataset(folder, spec, allow_incomplete=True)
    is_finalized = (folder / MANIFEST).is_file()
    damage = (
        tuple(str(finding) for finding in check_documents(folder, spec))
        if is_finalized
        else ()
    )
    return Inspection(folder, summary, is_finalized, _size(folder, spec), damage)


def _size(folder: Path, spec: DatasetSpec) -> int:
    """Return the size of all files of the dataset [bytes], without other files in its folder."""
    names = [
        *DOCUMENTS,
        *(name for task in shards(spec) for name in (task.file, task.sidecar)),
    ]
    return sum(
        (folder / name).stat().st_size for name in names if (folder / name).is_file()
    )
