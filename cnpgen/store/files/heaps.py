"""Damage on which HDF5 itself would hang: global heaps, where texts of any length are, whose sizes do not add up."""

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError

_BEGIN = np.frombuffer(b"GCOL\x01\0\0\0", "<u8")[0]  # of a collection: signature and version; as a number 7e-315
_HEADER = 16  # bytes, of a collection and of each object in it
_PART = 1 << 20  # words that are looked at together: a comparison needs memory of its own


def check_heaps(path: Path, content: NDArray[np.uint8]) -> None:
    """Refuse a file with a global heap collection whose objects do not fill it.

    The library walks from object to object by their sizes; where one is damaged it comes upon zeros, an object of no
    size at all, and does not move on (HDF5 2.0, function H5HG__cache_heap_deserialize).

    Args:
        path: An HDF5 file, for messages.
        content: What is in it, shape (bytes,).

    Raises:
        DatasetError: There is such a collection.
    """
    words = content[: len(content) // 8 * 8].view("<u8")  # collections begin at multiples of 8 bytes
    for first in range(0, len(words), _PART):
        for word in (first + np.flatnonzero(words[first : first + _PART] == _BEGIN)).tolist():
            if not _adds_up(content, 8 * word):
                raise DatasetError(f"{path} is damaged: its texts at byte {8 * word} cannot be read")


def _adds_up(content: NDArray[np.uint8], begin: int) -> bool:
    """Walk through a collection as HDF5 does; free space, object 0, is the last and ends where the collection ends."""
    if begin + _HEADER > len(content):
        return False
    size: int = struct.unpack_from("<Q", content.data, begin + 8)[0]
    end = begin + size
    if end > len(content):
        return False
    place = begin + _HEADER
    while place + _HEADER <= end:
        number, _, _, length = struct.unpack_from("<HHIQ", content.data, place)
        if number == 0:
            return bool(place + length == end)
        place += _HEADER + (length + 7) // 8 * 8
    return bool(place <= end)
