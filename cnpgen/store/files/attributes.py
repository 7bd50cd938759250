"""What is attached to HDF5 files and their datasets, as far as it is short and plain: part of the door in ``hdf5``."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError
from cnpgen.store.files.limits import MOST_ATTRIBUTE_BYTES, MOST_NAMES


@dataclass(frozen=True, eq=False)
class Attributes:
    """What is attached to a file or to a dataset: texts, numbers, short lists of numbers."""

    path: Path
    _item: Any  # an identifier of h5py's lower interface

    def __iter__(self) -> Iterator[str]:
        from h5py import h5a

        if (count := h5a.get_num_attrs(self._item)) > MOST_NAMES:
            raise DatasetError(f"{self.path} has {count:,} attributes, expected at most {MOST_NAMES:,}")
        names: list[bytes] = []
        h5a.iterate(self._item, names.append)
        return (decoded(self.path, name) for name in names)

    def __contains__(self, name: str) -> bool:
        from h5py import h5a

        return bool(h5a.exists(self._item, name.encode()))

    def __getitem__(self, name: str) -> Any:
        """Return a text, a number or an array of numbers.

        Raises:
            DatasetError: It is something else, or too large.
        """
        from h5py import AttributeManager, h5a, h5s, h5t

        found = h5a.open(self._item, name.encode())
        kind, space = found.get_type(), found.get_space()
        text, count = kind.get_class() == h5t.STRING, space.get_simple_extent_npoints()
        scalar = space.get_simple_extent_type() == h5s.SCALAR
        plain = scalar if text else kind.get_class() in {h5t.INTEGER, h5t.FLOAT} and count > 0
        if not plain:
            raise DatasetError(f"{self.path}: the attribute {name!r} must be a text, a number or a list of numbers")
        if count * kind.get_size() > MOST_ATTRIBUTE_BYTES:
            raise DatasetError(f"{self.path}: the attribute {name!r} is larger than {MOST_ATTRIBUTE_BYTES:,} bytes")
        return AttributeManager(_Parent(self._item))[name]

    def some(self, names: Iterable[str]) -> dict[str, Any]:
        """Return those of some names that are there."""
        return {name: self[name] for name in names if name in self}

    def all(self) -> dict[str, Any]:
        """Return everything."""
        return {name: self[name] for name in self}


@dataclass(frozen=True)
class _Parent:
    """What h5py wants to know of the owner of attributes."""

    id: Any


def decoded(path: Path, name: bytes) -> str:
    """Return a name in a file as text.

    Raises:
        DatasetError: It is none.
    """
    try:
        return name.decode()
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} is damaged: it has the name {name!r}, which is not UTF-8") from error
