"""Detection of damage that makes HDF5 hang: inconsistent sizes in global heaps, which contain variable-length texts."""

import os
import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from cnpgen.errors import DatasetError

# Signature and version of a collection; 7e-315 as a float64.
_BEGIN = np.frombuffer(b"GCOL\x01\0\0\0", "<u8")[0]
_HEADER = 16  # bytes, of a collection and of each of its objects
_CHUNK_BYTES = 1 << 23  # compared at once, which limits the memory of the comparison


def check_heaps(path: Path, file: BinaryIO) -> int:
    """Raise DatasetError if the objects of a global heap do not fill it; return the size of the file [bytes].

    HDF5 walks from object to object by their sizes. After a damaged size it can reach
    zeros, an object of size 0, and never ends (HDF5 2.0, function
    H5HG__cache_heap_deserialize). The content is read and not mapped into memory: using
    a map of a file that is cut off meanwhile would end the process.
    """
    begins, size = _collections(file)
    for begin in begins:
        if not _is_consistent(file, begin, size):
            raise DatasetError(
                f"{path} is damaged: its texts at byte {begin} cannot be read"
            )
    return size


def _collections(file: BinaryIO) -> tuple[list[int], int]:
    """Return the positions of all collections in a file, and the size of the file [bytes]."""
    begins = list[int]()
    size = 0
    buffer = bytearray(min(_CHUNK_BYTES, 8 * (file.seek(0, os.SEEK_END) // 8 + 1)))
    file.seek(0)
    while count := file.readinto(buffer):  # type: ignore[attr-defined]
        # Collections begin at multiples of 8 bytes.
        words = np.frombuffer(buffer, "<u8", count // 8)
        begins += (size + 8 * np.flatnonzero(words == _BEGIN)).tolist()
        size += count
    return begins, size


def _is_consistent(file: BinaryIO, begin: int, size: int) -> bool:
    """Walk through a collection as HDF5 does.

    Object 0 is the free space at the end of the collection.
    """
    if begin + _HEADER > size:
        return False
    end = begin + int(_unpack(file, begin + 8, "<Q")[0])
    if end > size:
        return False
    position = begin + _HEADER
    while position + _HEADER <= end:
        number, _, _, length = _unpack(file, position, "<HHIQ")
        # Object 0 is the free space, the last one.
        if number == 0:
            return bool(position + length == end)
        # Objects are padded to multiples of 8 bytes.
        position += _HEADER + (length + 7) // 8 * 8
    return bool(position <= end)


def _unpack(file: BinaryIO, position: int, form: str) -> tuple[int, ...]:
    """Read integers; those after the end of a truncated file are zero."""
    size = struct.calcsize(form)
    file.seek(position)
    return struct.unpack(form, file.read(size).ljust(size, b"\0"))
