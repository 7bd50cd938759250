"""Reading whole fields of shards, of rows and of their scenes, and mapping them into memory to use some rows."""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray, Indices
from cnpgen.errors import DatasetError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import scene_poses
from cnpgen.robots.solid import pose_width
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import parse, stored_values
from cnpgen.store.checked_shard import (
    Shard,
    check_field,
    check_header,
    check_values,
    read_columns,
    read_scenes,
)
from cnpgen.store.dataset_spec import DatasetSpec
from cnpgen.store.field import Field, Fields
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.intact import RERUN_HINT, digest_problem
from cnpgen.store.scene_table import OBSTACLE_POSES, SCENE_ID, SceneTable
from cnpgen.store.shard import StoredField, storage_dtype

Rows = dict[str, AnyArray]
# Kept open; each needs a file descriptor, and its pages can be reclaimed by the system.
MAX_MEMORY_MAPS = 32


def problem_obstacles(spec: DatasetSpec) -> tuple[Obstacle, ...]:
    """Return the obstacles of the problem of a dataset with scenes, those that samples place included; else none."""
    if not spec.scene_obstacles:
        return ()
    tables = spec.recipe["pipeline"]["problem"]["obstacle"]
    given = [
        {key: value for key, value in table.items() if value is not None}
        for table in tables
    ]
    with stored_values():
        parsed = [
            parse(Obstacle, table, where=RecipeLocation("obstacle"), errors=[])
            for table in given
        ]
    return tuple(obstacle for obstacle in parsed if obstacle is not None)


def scene_fields(spec: DatasetSpec) -> Fields:
    """Return the fields of the scene of each sample; empty for a dataset without scenes.

    ``obstacle_poses`` has the layout of the problem's obstacles
    (``cnpgen.robots.solid``). The others are the arrays of the shards, flattened:
    ``obstacle_position`` has shape (N, 3 O).
    """
    if not spec.scene_obstacles:
        return ()
    text = "poses and sizes of the problem's obstacles in the scene"
    width = pose_width(problem_obstacles(spec))
    return (
        Field(OBSTACLE_POSES, "m", text, width, role="context", frame="world"),
        *spec.scene_fields,
    )


@dataclass(frozen=True, eq=False)
class SceneColumn:
    """A field of the scenes of the rows of a shard; indexing computes the values of the selected rows only.

    The index of the scene of each row has shape (rows,).
    """

    name: str
    table: SceneTable
    index: Indices
    obstacles: Sequence[Obstacle]
    dtype: np.dtype[Any]

    def __getitem__(self, rows: Any) -> AnyArray:
        """Return the values of rows, shape (k, width) or (k,)."""
        index = self.index[rows]
        # Poses are computed once for each scene of the rows.
        scenes, place = np.unique(index, return_inverse=True)
        chosen = self.table[scenes]
        if self.name == OBSTACLE_POSES:
            return scene_poses(self.obstacles, chosen).astype(self.dtype)[place]
        values: AnyArray = getattr(chosen, self.name)[place]
        return values.reshape(len(index), -1) if values.ndim > 1 else values


class ShardReader:
    """Reader of fields of shards; every shard and every field is checked when it is read for the first time.

    Its only open files are the memory maps of the last shards. It can be used by
    several threads, forked, and pickled without its maps. Without ``verify``, size,
    header and values of a shard are checked, but not its sha256.
    """

    def __init__(self, *, verify: bool, obstacles: Sequence[Obstacle] = ()) -> None:
        self._verify = verify
        self._obstacles = tuple(obstacles)
        # Of the last shard whose scenes were read.
        self._scenes: tuple[Path, SceneTable] | None = None
        # Of the checked shards.
        self._placements: dict[Path, dict[str, StoredField]] = {}
        # Name -> field whose shape, type and values are checked.
        self._checked: dict[Path, dict[str, Field]] = {}
        self._maps: dict[Path, mmap.mmap] = {}

    def __getstate__(self) -> dict[str, Any]:
        # Maps cannot be pickled, and scenes are read again.
        return self.__dict__ | {"_maps": {}, "_scenes": None}

    def read(self, shard: Shard, fields: Sequence[Field]) -> Rows:
        """Read whole fields of a shard into memory: values as stored, shape (rows, width) or (rows,)."""
        fields, of_scenes = self._split(shard, fields)
        placements = self._header(shard, fields)
        columns = read_columns(shard, placements, [field.name for field in fields])
        columns |= {
            name: column[:]
            for name, column in self._scene_columns(shard, of_scenes).items()
        }
        checked = self._checked.setdefault(shard.path, {})
        # Values are checked at the first reading only.
        stored = {field.name for field in fields} - checked.keys()
        check_values(shard, {name: columns[name] for name in stored})
        checked.update((field.name, field) for field in fields)
        return columns

    def map(
        self, shard: Shard, fields: Sequence[Field]
    ) -> dict[str, AnyArray | SceneColumn]:
        """Map fields of a shard into memory, to use some of their rows; they are read the first time.

        Mapped values are read-only; fields of scenes are computed for the rows that are
        used. The system ends a process that uses a part of a map after the file was cut
        off there.
        """
        fields, of_scenes = self._split(shard, fields)
        scenes = self._scene_columns(shard, of_scenes)
        placements = self._header(shard, fields)
        selected = {field.name: placements[field.name] for field in fields}
        mapped = None
        checked = self._checked.get(shard.path, {}).keys() >= selected.keys()
        if checked and all(
            # A view of the file needs contiguous numbers in the byte order of the
            # machine.
            place.offset is not None and place.dtype.isnative
            for place in selected.values()
        ):
            mapped = self._map(shard)
        if mapped is None:
            return {**self.read(shard, fields), **scenes}
        return {
            name: np.ndarray(p.shape, p.dtype, mapped, p.offset or 0)
            for name, p in selected.items()
        } | scenes

    @staticmethod
    def _split(
        shard: Shard, fields: Sequence[Field]
    ) -> tuple[list[Field], list[Field]]:
        """Separate the fields of rows from those of scenes."""
        if not shard.spec.scene_obstacles:
            return list(fields), []
        stored = {field.name for field in shard.spec.fields}
        return [f for f in fields if f.name in stored], [
            f for f in fields if f.name not in stored
        ]

    def _scene_columns(
        self, shard: Shard, fields: Sequence[Field]
    ) -> dict[str, SceneColumn]:
        """Return fields of the scenes of a shard."""
        if not fields:
            return {}
        scene_id = next(field for field in shard.spec.fields if field.name == SCENE_ID)
        index = self.read(shard, [scene_id])[SCENE_ID]
        # Other threads may replace it.
        last = self._scenes
        if last is None or last[0] != shard.path:
            last = self._scenes = (
                shard.path,
                read_scenes(shard, self._placements[shard.path]),
            )
        table = last[1]
        rows = table.rows_of(index)
        dtypes = {
            field.name: storage_dtype(field, shard.spec.dtype) for field in fields
        }
        return {
            name: SceneColumn(name, table, rows, self._obstacles, dtype)
            for name, dtype in dtypes.items()
        }

    def _header(self, shard: Shard, fields: Sequence[Field]) -> dict[str, StoredField]:
        """Check a shard; return the locations of its fields."""
        if problem := shard.problem():
            raise DatasetError(f"{problem}; {RERUN_HINT}")
        if shard.path not in self._placements:
            if self._verify and file_sha256(shard.path) != shard.sha256:
                raise DatasetError(f"{digest_problem(shard.path)}; {RERUN_HINT}")
            self._placements[shard.path] = check_header(shard)
        placements = self._placements[shard.path]
        checked = self._checked.get(shard.path, {})
        for field in fields:
            if checked.get(field.name) is not field:
                check_field(shard, field, placements.get(field.name))
        return placements

    def _map(self, shard: Shard) -> mmap.mmap | None:
        """Map a shard into memory; None if the file system does not support it."""
        if (existing := self._maps.get(shard.path)) is not None:
            return existing
        try:
            with shard.path.open("rb") as file:
                mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError):
            # The file is then read without mapping.
            return None
        for oldest in list(self._maps)[: max(len(self._maps) - MAX_MEMORY_MAPS + 1, 0)]:
            # Stays mapped as long as arrays of it are in use.
            self._maps.pop(oldest, None)
        self._maps[shard.path] = mapped
        return mapped


@dataclass(frozen=True, eq=False)
class SplitShards:
    """The existing shards of a split, in order.

    The fingerprint is that of the whole dataset.
    """

    split: str
    shards: tuple[Shard, ...]
    reader: ShardReader
    fingerprint: str
    stored: str

    @cached_property
    def rows(self) -> int:
        """Number of rows."""
        return sum(shard.rows for shard in self.shards)
