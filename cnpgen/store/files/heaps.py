"""Detection of damage that makes HDF5 hang: inconsistent sizes in global heaps, which contain variable-length texts."""

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError

_BEGIN = np.frombuffer(b"GCOL\x01\0\0\0", "<u8")[0]  # signature and version of a collection; 7e-315 as a float64
_HEADER = 16  # bytes, of a collection and of each of its objects
_CHUNK_WORDS = 1 << 20  # compared at once, which limits the memory of the comparison


def check_heaps(path: Path, content: NDArray[np.uint8]) -> None:
    """Raise an error if the objects of a global heap collection do not fill it.

    HDF5 walks from object to object by their sizes. After a damaged size it can reach zeros, an object of size 0, and
    never ends (HDF5 2.0, function H5HG__cache_heap_deserialize).

    Args:
        path: Path of the HDF5 file, for messages.
        content: Content of the file, shape (bytes,).

    Raises:
        DatasetError: A collection is damaged.
    """
    words = content[: len(content) // 8 * 8].view("<u8")  # collections begin at multiples of 8 bytes
    for first in range(0, len(words), _CHUNK_WORDS):
        for word in (first + np.flatnonzero(words[first : first + _CHUNK_WORDS] == _BEGIN)).tolist():
            if not _is_consistent(content, 8 * word):
                raise DatasetError(f"{path} is damaged: its texts at byte {8 * word} cannot be read")


def _is_consistent(content: NDArray[np.uint8], begin: int) -> bool:
    """Walk through a collection as HDF5 does; object 0 is the free space at the end of the collection."""
    if begin + _HEADER > len(content):
        return False
    size: int = struct.unpack_from("<Q", content.data, begin + 8)[0]
    end = begin + size
    if end > len(content):
        return False
    position = begin + _HEADER
    while position + _HEADER <= end:
        number, _, _, length = struct.unpack_from("<HHIQ", content.data, position)
        if number == 0:
            return bool(position + length == end)
        position += _HEADER + (length + 7) // 8 * 8
    return bool(position <= end)
