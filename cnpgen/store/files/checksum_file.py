"""HDF5 files with a checksum: the first 512 bytes contain the kind of the file and the sha256 of the rest.

The checksum is stored in the user block of the HDF5 format, so every HDF5 reader opens
these files. It is verified before the HDF5 library reads the file, because that library
can hang on a damaged file.
"""

import hashlib
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.errors import DatasetError
from cnpgen.store.files.atomic import machine_errors, read_file, write_file
from cnpgen.store.files.hdf5 import create_hdf5, open_hdf5, require_possible_size
from cnpgen.store.files.kind import HDF5, apparent_kind, kind_name, own_kind
from cnpgen.store.files.size_limits import MAX_CHECKSUM_FILE_BYTES

HEADER_BYTES = 512
# At least one remains of a damaged header.
_HEADER_PART = re.compile(rb"cnpgen-[a-z]+ [0-9]|sha256 [0-9a-f]{64}")
_CHECKSUM = re.compile(rb"(cnpgen-[a-z]+) ([0-9]{1,6})\nsha256 ([0-9a-f]{64})\n")
_CHANGED = f"{{}} is damaged: its first {HEADER_BYTES} bytes were changed"


@dataclass(frozen=True)
class Content:
    """Numbers, and texts as UTF-8 bytes, in a file with a checksum, by the name of their dataset."""

    arrays: Mapping[str, AnyArray]
    texts: Mapping[str, str]


def write_with_checksum(
    path: Path, content: Content, *, kind: str, version: int
) -> None:
    """Write a file with a checksum atomically; equal content gives equal bytes.

    The kind is ``cnpgen-`` and one word, the version that of the format. An existing
    file is replaced.
    """
    write_file(path, encode_with_checksum(content, kind=kind, version=version))


def encode_with_checksum(content: Content, *, kind: str, version: int) -> bytes:
    """Return the bytes of a file with a checksum."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(create_hdf5(buffer, userblock=HEADER_BYTES, alignment=1)) as file:
        for name, values in content.arrays.items():
            file.create_dataset(name, data=values, track_times=False)
        for name, text in content.texts.items():
            file.create_dataset(
                name, data=np.frombuffer(text.encode(), np.uint8), track_times=False
            )
    return with_checksum(buffer.getvalue(), kind=kind, version=version)


def with_checksum(content: bytes, *, kind: str, version: int) -> bytes:
    """Put the checksum into the user block, of ``HEADER_BYTES``, of an HDF5 file.

    See ``write_with_checksum``.
    """
    # HDF5 ignores the user block, so that other programs read the file, too.
    body = content[HEADER_BYTES:]
    head = f"{kind} {version}\nsha256 {hashlib.sha256(body).hexdigest()}\n"
    return head.encode().ljust(HEADER_BYTES, b"\0") + body


def verify_checksum(path: Path, *, kind: str, version: int) -> bool:
    """Verify the checksum of a file, if it has one; return whether it has one.

    A damaged checksum is an error, and not taken for a missing one. A damaged or too
    large file, and another format version, raise DatasetError.
    """
    with machine_errors("read", path), path.open("rb") as file:
        block = file.read(HEADER_BYTES)
        # A file of other software: HDF5 begins at once, or the block has no part of a
        # header.
        if block.startswith(HDF5) or not _HEADER_PART.search(block):
            return False
        require_possible_size(path)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    _check_checksum(path, block, digest, kind=kind, version=version)
    return True


def _check_checksum(
    path: Path, block: bytes, digest: str, *, kind: str, version: int
) -> None:
    """Raise an error if the header is not that of a kind and version with this sha256 of the rest of the file."""
    head = _CHECKSUM.match(block)
    expected = kind_name(kind.removeprefix("cnpgen-"))
    if head is None and not _HEADER_PART.search(block):
        raise DatasetError(
            f"{path} is not {expected}, or its beginning is damaged{apparent_kind(path)}"
        )
    if head and head[1].decode() != kind and (other := own_kind(block)):
        raise DatasetError(f"{path} is {other}, not {expected}")
    if head is None or head[1].decode() != kind:
        raise DatasetError(_CHANGED.format(path))
    if int(head[2]) != version:
        remedy = "upgrade cnpgen" if int(head[2]) > version else "make it again"
        raise DatasetError(
            f"{path} has format version {int(head[2])}, this cnpgen reads version {version}: {remedy}"
        )
    # The sha256 covers only the rest: the bytes after the header must be zero.
    if block != head[0].ljust(HEADER_BYTES, b"\0"):
        raise DatasetError(_CHANGED.format(path))
    if digest.encode() != head[3]:
        raise DatasetError(
            f"{path} is damaged or cut off: its sha256 is not the recorded one"
        )


def read_with_checksum(path: Path, *, kind: str, version: int) -> Content:
    """Read a file with a checksum and verify it.

    A missing, too large or damaged file, and another kind or format version, raise
    DatasetError.
    """
    data = read_file(path, max_bytes=MAX_CHECKSUM_FILE_BYTES)
    _check_checksum(
        path,
        data[:HEADER_BYTES],
        hashlib.sha256(data[HEADER_BYTES:]).hexdigest(),
        kind=kind,
        version=version,
    )
    with open_hdf5(path, data) as file:
        values = {name: item.read() for name, item in file.columns().items()}
    try:
        texts = {
            name: value.tobytes().decode()
            for name, value in values.items()
            if value.dtype == np.uint8
        }
    except UnicodeDecodeError as error:
        raise DatasetError(
            f"{path} is damaged: one of its texts is not UTF-8"
        ) from error
    return Content(
        {name: value for name, value in values.items() if name not in texts}, texts
    )
