"""Reading the rows of a dataset as they are stored."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from cnpgen.arrays import AnyArray, Columns
from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError, lacks
from cnpgen.store.checked_shard import Shard, read_rows, read_scenes
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask, load_dataset_spec, shards
from cnpgen.store.dataset_summary import summarize_dataset, unfinished
from cnpgen.store.intact import require_intact
from cnpgen.store.layout import MANIFEST, SPECIFICATION
from cnpgen.store.manifest import lists_shards_of, load_manifest, shard_entries
from cnpgen.store.paths import require_dataset
from cnpgen.store.scene_table import SceneTable, distinct_scenes
from cnpgen.store.shard import storage_dtype
from cnpgen.store.shard_record import is_committed, load_record


@dataclass(frozen=True, eq=False)
class StoredDataset:
    """A dataset on disk. It has no open files, so it can be pickled and used in any process.

    The sha256 of every shard is verified before its rows are read for the first time.
    """

    folder: Path
    spec: DatasetSpec
    manifest: JsonObject | None

    def tasks(self, split: str) -> list[ShardTask]:
        """List the existing shards of a split, in order.

        An unknown split raises DatasetError.
        """
        if split not in self.spec.splits:
            raise DatasetError(
                f"{self.folder} {lacks('split', split, self.spec.splits)}",
                concerns="split",
            )
        tasks = [task for task in shards(self.spec) if task.split == split]
        if self.manifest is None:
            # Without a manifest shards may be missing between others.
            return [
                task for task in tasks if is_committed(self.folder, self.spec, task)
            ]
        return tasks

    def read(
        self,
        split: str,
        *,
        fields: Sequence[str] | None = None,
        start: int = 0,
        stop: int | None = None,
    ) -> Columns:
        """Read rows ``start`` to ``stop`` of a split; of an unfinished dataset, only the existing ones of them.

        By default, all fields are read, in the order of the specification, and all
        rows. The result is field name -> values, shape (rows, width) or (rows,). An
        unknown split or field, rows out of range, and a damaged shard raise
        DatasetError.
        """
        names = self._names(fields)
        tasks = self.tasks(split)
        rows = self.spec.splits[split]
        stop = rows if stop is None else stop
        if not 0 <= start <= stop <= rows:
            raise DatasetError(
                f"split {split!r} has rows 0 to {rows}, got {start} to {stop}"
            )
        # An empty first part gives shape and type to a selection without rows.
        parts: dict[str, list[AnyArray]] = {
            name: [self._no_rows(name)] for name in names
        }
        for task in tasks:
            low = max(start - task.first_row, 0)
            high = min(stop - task.first_row, task.rows)
            if low < high:
                columns = read_rows(self._checked(task), names)
                for name in names:
                    parts[name].append(columns[name][low:high])
        return {name: np.concatenate(items) for name, items in parts.items()}

    def read_scenes(
        self, split: str, *, start: int = 0, stop: int | None = None
    ) -> SceneTable:
        """Read the scenes of rows ``start`` to ``stop`` of a split, and those of other rows in the same shards.

        ``table.rows_of(scene_id)`` returns the index of the scene of each row. A
        dataset without scenes or rows, and a damaged shard, raise DatasetError.
        """
        if not self.spec.scene_obstacles:
            raise DatasetError(f"{self.folder} has no scenes")
        end = self.spec.splits[split] if stop is None else stop
        tables = [
            read_scenes(self._checked(task))
            for task in self.tasks(split)
            if task.first_row < end and task.first_row + task.rows > start
        ]
        if not tables:
            raise DatasetError(
                f"split {split!r} of {self.folder} has no rows {start} to {end}"
            )
        # Adjacent shards may share a scene.
        return distinct_scenes(tables)

    def shard(self, task: ShardTask) -> Shard:
        """Return a shard with its record in the manifest or, without a manifest, in its sidecar."""
        if (entry := self._entries.get(task.file)) is None:
            entry = vars(load_record(self.folder, task))
        return Shard(self.folder, self.spec, task, entry["bytes"], entry["sha256"])

    def _checked(self, task: ShardTask) -> Shard:
        """Verify a shard and return it."""
        shard = self.shard(task)
        require_intact(shard.path, size=shard.size, sha256=shard.sha256)
        return shard

    @cached_property
    def _entries(self) -> dict[str, JsonObject]:
        """Shard -> its entry in the manifest; empty without a manifest."""
        return shard_entries(self.manifest or {})

    def _names(self, fields: Sequence[str] | None) -> list[str]:
        return (
            [self.spec.field_named(name).name for name in fields]
            if fields
            else [f.name for f in self.spec.fields]
        )

    def _no_rows(self, name: str) -> AnyArray:
        field = self.spec.field_named(name)
        return np.empty(field.shape(0), storage_dtype(field, self.spec.dtype))


def open_dataset(
    folder: str | Path, *, allow_incomplete: bool = False
) -> StoredDataset:
    """Open a dataset for reading; an unfinished one only with ``allow_incomplete``.

    Raises:
        UsageError: The folder does not exist or contains no dataset.
        DatasetError: The dataset is unfinished or its documents are damaged.
        MachineError: A file cannot be read.
    """
    folder = require_dataset(folder)
    spec = load_dataset_spec(folder)
    if (folder / MANIFEST).exists():
        manifest = load_manifest(folder)
        if manifest["specification_fingerprint"] != spec.fingerprint:
            raise DatasetError(
                f"{folder / MANIFEST} is of another specification than {SPECIFICATION}: the folder mixes two datasets"
            )
        if not lists_shards_of(manifest, spec):
            raise DatasetError(
                f"{folder / MANIFEST} lists other shards than {SPECIFICATION}"
            )
        return StoredDataset(folder, spec, manifest)
    if not allow_incomplete:
        raise DatasetError(
            f"{folder} is {unfinished(summarize_dataset(folder, spec, allow_incomplete=True))}"
        )
    return StoredDataset(folder, spec, None)
