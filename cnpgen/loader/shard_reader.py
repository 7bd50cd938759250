"""Reading whole fields of shards, by memory mapping where possible."""

import mmap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError
from cnpgen.loader.columns import tail
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.intact import RERUN_HINT, digest_problem, size_problem
from cnpgen.store.layout import SPECIFICATION
from cnpgen.store.shard import Placement, read_placements, read_shard

MAX_MEMORY_MAPS = 32  # kept open; each needs a file descriptor, and its pages can be reclaimed by the system


@dataclass(frozen=True)
class Shard:
    """A shard with its recorded properties.

    Attributes:
        path: File of the shard.
        rows: Number of rows.
        first_row: Index of its first row within the split.
        size: Size of the file [bytes].
        sha256: sha256 of the file.
        key: Key of the specification, which the file contains, too.
    """

    path: Path
    rows: int
    first_row: int
    size: int
    sha256: str
    key: int

    def problem(self) -> str:
        """Describe the problem of the file without opening it; empty if it has the recorded size."""
        return size_problem(self.path, self.size)


class ShardReader:
    """Reader of fields of shards; every shard is checked when it is read for the first time.

    Its only open files are the memory maps of the last shards. It can be used by several threads, forked, and pickled
    without its maps.

    Args:
        verify: Whether to verify the sha256 of each shard; otherwise only size and header are checked.
    """

    def __init__(self, *, verify: bool) -> None:
        self._verify = verify
        self._placements: dict[Path, dict[str, Placement]] = {}  # of the checked shards
        self._maps: dict[Path, mmap.mmap] = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_maps": {}}

    def read(self, shard: Shard, fields: Sequence[Field]) -> dict[str, NDArray[Any]]:
        """Read whole fields of a shard.

        Args:
            shard: The shard.
            fields: The fields.

        Returns:
            Field name -> values as stored, shape (rows, width) or (rows,); read-only if mapped.

        Raises:
            DatasetError: The shard is missing, damaged, of another specification or lacks a field.
            MachineError: The shard cannot be read.
        """
        if problem := shard.problem():  # reading a map outside its file would kill the process
            raise DatasetError(f"{problem}; {RERUN_HINT}")
        placements = self._placements.get(shard.path) or self._check(shard)
        for field in fields:
            _check_field(shard, field, placements.get(field.name))
        selected = {field.name: placements[field.name] for field in fields}
        mapped = None
        if all(place.offset is not None and place.dtype.isnative for place in selected.values()):
            mapped = self._map(shard)
        if mapped is None:
            return read_shard(shard.path, list(selected))
        return {name: np.ndarray(p.shape, p.dtype, mapped, p.offset or 0) for name, p in selected.items()}

    def _check(self, shard: Shard) -> dict[str, Placement]:
        if self._verify and file_sha256(shard.path) != shard.sha256:
            raise DatasetError(f"{digest_problem(shard.path)}; {RERUN_HINT}")
        placements, identity = read_placements(shard.path)
        if identity != {"specification_key": shard.key, "first_sample_id": shard.first_row, "rows": shard.rows}:
            raise DatasetError(f"{shard.path} is of another dataset or another position in it; {RERUN_HINT}")
        self._placements[shard.path] = placements
        return placements

    def _map(self, shard: Shard) -> mmap.mmap | None:
        """Map a shard into memory; None if the file system does not support it."""
        if (existing := self._maps.get(shard.path)) is not None:
            return existing
        mapped = _mapped(shard)
        if mapped is not None:
            for oldest in list(self._maps)[: max(len(self._maps) - MAX_MEMORY_MAPS + 1, 0)]:
                self._maps.pop(oldest, None)  # stays mapped as long as arrays of it are in use
            self._maps[shard.path] = mapped
        return mapped


def _mapped(shard: Shard) -> mmap.mmap | None:
    try:
        with shard.path.open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError):  # the file is then read without mapping
        return None


def _check_field(shard: Shard, field: Field, placement: Placement | None) -> None:
    """Raise an error if a field of a shard does not have the shape and type of the specification."""
    shape = (shard.rows, *tail(field))
    kind = "f" if field.dtype == "float" else "i"
    if placement is None or placement.shape != shape or placement.dtype.kind != kind:
        actual = "is missing" if placement is None else f"is {placement.dtype} of shape {placement.shape}"
        expected = f"expected {field.dtype} of shape {shape} by {SPECIFICATION}"
        raise DatasetError(f"{shard.path}: field {field.name!r} {actual}, {expected}")


@dataclass(frozen=True, eq=False)
class SplitShards:
    """The shards of a split.

    Attributes:
        split: Name of the split.
        shards: Existing shards, in order.
        reader: Reader of the shards.
        fingerprint: Fingerprint of the rows of the whole dataset.
        stored: Stored type of float fields, "float64" or "float32".
    """

    split: str
    shards: tuple[Shard, ...]
    reader: ShardReader
    fingerprint: str
    stored: str

    @property
    def rows(self) -> int:
        """Number of rows."""
        return sum(shard.rows for shard in self.shards)
