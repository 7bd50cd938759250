"""HDF5 files under a seal: the first 512 bytes say what the file is and the sha256 of all that follows.

Any HDF5 reader opens them (the format leaves the first block to the user); cnpgen checks the seal before the HDF5
library sees a byte, because that library can hang on a damaged file.
"""

import hashlib
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError
from cnpgen.store.files.atomic import machine_error, read_file, write_file
from cnpgen.store.files.hdf5 import create_hdf5, opened_hdf5, require_possible_size
from cnpgen.store.files.kind import HDF5, kind_name, own_kind, seeming
from cnpgen.store.files.limits import SEALED_BYTES

BLOCK = 512  # bytes of the seal
_TRACE = re.compile(rb"cnpgen-[a-z]+ [0-9]|sha256 [0-9a-f]{64}")  # one of them is left where the other is damaged
_SEAL = re.compile(rb"(cnpgen-[a-z]+) ([0-9]{1,6})\nsha256 ([0-9a-f]{64})\n")
_CHANGED = f"{{}} is damaged: its first {BLOCK} bytes are not as they were written"


@dataclass(frozen=True)
class Content:
    """What a sealed file holds.

    Attributes:
        arrays: Dataset name -> numbers.
        texts: Dataset name -> text, stored as UTF-8 bytes.
    """

    arrays: Mapping[str, NDArray[Any]]
    texts: Mapping[str, str]


def write_sealed(path: Path, content: Content, *, kind: str, version: int) -> None:
    """Write a sealed file atomically; equal content gives equal bytes.

    Args:
        path: Where to; a file that is there is replaced.
        content: What to write.
        kind: What the file is: ``cnpgen-`` and one word.
        version: Version of its format.

    Raises:
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    write_file(path, seal(content, kind=kind, version=version))


def seal(content: Content, *, kind: str, version: int) -> bytes:
    """Return the bytes of a sealed file."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(create_hdf5(buffer, userblock=BLOCK, alignment=1)) as file:
        for name, values in content.arrays.items():
            file.create_dataset(name, data=values, track_times=False)
        for name, text in content.texts.items():
            file.create_dataset(name, data=np.frombuffer(text.encode(), np.uint8), track_times=False)
    return under_seal(buffer.getvalue(), kind=kind, version=version)


def under_seal(content: bytes, *, kind: str, version: int) -> bytes:
    """Put the seal into the first block of an HDF5 file, which must have been left free.

    Args:
        content: The bytes of the file.
        kind: What it is: ``cnpgen-`` and one word.
        version: Version of its format.
    """
    body = content[BLOCK:]
    head = f"{kind} {version}\nsha256 {hashlib.sha256(body).hexdigest()}\n"
    return head.encode().ljust(BLOCK, b"\0") + body


def has_seal(path: Path, *, kind: str, version: int) -> bool:
    """Whether a file of a kind that need not be sealed is; a seal of which anything is there must be the right one.

    Args:
        path: The file.
        kind: What it would be under a seal.
        version: The newest version of its format that the caller understands.

    Raises:
        DatasetError: It is cut off, damaged, too large, or from a newer cnpgen.
        MachineError: The system would not let us read it.
    """
    try:
        with path.open("rb") as file:
            block = file.read(BLOCK)
            if block.startswith(HDF5) or not _TRACE.search(block):
                return False
            require_possible_size(path)
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise machine_error("read", path, error) from error
    _check_seal(path, block, digest, kind=kind, version=version)
    return True


def _check_seal(path: Path, block: bytes, digest: str, *, kind: str, version: int) -> None:
    """Refuse a file whose first block is not the right seal for the sha256 of what follows."""
    head, what = _SEAL.match(block), kind_name(kind.removeprefix("cnpgen-"))
    if head is None and not _TRACE.search(block):
        raise DatasetError(f"{path} is not {what}, or its beginning is damaged{seeming(path)}")
    if head and head[1].decode() != kind and (other := own_kind(block)):
        raise DatasetError(f"{path} is {other}, not {what}")
    if head is None or head[1].decode() != kind:
        raise DatasetError(_CHANGED.format(path))
    if int(head[2]) > version:
        raise DatasetError(
            f"{path} has format version {int(head[2])}, this cnpgen reads up to {version}: upgrade cnpgen"
        )
    if int(head[2]) < 1 or block != head[0].ljust(BLOCK, b"\0"):
        raise DatasetError(_CHANGED.format(path))
    if digest.encode() != head[3]:
        raise DatasetError(f"{path} is damaged or cut off: its sha256 is not the one it was written with")


def read_sealed(path: Path, *, kind: str, version: int) -> Content:
    """Read a sealed file.

    Args:
        path: The file.
        kind: What it must be.
        version: The newest version of its format that the caller understands.

    Raises:
        DatasetError: It is missing, of another kind, too large, cut off, damaged, or from a newer cnpgen.
        MachineError: The system would not let us read it.
    """
    data = read_file(path, most=SEALED_BYTES)
    _check_seal(path, data[:BLOCK], hashlib.sha256(data[BLOCK:]).hexdigest(), kind=kind, version=version)
    with opened_hdf5(path, data) as file:
        values = {name: item.read() for name, item in file.columns().items()}
    try:
        texts = {name: value.tobytes().decode() for name, value in values.items() if value.dtype == np.uint8}
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} is damaged: it has a text that is not UTF-8") from error
    return Content({name: value for name, value in values.items() if name not in texts}, texts)
