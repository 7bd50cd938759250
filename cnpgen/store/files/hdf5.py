"""HDF5 files: created with pinned bytes, opened for reading, and searched for damage on which HDF5 itself would hang.

That damage is in global heaps, where texts of variable length are, whose sizes do not add up.
"""

import errno
import io
import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError
from cnpgen.store.files.atomic import machine_error
from cnpgen.store.files.kind import seeming

_BEGIN = b"GCOL\x01\0\0\0"  # of a collection: signature and version; as a number it would be 7e-315
_HEADER = 16  # bytes, of a collection and of each object in it
_DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError)  # what h5py raises on broken files
_SYSTEM_ERRORS = {errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.EIO, errno.ENOMEM, errno.ESTALE}


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


@contextmanager
def opened_hdf5(path: Path) -> Iterator[Any]:
    """Open an HDF5 file for reading, without handles that outlive the block and could be shared by processes.

    Raises:
        DatasetError: The file is missing, no HDF5 file, damaged or cut off, as opening or the block finds out.
        MachineError: The system would not let us read it.
    """
    import h5py

    if not path.is_file():
        raise DatasetError(f"{path} is missing")
    try:
        with h5py.File(path, "r", locking="best-effort") as file:
            yield file
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.errno in _SYSTEM_ERRORS:
            raise machine_error("read", path, error) from error
        if not h5py.is_hdf5(path):
            raise DatasetError(f"{path} is not an HDF5 file, or its beginning is damaged{seeming(path)}") from error
        raise DatasetError(f"{path} is damaged or cut off: {error}") from error


@contextmanager
def opened_foreign_hdf5(path: Path) -> Iterator[Any]:
    """Open an HDF5 file of which nobody knows whether it is as it was written; see ``opened_hdf5``.

    Raises:
        DatasetError: The file is missing, no HDF5 file, damaged or cut off, as opening or the block finds out.
        MachineError: The system would not let us read it.
    """
    if path.is_file():
        check_heaps(path)
    with opened_hdf5(path) as file:
        yield file


def check_heaps(path: Path) -> None:
    """Refuse a file with a global heap collection whose objects do not fill it.

    The library walks from object to object by their sizes; where one is damaged it comes upon zeros, an object of no
    size at all, and does not move on (HDF5 2.0, function H5HG__cache_heap_deserialize).

    Args:
        path: An HDF5 file.

    Raises:
        DatasetError: There is such a collection.
        MachineError: The system would not let us read it.
    """
    try:
        with path.open("rb") as file:
            if file.seek(0, 2) == 0:
                return
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                place = content.find(_BEGIN)
                while place >= 0:
                    if place % 8 == 0 and not _adds_up(content, place):
                        raise DatasetError(f"{path} is damaged: its texts at byte {place} cannot be read")
                    place = content.find(_BEGIN, place + 1)
    except OSError as error:
        raise machine_error("read", path, error) from error


def _adds_up(content: mmap.mmap, begin: int) -> bool:
    """Walk through a collection as HDF5 does; free space, object 0, is the last and ends where the collection ends."""
    size: int = struct.unpack_from("<Q", content, begin + 8)[0]
    end = begin + size
    if end > len(content):
        return False
    place = begin + _HEADER
    while place + _HEADER <= end:
        number, _, _, length = struct.unpack_from("<HHIQ", content, place)
        if number == 0:
            return bool(place + length == end)
        place += _HEADER + (length + 7) // 8 * 8
    return bool(place <= end)
