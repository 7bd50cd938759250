"""The shards of a dataset that are there, and reading whole fields of one: mapped into memory where possible."""

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
from cnpgen.store.intact import AGAIN, digest_problem, size_problem
from cnpgen.store.layout import PLAN
from cnpgen.store.shard import Placement, read_placements, read_shard

MOST_MAPS = 32  # that are kept; each holds a file descriptor, and pages that the system may take back at any time


@dataclass(frozen=True)
class Shard:
    """A shard and what is recorded of it.

    Attributes:
        path: Its file.
        rows: Number of rows.
        first_row: Index of its first row within the split, as it was planned.
        size: Size of the file [bytes].
        sha256: Its digest.
        key: The blueprint's key, which the file repeats.
    """

    path: Path
    rows: int
    first_row: int
    size: int
    sha256: str
    key: int

    def problem(self) -> str:
        """Say what is wrong with the file without opening it; nothing if its size is right."""
        return size_problem(self.path, self.size)


class ShardReader:
    """Reads fields of shards; every shard is checked once, when it is first read.

    Holds no open files but the memory maps of the last shards. It may be used by several threads, pickled (without its
    maps) and forked.

    Args:
        verify: Compare each shard's sha256 with the recorded one before its first use; else only size and header.
    """

    def __init__(self, *, verify: bool) -> None:
        self._verify = verify
        self._placements: dict[Path, dict[str, Placement]] = {}  # of the shards that were checked
        self._maps: dict[Path, mmap.mmap] = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_maps": {}}

    def read(self, shard: Shard, fields: Sequence[Field]) -> dict[str, NDArray[Any]]:
        """Give whole fields of a shard.

        Args:
            shard: The shard.
            fields: The fields.

        Returns:
            Field name -> values as stored, shape (rows, width) or (rows,), not writeable where mapped.

        Raises:
            DatasetError: The shard is missing, damaged, of another blueprint or lacks a field.
            MachineError: The system would not let us read it.
        """
        if problem := shard.problem():  # to touch a map that reaches beyond its file would end the process
            raise DatasetError(f"{problem}; {AGAIN}")
        placements = self._placements.get(shard.path) or self._check(shard)
        for field in fields:
            _check_field(shard, field, placements.get(field.name))
        places = {field.name: placements[field.name] for field in fields}
        mapped = None
        if all(place.offset is not None and place.dtype.isnative for place in places.values()):
            mapped = self._map(shard)
        if mapped is None:
            return read_shard(shard.path, list(places))
        return {name: np.ndarray(p.shape, p.dtype, mapped, p.offset or 0) for name, p in places.items()}

    def _check(self, shard: Shard) -> dict[str, Placement]:
        if self._verify and file_sha256(shard.path) != shard.sha256:
            raise DatasetError(f"{digest_problem(shard.path)}; {AGAIN}")
        placements, found = read_placements(shard.path)
        if found != {"plan_key": shard.key, "first_sample_id": shard.first_row, "rows": shard.rows}:
            raise DatasetError(f"{shard.path} is of another dataset or another place in it; {AGAIN}")
        self._placements[shard.path] = placements
        return placements

    def _map(self, shard: Shard) -> mmap.mmap | None:
        """Map a shard into memory; None where the file system cannot."""
        if (kept := self._maps.get(shard.path)) is not None:
            return kept
        mapped = _mapped(shard)
        if mapped is not None:
            for oldest in list(self._maps)[: max(len(self._maps) - MOST_MAPS + 1, 0)]:
                self._maps.pop(oldest, None)  # stays mapped for as long as arrays of it are in use
            self._maps[shard.path] = mapped
        return mapped


def _mapped(shard: Shard) -> mmap.mmap | None:
    try:
        with shard.path.open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError):  # reading it in the ordinary way works, or says why not
        return None


def _check_field(shard: Shard, field: Field, found: Placement | None) -> None:
    """Refuse a shard whose header does not say what the blueprint says of a field."""
    shape = (shard.rows, *tail(field))
    kind = "f" if field.dtype == "float" else "i"
    if found is None or found.shape != shape or found.dtype.kind != kind:
        text = "is missing" if found is None else f"is {found.dtype} of shape {found.shape}"
        raise DatasetError(f"{shard.path}: field {field.name!r} {text}; {PLAN} says {field.dtype} of shape {shape}")


@dataclass(frozen=True, eq=False)
class SplitShards:
    """The shards of a split.

    Attributes:
        split: Name of the split.
        shards: Its shards that are there, in order.
        reader: Reads them.
        fingerprint: Fingerprint of the whole dataset's rows.
        stored: Type that fields of numbers are stored in, "float64" or "float32".
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
