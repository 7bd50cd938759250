"""The one door through which HDF5 files are read: it gives plain numbers that are in the file itself, and short texts.

HDF5 can do more: datasets whose bytes are in other files, links to other files, references, texts of any number in
other places, filters that are loaded as code. None of that is followed; whatever is asked for and is no plain dataset
is refused by name.
"""

import errno
import io
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, MachineError
from cnpgen.store.files.atomic import machine_error
from cnpgen.store.files.attributes import Attributes, decoded
from cnpgen.store.files.heaps import check_heaps
from cnpgen.store.files.kind import seeming
from cnpgen.store.files.limits import ALWAYS, EXPANSION, MOST_BYTES, MOST_DIMENSIONS, MOST_NAMES

_DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError)  # what h5py raises on broken files
_SYSTEM_ERRORS = {errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.EIO, errno.ENOMEM, errno.ESTALE}
_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}  # those that every h5py has in itself


def create_hdf5(buffer: io.BytesIO, *, userblock: int = 0, alignment: int = 64) -> Any:
    """Create an HDF5 file in ``buffer``; wrap it in ``h5py.File``.

    The file format is pinned. The root group stores no times, which ``h5py.File`` has only lately learnt to leave out.

    Args:
        buffer: Where the file is made.
        userblock: What is left free at its beginning [bytes].
        alignment: Datasets start at multiples of it, so that they can be mapped into memory as aligned arrays [bytes].
    """
    from h5py import h5f, h5fd, h5p

    creation, access = h5p.create(h5p.FILE_CREATE), h5p.create(h5p.FILE_ACCESS)
    creation.set_userblock(userblock)
    creation.set_obj_track_times(False)
    access.set_fileobj_driver(h5fd.fileobj_driver, buffer)
    access.set_libver_bounds(h5f.LIBVER_V110, h5f.LIBVER_V110)
    access.set_alignment(1, alignment)
    return h5f.create(b"buffer", h5f.ACC_TRUNC, creation, access)


@dataclass(frozen=True, eq=False)
class Column:
    """A dataset of plain numbers.

    Attributes:
        shape: Its shape.
        dtype: Its stored type: integers or floats.
        offset: Where its numbers begin in the file [bytes]; None if they are not there in one piece.
        attributes: Texts and numbers that are attached to it.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    offset: int | None
    attributes: Attributes
    _dataset: Any

    @property
    def bytes(self) -> int:
        """How much memory its numbers take."""
        return math.prod(self.shape) * self.dtype.itemsize

    def read(self) -> NDArray[Any]:
        """Return its numbers."""
        from h5py import Dataset

        return np.asarray(Dataset(self._dataset)[()])


@dataclass(eq=False)
class Hdf5:
    """An open file: a mapping from names at its root to datasets of plain numbers; groups are passed over.

    Attributes:
        path: Where it is, for messages.
        attributes: Texts and numbers that are attached to the file.
    """

    path: Path
    attributes: Attributes
    _root: Any  # an identifier of h5py's lower interface
    _size: int
    _given: dict[str, Column] = field(default_factory=dict)
    _opened: dict[str, Any] = field(default_factory=dict)

    def __iter__(self) -> Iterator[str]:
        """Yield the names of what is not a group, whether it can be given or not."""
        from h5py import h5g

        return (name for name in self.names() if not isinstance(self._open(name), h5g.GroupID))

    def __contains__(self, name: str) -> bool:
        return name.encode() in self._root

    def __getitem__(self, name: str) -> Column:
        """Return a dataset without reading its numbers.

        Raises:
            DatasetError: It is not stored in this file in a plain way, holds no numbers, or declares more of them than
                can be true.
        """
        if name not in self._given:
            self._given[name] = self._checked(name, self._open(name))
        return self._given[name]

    def names(self) -> list[str]:
        """Return the names of all that is at the root, groups and links included."""
        if (count := len(self._root)) > MOST_NAMES:
            raise DatasetError(f"{self.path} has {count:,} datasets, expected at most {MOST_NAMES:,}")
        return [decoded(self.path, name) for name in self._root]

    def columns(self) -> Mapping[str, Column]:
        """Return every dataset; see ``__getitem__``."""
        return {name: self[name] for name in self}

    def _open(self, name: str) -> Any:
        """Open what is in the file under a name."""
        from h5py import h5l, h5o

        if name not in self._opened:
            if self._root.links.get_info(name.encode()).type != h5l.TYPE_HARD:
                raise DatasetError(f"{self.path} is damaged: its {name!r} is a link, and links are not followed")
            self._opened[name] = h5o.open(self._root, name.encode())
        return self._opened[name]

    def _checked(self, name: str, dataset: Any) -> Column:
        """Look at a dataset in an order in which nothing is believed, or opened, before it is known to be plain."""
        from h5py import h5d, h5t

        if not isinstance(dataset, h5d.DatasetID):
            raise DatasetError(f"{self.path}: {name} must be a dataset, got a group or a type")
        layout = dataset.get_create_plist()
        if layout.get_layout() == h5d.VIRTUAL or layout.get_external_count():
            raise DatasetError(f"{self.path}: the numbers of {name} are in another file, where they are not looked for")
        if dataset.get_type().get_class() not in {h5t.INTEGER, h5t.FLOAT}:
            raise DatasetError(f"{self.path}: {name} must hold numbers, got {_type_text(dataset)}")
        filters = [layout.get_filter(index)[0] for index in range(layout.get_nfilters())]
        if not _FILTERS.keys() >= set(filters):
            known = ", ".join(_FILTERS.values())
            raise DatasetError(f"{self.path}: {name} is packed with filter {filters}, expected {known} or none")
        shape = dataset.shape
        if shape is None or len(shape) > MOST_DIMENSIONS:
            raise DatasetError(f"{self.path}: {name} must have at most {MOST_DIMENSIONS} dimensions, got {shape}")
        found = Column(shape, dataset.dtype, dataset.get_offset(), Attributes(self.path, dataset), dataset)
        self._check_size(name, found, layout.get_chunk() if layout.get_layout() == h5d.CHUNKED else ())
        return found

    def _check_size(self, name: str, found: Column, chunk: tuple[int, ...]) -> None:
        """Refuse more numbers than a file of this size can honestly hold, together with those given before."""
        before = sum(item.bytes for item in self._given.values())
        declared = max(before + found.bytes, math.prod(chunk) * found.dtype.itemsize)
        if declared > max(EXPANSION * self._size, ALWAYS):
            raise DatasetError(
                f"{self.path}: {name} declares the shape {found.shape}: unpacked, the file of {self._size:,} bytes"
                f" would have {declared:,}, more than {EXPANSION} times as many"
            )
        if found.offset is not None and found.offset + found.bytes > self._size:
            raise DatasetError(f"{self.path} is damaged or cut off: {name} reaches beyond its end")


def _type_text(dataset: Any) -> str:
    """Say what type a dataset has; some have none in NumPy."""
    try:
        return str(dataset.dtype)
    except (TypeError, ValueError, RuntimeError):
        return "another type"


@contextmanager
def opened_hdf5(path: Path, content: bytes | None = None) -> Iterator[Hdf5]:
    """Open an HDF5 file for reading, without handles that outlive the block and could be shared by processes.

    Args:
        path: The file.
        content: What is in it, if that was read already.

    Raises:
        DatasetError: The file is missing, no HDF5 file, too large, damaged or cut off, as opening or the block finds
            out.
        MachineError: The system would not let us read it, or what is read is more than the memory holds.
    """
    import h5py

    if content is None and not path.is_file():
        raise DatasetError(f"{path} is missing" if not path.exists() else f"{path} is not a file")
    try:
        size = _check_bytes(path, content)
        source: Any = path if content is None else io.BytesIO(content)
        with h5py.File(source, "r", locking="best-effort" if content is None else None) as file:
            yield Hdf5(path, Attributes(path, file.id), file.id, size)
    except MemoryError as error:
        raise MachineError(f"cannot read {path}: what is in it does not fit into memory") from error
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.errno in _SYSTEM_ERRORS:
            raise machine_error("read", path, error) from error
        if content is None and not h5py.is_hdf5(path):
            raise DatasetError(f"{path} is not an HDF5 file, or its beginning is damaged{seeming(path)}") from error
        raise DatasetError(f"{path} is damaged or cut off: {error}") from error


def require_possible_size(path: Path) -> int:
    """Return the size of a file [bytes]; a file of nothing but a size can be sent in a few bytes.

    Raises:
        DatasetError: It is larger than any of cnpgen's.
    """
    if (size := path.stat().st_size) > MOST_BYTES:
        raise DatasetError(f"{path} has {size:,} bytes, expected at most {MOST_BYTES:,}")
    return size


def _check_bytes(path: Path, content: bytes | None) -> int:
    """Refuse damage on which HDF5 would hang; return the size of the file [bytes]."""
    if content is not None:
        check_heaps(path, np.frombuffer(content, np.uint8))
        return len(content)
    if require_possible_size(path) == 0:  # what is empty cannot be mapped
        return 0
    try:
        found: NDArray[np.uint8] = np.memmap(path, np.uint8, "r")
    except OSError:  # file systems without memory maps
        found = np.fromfile(path, np.uint8)
    check_heaps(path, found)
    return len(found)
