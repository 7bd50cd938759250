"""Archives of NumPy arrays (NPZ): limits on decoded sizes, and one error for all failures of NumPy and zipfile."""

import io
import lzma
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np

from cnpgen.arrays import AnyArray, Columns

_FAILURES = (  # of NumPy and zipfile for damaged, encrypted and foreign content
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, tokenize.TokenError, SyntaxError,
    ValueError, KeyError, TypeError, IndexError, AttributeError, EOFError, OSError, RuntimeError, MemoryError,
    OverflowError,
)  # fmt: skip


_HEADERS = {  # by format version; the third one is for names of fields, which arrays of numbers lack
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


class ArchiveError(ValueError):
    """Content that is no archive of NumPy arrays, is damaged or is too large."""


def read_arrays(
    source: Path | bytes, *, max_bytes: int, stored: bool = False
) -> Columns:
    """Read all arrays of an archive.

    Args:
        source: Path of the archive, or its bytes.
        max_bytes: Largest size of the decoded arrays as floats of 8 bytes, which is
            compared before they are read.
        stored: Whether compressed arrays are refused.

    Raises:
        ArchiveError: The content is not an archive of arrays, encrypted, damaged or too
            large.
        OSError: The file cannot be opened.
    """
    file = io.BytesIO(source) if isinstance(source, bytes) else source.open("rb")
    with file:
        try:
            with zipfile.ZipFile(file) as archive:
                members = archive.infolist()
                # Stated sizes are limited before any member is decoded.
                _check(sum(member.file_size for member in members), max_bytes)
                size = sum(_size_as_floats(archive, member) for member in members)
                is_stored = all(m.compress_type == zipfile.ZIP_STORED for m in members)
                _check(size, max_bytes, accepted=is_stored or not stored)
                return {
                    member.filename.removesuffix(".npy"): _read_array(archive, member)
                    for member in members
                }
        except ArchiveError:
            raise
        except _FAILURES as error:
            text = str(error).replace("\0", "\\0") or type(error).__name__
            raise ArchiveError(f"{text:.300}") from error


def _check(size: int, max_bytes: int, *, accepted: bool = True) -> None:
    """Raise ArchiveError for too many bytes, and for arrays that are compressed if these are not accepted."""
    if size > max_bytes:
        raise ArchiveError(f"it holds {size:,} bytes, expected at most {max_bytes:,}")
    if not accepted:
        raise ArchiveError("its arrays are compressed")


def _size_as_floats(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> int:
    """Return the bytes of an array with at least 8 per value; its header states no more values than the archive has."""
    with archive.open(member) as content:
        read_header = _HEADERS[np.lib.format.read_magic(content)]
        shape, _, dtype = read_header(content)
        # Python integers do not overflow.
        size = int(np.prod([int(length) for length in shape], dtype=object))
        if dtype.hasobject or size * dtype.itemsize > member.file_size:
            raise ArchiveError(
                f"array {member.filename!r} states {size:,} values of {dtype}, which it does not hold"
            )
        # Readers convert numbers to float64.
        return size * max(dtype.itemsize, 8)


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> AnyArray:
    """Read one array."""
    with archive.open(member) as content:
        return np.asarray(np.lib.format.read_array(content, allow_pickle=False))
