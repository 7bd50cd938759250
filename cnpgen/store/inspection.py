"""What a dataset holds and how it came about, from its documents and the sidecars of its shards; no row is read."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError
from cnpgen.store.blueprint import Blueprint, load_blueprint, shards
from cnpgen.store.check import check_documents
from cnpgen.store.fates import Fates, densities_to_json
from cnpgen.store.field import Field
from cnpgen.store.files.documents import plain
from cnpgen.store.layout import DOCUMENTS, MANIFEST, PLAN
from cnpgen.store.paths import require_folder
from cnpgen.store.statistics import FieldStatistics, merge_statistics
from cnpgen.store.summary import Summary, summarise, unfinished
from cnpgen.store.workspace import is_dataset


@dataclass(frozen=True, eq=False)
class Inspection:
    """What is known of a dataset, finished or not.

    Attributes:
        folder: Its folder.
        summary: Its blueprint and the records of its finished shards.
        sealed: Whether its manifest is there.
        bytes: Size of its files.
        damage: What is wrong with the documents of a sealed dataset, a line each; shards are not read for it.
    """

    folder: Path
    summary: Summary
    sealed: bool
    bytes: int
    damage: tuple[str, ...] = ()

    @property
    def blueprint(self) -> Blueprint:
        """The blueprint of the dataset."""
        return self.summary.blueprint

    @property
    def fates(self) -> Fates:
        """The fates of all draws that were made for the rows that are there."""
        return self.summary.fates

    @property
    def complete(self) -> bool:
        """Whether all of it is there."""
        return self.sealed and not self.summary.problems and not self.damage

    @property
    def damaged(self) -> bool:
        """Whether what was looked at is not as it was made."""
        return self.sealed and not self.complete

    @property
    def state(self) -> str:
        """The state of the dataset in a few words."""
        if self.complete:
            return "complete"
        if not self.sealed:
            return unfinished(self.summary)
        if self.summary.problems:
            what = f"{len(self.summary.records)} of {self.summary.n_shards} shards are as they were made"
        else:
            what = self.damage[0]
        return f"damaged: {what}; 'cnpgen validate' says more"

    @cached_property
    def rows(self) -> dict[str, int]:
        """Rows per split that are there."""
        return {
            split: sum(record.rows for _, record in self.summary.of_split(split)) for split in self.blueprint.splits
        }

    @cached_property
    def statistics(self) -> Mapping[str, FieldStatistics]:
        """Statistics of every field over all splits; empty without rows."""
        parts = list(self.summary.statistics.values())
        return merge_statistics(parts) if parts else {}

    @property
    def seconds(self) -> float:
        """Working time of all processes together [s]."""
        return sum(record.seconds for _, record in self.summary.records)

    @cached_property
    def environments(self) -> list[dict[str, str]]:
        """The versions of cnpgen, Python and libraries that made the shards; more than one after an upgrade."""
        found: list[dict[str, str]] = []
        for _, record in self.summary.records:
            if (versions := dict(record.versions)) not in found:
                found.append(versions)
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return everything for JSON."""
        blueprint = self.blueprint
        content = {
            "folder": self.folder,
            **{name: getattr(blueprint, name) for name in ("name", "version", "title", "license")},
            **{name: getattr(self, name) for name in ("complete", "state", "bytes", "seconds")},
            "damage": [*self.summary.problems, *self.damage] if self.sealed else [],
            "shards": {"planned": self.summary.n_shards, "finished": len(self.summary.records)},
            "rows": {split: {"planned": blueprint.splits[split], "stored": rows} for split, rows in self.rows.items()},
            "fields": [self._field(field) for field in blueprint.fields],
            "yield": _yield(self.fates),
            "yield_by_split": {split: _yield(fates) for split, fates in self.summary.fates_by_split.items()},
            "densities": densities_to_json(self.fates.densities),
            "verification": self.fates.verification,
            "seed": str(blueprint.seed),
            **{
                name: getattr(blueprint, name)
                for name in ("generator", "backend", "dtype", "shard_size", "recipe_sha256")
            },
            "plan_fingerprint": blueprint.fingerprint,
            "versions": blueprint.versions,
            "environments": self.environments,
        }
        found: dict[str, Any] = plain(content)
        return found

    def _field(self, field: Field) -> dict[str, Any]:
        names = ("name", "unit", "long_name", "width", "names", "role", "frame", "dtype", "valid_min", "valid_max")
        content = {name: getattr(field, name) for name in names}
        found = self.statistics.get(field.name)
        if found is None:
            return content
        return content | {"min": found.minimum, "mean": found.mean, "max": found.maximum, "std": found.std}


def _yield(fates: Fates) -> dict[str, Any]:
    """Return tried, accepted and, in pipeline order, why draws were rejected and how many went on."""
    tried, left, steps = max(fates.tried, 1), fates.tried, []
    for reason, count in fates.rejections.items():
        left -= count
        stage = fates.stages.get(reason, "")
        steps.append({"stage": stage, "reason": reason, "draws": count, "share": count / tried, "left": left / tried})
    share = fates.accepted / tried
    return {"tried": fates.tried, "accepted": fates.accepted, "acceptance": share, "rejections": steps}


def inspect_dataset(folder: str | Path) -> Inspection:
    """Look at a dataset, finished or not.

    Args:
        folder: Its folder.

    Raises:
        UsageError: There is no such folder.
        DatasetError: It holds no dataset, or its plan.json is damaged.
        MachineError: The system would not let us read something.
    """
    folder = Path(folder)
    require_folder(folder)
    if not is_dataset(folder):
        raise DatasetError(f"{folder} is not a dataset of cnpgen: it has no {PLAN}")
    try:
        blueprint = load_blueprint(folder)
    except DatasetError as error:
        raise DatasetError(f"{error}; 'cnpgen validate' says what to do") from error
    summary = summarise(folder, blueprint, allow_incomplete=True)
    sealed = (folder / MANIFEST).is_file()
    damage = tuple(str(finding) for finding in check_documents(folder, blueprint)) if sealed else ()
    return Inspection(folder, summary, sealed, _size(folder, blueprint), damage)


def _size(folder: Path, blueprint: Blueprint) -> int:
    """Add up the files of a dataset, without what else is in its folder [bytes]."""
    names = [*DOCUMENTS, *(name for task in shards(blueprint) for name in (task.file, task.sidecar))]
    return sum((folder / name).stat().st_size for name in names if (folder / name).is_file())
