"""Attributes of HDF5 files and datasets: only short, plain values are read; used by ``hdf5``."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from cnpgen.errors import DatasetError
from cnpgen.store.files.size_limits import MAX_ATTRIBUTE_BYTES, MAX_NAMES


@dataclass(frozen=True, eq=False)
class Attributes:
    """The attributes of a file or of a dataset: texts, numbers and short lists of numbers."""

    path: Path
    _item: Any  # an identifier of the low-level API of h5py

    def __iter__(self) -> Iterator[str]:
        from h5py import h5a

        if (count := h5a.get_num_attrs(self._item)) > MAX_NAMES:
            raise DatasetError(f"{self.path} has {count:,} attributes, expected at most {MAX_NAMES:,}")
        names: list[bytes] = []
        h5a.iterate(self._item, names.append)
        return (decoded(self.path, name) for name in names)

    def __contains__(self, name: str) -> bool:
        from h5py import h5a

        return bool(h5a.exists(self._item, name.encode()))

    def __getitem__(self, name: str) -> Any:
        """Return a text, a number or an array of numbers.

        Raises:
            DatasetError: The attribute has another type or is too large.
        """
        from h5py import AttributeManager, h5a, h5s, h5t

        attribute = h5a.open(self._item, name.encode())
        kind, space = attribute.get_type(), attribute.get_space()
        text, count = kind.get_class() == h5t.STRING, space.get_simple_extent_npoints()
        scalar = space.get_simple_extent_type() == h5s.SCALAR
        plain = scalar if text else kind.get_class() in {h5t.INTEGER, h5t.FLOAT} and count > 0
        if not plain:
            raise DatasetError(f"{self.path}: the attribute {name!r} must be a text, a number or a list of numbers")
        if count * kind.get_size() > MAX_ATTRIBUTE_BYTES:
            raise DatasetError(f"{self.path}: the attribute {name!r} is larger than {MAX_ATTRIBUTE_BYTES:,} bytes")
        return AttributeManager(SimpleNamespace(id=self._item))[name]

    def some(self, names: Iterable[str]) -> dict[str, Any]:
        """Return the existing attributes among ``names``."""
        return {name: self[name] for name in names if name in self}

    def all(self) -> dict[str, Any]:
        """Return all attributes."""
        return {name: self[name] for name in self}


def decoded(path: Path, name: bytes) -> str:
    """Decode a name in a file.

    Raises:
        DatasetError: The name is not UTF-8.
    """
    try:
        return name.decode()
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} is damaged: it has the name {name!r}, which is not UTF-8") from error
