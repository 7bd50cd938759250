"""The only entry point for reading HDF5 files: it returns plain numbers that are stored in the file itself.

Other features of HDF5 are refused with an error that names the dataset. These are
external storage, links to other files, references, variable-length texts and filters
that are loaded as code.
"""

import errno
import io
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.errors import DatasetError, MachineError
from cnpgen.store.files.atomic import machine_error
from cnpgen.store.files.heaps import check_heaps
from cnpgen.store.files.kind import apparent_kind
from cnpgen.store.files.size_limits import (
    MAX_ATTRIBUTE_BYTES,
    MAX_DIMENSIONS,
    MAX_EXPANSION,
    MAX_HDF5_BYTES,
    MAX_NAMES,
    MIN_EXPANSION_LIMIT_BYTES,
)

# Errors of h5py for damaged files.
_DAMAGE = OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError
_SYSTEM_ERRORS = {
    errno.EACCES,
    errno.EPERM,
    errno.EMFILE,
    errno.ENFILE,
    errno.EIO,
    errno.ENOMEM,
    errno.ESTALE,
}
# Filters that are built into every h5py.
_FILTERS = {
    1: "gzip",
    2: "shuffle",
    3: "fletcher32",
    32000: "lzf",
}


def create_hdf5(buffer: io.BytesIO, *, userblock: int = 0, alignment: int = 64) -> Any:
    """Create an HDF5 file in ``buffer``; wrap it in ``h5py.File``.

    The file format is pinned. The root group stores no times; older versions of
    ``h5py.File`` cannot switch them off. The file begins with a user block [bytes]. The
    alignment [bytes] allows to map datasets into memory as arrays.
    """
    from h5py import h5f, h5fd, h5p

    creation = h5p.create(h5p.FILE_CREATE)
    access = h5p.create(h5p.FILE_ACCESS)
    creation.set_userblock(userblock)
    # Times in the file would make equal contents differ.
    creation.set_obj_track_times(False)
    access.set_fileobj_driver(h5fd.fileobj_driver, buffer)
    # A fixed format version: the bytes do not depend on the installed HDF5.
    access.set_libver_bounds(h5f.LIBVER_V110, h5f.LIBVER_V110)
    access.set_alignment(1, alignment)
    return h5f.create(b"buffer", h5f.ACC_TRUNC, creation, access)


@dataclass(frozen=True, eq=False)
class Attributes:
    """The attributes of a file or of a dataset: texts, numbers and short lists of numbers."""

    path: Path
    _item: Any  # an identifier of the low-level API of h5py

    def __iter__(self) -> Iterator[str]:
        from h5py import h5a

        if (count := h5a.get_num_attrs(self._item)) > MAX_NAMES:
            raise DatasetError(
                f"{self.path} has {count:,} attributes, expected at most {MAX_NAMES:,}"
            )
        names: list[bytes] = []
        h5a.iterate(self._item, names.append)
        return (_decoded(self.path, name) for name in names)

    def __contains__(self, name: str) -> bool:
        from h5py import h5a

        return bool(h5a.exists(self._item, name.encode()))

    def __getitem__(self, name: str) -> Any:
        """Return a text, a number or an array of numbers.

        Other types and large values raise DatasetError.
        """
        from h5py import AttributeManager, h5a, h5s, h5t

        attribute = h5a.open(self._item, name.encode())
        kind = attribute.get_type()
        space = attribute.get_space()
        text = kind.get_class() == h5t.STRING
        count = space.get_simple_extent_npoints()
        scalar = space.get_simple_extent_type() == h5s.SCALAR
        plain = (
            scalar
            if text
            else kind.get_class() in {h5t.INTEGER, h5t.FLOAT} and count > 0
        )
        if not plain:
            raise DatasetError(
                f"{self.path}: the attribute {name!r} must be a text, a number or a list of numbers"
            )
        if count * kind.get_size() > MAX_ATTRIBUTE_BYTES:
            raise DatasetError(
                f"{self.path}: the attribute {name!r} is larger than {MAX_ATTRIBUTE_BYTES:,} bytes"
            )
        return AttributeManager(SimpleNamespace(id=self._item))[name]

    def texts(self, name: str) -> tuple[str, ...]:
        """Return a text or a list of texts.

        Other types and large values raise DatasetError.
        """
        from h5py import AttributeManager, h5a

        attribute = h5a.open(self._item, name.encode())
        _check_texts(self.path, f"the attribute {name!r}", attribute)
        return _as_texts(AttributeManager(SimpleNamespace(id=self._item))[name])

    def some(self, names: Iterable[str]) -> dict[str, Any]:
        """Return the existing attributes among ``names``."""
        return {name: self[name] for name in names if name in self}

    def all(self) -> dict[str, Any]:
        """Return all attributes."""
        return {name: self[name] for name in self}


def _decoded(path: Path, name: bytes) -> str:
    """Decode a name in a file; one that is not UTF-8 raises DatasetError."""
    try:
        return name.decode()
    except UnicodeDecodeError as error:
        raise DatasetError(
            f"{path} is damaged: it has the name {name!r}, which is not UTF-8"
        ) from error


@dataclass(frozen=True, eq=False)
class Column:
    """A dataset of plain numbers, integers or floats.

    The offset is the position of the first number in the file [bytes]; None if the
    storage is not contiguous.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    offset: int | None
    attributes: Attributes
    _dataset: Any

    @property
    def bytes(self) -> int:
        """Size of the numbers in memory [bytes]."""
        return math.prod(self.shape) * self.dtype.itemsize

    def read(self, rows: slice | None = None) -> AnyArray:
        """Return the numbers, by default of all rows."""
        from h5py import Dataset

        return np.asarray(Dataset(self._dataset)[() if rows is None else rows])


@dataclass(eq=False)
class Hdf5:
    """An open file: a mapping from names at its root to datasets of plain numbers.

    Groups are skipped.
    """

    path: Path
    attributes: Attributes
    _root: Any  # an identifier of the low-level API of h5py
    _size: int
    _columns: dict[str, Column] = field(default_factory=dict)
    _opened: dict[str, Any] = field(default_factory=dict)

    def __iter__(self) -> Iterator[str]:
        """Yield the names of everything that is not a group, also of objects that cannot be read."""
        from h5py import h5g

        return (
            name
            for name in self.names()
            if not isinstance(self._open(name), h5g.GroupID)
        )

    def __contains__(self, name: str) -> bool:
        return name.encode() in self._root

    def __getitem__(self, name: str) -> Column:
        """Return a dataset without reading its numbers.

        All but plain numbers in this file, and more of them than possible, raise
        DatasetError.
        """
        if name not in self._columns:
            self._columns[name] = self._checked(name, self._open(name))
        return self._columns[name]

    def names(self) -> list[str]:
        """Return the names of all objects at the root, including groups and links."""
        if (count := len(self._root)) > MAX_NAMES:
            raise DatasetError(
                f"{self.path} has {count:,} datasets, expected at most {MAX_NAMES:,}"
            )
        return [_decoded(self.path, name) for name in self._root]

    def columns(self, *, without: Collection[str] = ()) -> Mapping[str, Column]:
        """Return all datasets but those of some names; see ``__getitem__``."""
        return {name: self[name] for name in self if name not in without}

    def texts(self, name: str) -> tuple[str, ...]:
        """Return a dataset of texts.

        Other types, large values and texts in another file raise DatasetError.
        """
        from h5py import Dataset, h5d

        dataset = self._open(name)
        if not isinstance(dataset, h5d.DatasetID):
            raise DatasetError(f"{self.path}: {name} must be a dataset of texts")
        layout = self._layout(f"texts of {name}", dataset)
        if layout.get_nfilters():
            raise DatasetError(f"{self.path}: the texts of {name} must not be packed")
        _check_texts(self.path, name, dataset)
        return _as_texts(Dataset(dataset)[()])

    def attributes_of(self, name: str) -> Attributes:
        """Return the attributes of a dataset, also of one of texts."""
        return Attributes(self.path, self._open(name))

    def _open(self, name: str) -> Any:
        """Open an object of the file."""
        from h5py import h5l, h5o

        if name not in self._opened:
            # Soft and external links may lead to other files.
            if self._root.links.get_info(name.encode()).type != h5l.TYPE_HARD:
                raise DatasetError(
                    f"{self.path} is damaged: its {name!r} is a link, and links are not followed"
                )
            self._opened[name] = h5o.open(self._root, name.encode())
        return self._opened[name]

    def _checked(self, name: str, dataset: Any) -> Column:
        """Check a dataset; every property is checked before an operation that relies on it."""
        from h5py import h5d, h5t

        if not isinstance(dataset, h5d.DatasetID):
            raise DatasetError(
                f"{self.path}: {name} must be a dataset, got a group or a type"
            )
        layout = self._layout(f"numbers of {name}", dataset)
        if dataset.get_type().get_class() not in {h5t.INTEGER, h5t.FLOAT}:
            raise DatasetError(
                f"{self.path}: {name} must hold numbers, got {_type_text(dataset)}"
            )
        filters = [
            layout.get_filter(index)[0] for index in range(layout.get_nfilters())
        ]
        if not _FILTERS.keys() >= set(filters):
            known = ", ".join(_FILTERS.values())
            raise DatasetError(
                f"{self.path}: {name} is packed with filter {filters}, expected {known} or none"
            )
        shape = dataset.shape
        if shape is None or len(shape) > MAX_DIMENSIONS:
            raise DatasetError(
                f"{self.path}: {name} must have at most {MAX_DIMENSIONS} dimensions, got {shape}"
            )
        attributes = Attributes(self.path, dataset)
        column = Column(shape, dataset.dtype, dataset.get_offset(), attributes, dataset)
        is_chunked = layout.get_layout() == h5d.CHUNKED
        self._check_size(name, column, layout.get_chunk() if is_chunked else ())
        return column

    def _layout(self, what: str, dataset: Any) -> Any:
        """Return the creation properties of a dataset whose values are in this file."""
        from h5py import h5d

        layout = dataset.get_create_plist()
        if layout.get_layout() == h5d.VIRTUAL or layout.get_external_count():
            raise DatasetError(
                f"{self.path}: the {what} are in another file, which is not read"
            )
        return layout

    def _check_size(self, name: str, column: Column, chunk: tuple[int, ...]) -> None:
        """Raise an error if this and all previous columns are larger than a file of this size can contain."""
        # The sum of all columns is limited: many of a permitted size could exhaust the
        # memory.
        previous = sum(item.bytes for item in self._columns.values())
        # HDF5 unpacks whole chunks, which may be larger than the dataset.
        declared = max(
            previous + column.bytes, math.prod(chunk) * column.dtype.itemsize
        )
        if declared > max(MAX_EXPANSION * self._size, MIN_EXPANSION_LIMIT_BYTES):
            raise DatasetError(
                f"{self.path}: {name} declares the shape {column.shape}: unpacked, the file of {self._size:,} bytes"
                f" would have {declared:,}, more than {MAX_EXPANSION} times as many"
            )
        if column.offset is not None and column.offset + column.bytes > self._size:
            raise DatasetError(
                f"{self.path} is damaged or cut off: {name} reaches outside its end"
            )


def _check_texts(path: Path, what: str, item: Any) -> None:
    """Check that an attribute or a dataset has texts, at most one dimension, and a possible size."""
    from h5py import h5t

    kind = item.get_type()
    space = item.get_space()
    count = space.get_simple_extent_npoints()
    if kind.get_class() != h5t.STRING or space.get_simple_extent_ndims() > 1:
        raise DatasetError(f"{path}: {what} must be a list of texts")
    if count > MAX_NAMES or count * kind.get_size() > MAX_ATTRIBUTE_BYTES:
        raise DatasetError(
            f"{path}: {what} is larger than {MAX_NAMES:,} texts or {MAX_ATTRIBUTE_BYTES:,} bytes"
        )


def _as_texts(values: Any) -> tuple[str, ...]:
    """Return one text or an array of texts, of h5py's types, as a tuple."""
    entries = np.ravel(np.asarray(values, object)).tolist()
    return tuple(
        entry.decode("utf-8", "replace") if isinstance(entry, bytes) else str(entry)
        for entry in entries
    )


def _type_text(dataset: Any) -> str:
    """Return the name of the type of a dataset, which NumPy may not support."""
    try:
        return str(dataset.dtype)
    except (TypeError, ValueError, RuntimeError):
        return "another type"


@contextmanager
def open_hdf5(path: Path, content: bytes | None = None) -> Iterator[Hdf5]:
    """Open an HDF5 file for reading, or its content if that has been read already.

    All handles are closed at the end of the block, so processes cannot share them.

    Raises:
        DatasetError: The file is missing, not an HDF5 file, too large, damaged or cut
            off; also raised for errors within the block.
        MachineError: The file cannot be read, or does not fit into memory.
    """
    with _checked_file(path, content) as (file, size):
        yield Hdf5(path, Attributes(path, file.id), file.id, size)


@contextmanager
def open_nested_hdf5(path: Path) -> Iterator[Any]:
    """Open an HDF5 file with groups for reading, as an ``h5py.File``.

    Raises:
        DatasetError: As ``open_hdf5``.
        MachineError: As ``open_hdf5``.
    """
    with _checked_file(path, None) as (file, _):
        yield file


@contextmanager
def _checked_file(path: Path, content: bytes | None) -> Iterator[tuple[Any, int]]:
    """Yield an ``h5py.File``, whose heaps have been checked, and its size."""
    import h5py

    if content is None and not path.is_file():
        raise DatasetError(
            f"{path} is missing" if not path.exists() else f"{path} is not a file"
        )
    try:
        if content is None:
            require_possible_size(path)
        with path.open("rb") if content is None else io.BytesIO(content) as stream:
            # Before HDF5 reads the file.
            size = check_heaps(path, stream)
        source: Any = path if content is None else io.BytesIO(content)
        with h5py.File(
            source, "r", locking="best-effort" if content is None else None
        ) as file:
            yield file, size
    except MemoryError as error:
        raise MachineError(
            f"cannot read {path}: its content does not fit into memory"
        ) from error
    except _DAMAGE as error:
        # A failed system call is no damage of the file.
        if isinstance(error, OSError) and error.errno in _SYSTEM_ERRORS:
            raise machine_error("read", path, error) from error
        if content is None and not h5py.is_hdf5(path):
            raise DatasetError(
                f"{path} is not an HDF5 file, or its beginning is damaged{apparent_kind(path)}"
            ) from error
        raise DatasetError(f"{path} is damaged or cut off: {error}") from error


def require_possible_size(path: Path) -> None:
    """Raise DatasetError if a file is larger than ``MAX_HDF5_BYTES``, as huge sparse files are."""
    if (size := path.stat().st_size) > MAX_HDF5_BYTES:
        raise DatasetError(
            f"{path} has {size:,} bytes, expected at most {MAX_HDF5_BYTES:,}"
        )
