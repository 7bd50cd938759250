"""Reading a dataset's rows back: for inspection, for planners, for whoever wants them as they are stored."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, lacks
from cnpgen.store.blueprint import Blueprint, ShardTask, load_blueprint, shards
from cnpgen.store.intact import require_intact
from cnpgen.store.layout import MANIFEST, PLAN
from cnpgen.store.manifest import lists_shards_of, load_manifest
from cnpgen.store.paths import require_folder
from cnpgen.store.record import is_committed, load_record
from cnpgen.store.shard import read_shard, storage_dtype
from cnpgen.store.summary import summarise, unfinished


@dataclass(frozen=True, eq=False)
class StoredDataset:
    """A dataset on disk; holds no open files, so it can be pickled and used in any process.

    The sha256 of every shard is compared with the recorded one before its rows are first given.

    Attributes:
        folder: Its folder.
        blueprint: Its blueprint.
        manifest: Its manifest; None while it is unfinished.
    """

    folder: Path
    blueprint: Blueprint
    manifest: dict[str, Any] | None

    def tasks(self, split: str) -> list[ShardTask]:
        """List the shards of a split that are there, in order.

        Raises:
            DatasetError: There is no such split.
        """
        if split not in self.blueprint.splits:
            raise DatasetError(f"{self.folder} {lacks('split', split, self.blueprint.splits)}")
        found = [task for task in shards(self.blueprint) if task.split == split]
        if self.manifest is None:
            return [task for task in found if is_committed(self.folder, self.blueprint, task)]
        return found

    def iter_shards(
        self, split: str, *, fields: Sequence[str] | None = None
    ) -> Iterator[tuple[ShardTask, dict[str, NDArray[Any]]]]:
        """Read the shards of a split one by one.

        Args:
            split: Name of the split.
            fields: Names of the fields; all by default, in the blueprint's order.

        Yields:
            The shard, and field name -> values, shape (rows, width) or (rows,).

        Raises:
            DatasetError: There is no such split or field, or a shard is damaged.
        """
        names = self._names(fields)
        for task in self.tasks(split):
            yield task, self._read(task, names)

    def read(
        self, split: str, *, fields: Sequence[str] | None = None, start: int = 0, stop: int | None = None
    ) -> dict[str, NDArray[Any]]:
        """Read rows ``start`` to ``stop`` of a split; of an unfinished dataset, those of them that are there.

        Args:
            split: Name of the split.
            fields: Names of the fields; all by default, in the blueprint's order.
            start: First row.
            stop: Row after the last one; all by default.

        Returns:
            Field name -> values, shape (rows, width) or (rows,).

        Raises:
            DatasetError: There is no such split or field, the rows are out of range, or a shard is damaged.
        """
        names = self._names(fields)
        tasks = self.tasks(split)
        rows = self.blueprint.splits[split]
        stop = rows if stop is None else stop
        if not 0 <= start <= stop <= rows:
            raise DatasetError(f"split {split!r} has rows 0 to {rows}, got {start} to {stop}")
        parts: dict[str, list[NDArray[Any]]] = {name: [self._no_rows(name)] for name in names}
        for task in tasks:
            low, high = max(start - task.first_row, 0), min(stop - task.first_row, task.rows)
            if low < high:
                columns = self._read(task, names)
                for name in names:
                    parts[name].append(columns[name][low:high])
        return {name: np.concatenate(items) for name, items in parts.items()}

    def _read(self, task: ShardTask, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Read fields of a shard that is the recorded one."""
        path = self.folder / task.file
        size, sha256 = self._recorded.get(task.file) or _of_sidecar(self.folder, task)
        require_intact(path, size=size, sha256=sha256)
        return read_shard(path, names)

    @cached_property
    def _recorded(self) -> dict[str, tuple[int, str]]:
        """Shard -> its size [bytes] and sha256, as the manifest lists them; empty while there is none."""
        splits = {} if self.manifest is None else self.manifest["splits"]
        return {
            entry["file"]: (entry["bytes"], entry["sha256"]) for split in splits.values() for entry in split["shards"]
        }

    def _names(self, fields: Sequence[str] | None) -> list[str]:
        return (
            [self.blueprint.field_named(name).name for name in fields]
            if fields
            else [f.name for f in self.blueprint.fields]
        )

    def _no_rows(self, name: str) -> NDArray[Any]:
        field = self.blueprint.field_named(name)
        return np.empty((0, field.width) if field.width else (0,), storage_dtype(field, self.blueprint.dtype))


def _of_sidecar(folder: Path, task: ShardTask) -> tuple[int, str]:
    """Return size [bytes] and sha256 of a shard as its sidecar has them."""
    record = load_record(folder, task)
    return record.bytes, record.sha256


def open_dataset(folder: str | Path, *, allow_incomplete: bool = False) -> StoredDataset:
    """Open a dataset for reading.

    Args:
        folder: Its folder.
        allow_incomplete: Open it even if it is unfinished.

    Raises:
        UsageError: There is no such folder.
        DatasetError: It holds no dataset, it is unfinished, or its plan.json or manifest is damaged.
        MachineError: The system would not let us read something.
    """
    folder = Path(folder)
    require_folder(folder)
    blueprint = load_blueprint(folder)
    if (folder / MANIFEST).exists():
        manifest = load_manifest(folder)
        if manifest["plan_fingerprint"] != blueprint.fingerprint:
            raise DatasetError(
                f"{folder / MANIFEST} is of another blueprint than {PLAN}: the folder mixes two datasets"
            )
        if not lists_shards_of(manifest, blueprint):
            raise DatasetError(f"{folder / MANIFEST} lists other shards than {PLAN}")
        return StoredDataset(folder, blueprint, manifest)
    if not allow_incomplete:
        raise DatasetError(f"{folder} is {unfinished(summarise(folder, blueprint, allow_incomplete=True))}")
    return StoredDataset(folder, blueprint, None)
