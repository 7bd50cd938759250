"""Requests of finished results, so that a command that is repeated, such as a requeued job, ends without an error.

The request of OUT is in the hidden file ``.OUT.request`` beside it, with the sha256 of
the result: a result that was changed or replaced since is not taken for finished.
"""

import hashlib
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from cnpgen.errors import CnpgenError, UsageError
from cnpgen.machine.versions import __version__
from cnpgen.store.files.atomic import file_sha256, read_file, write_file
from cnpgen.store.files.documents import canonical_sha256, parse_json

MAX_REQUEST_BYTES = 4096


def request_file(out: Path) -> Path:
    """Return the path of the request of a result."""
    return out.with_name(f".{out.name}.request")


def is_finished(out: Path, request: object, *, force: bool) -> bool:
    """Return whether a result exists whose request was the same.

    Args:
        out: Path of the result, a file or a folder.
        request: Everything on which the result depends, as plain values.
        force: Whether an existing result is replaced in any case.

    Raises:
        UsageError: The result exists, and is of another request or of an unknown one;
            or its request has no place.
    """
    if request_file(out).is_dir():
        raise UsageError(
            f"{request_file(out)} is a folder, where the request of {out.name} is"
            " to be stored: remove it"
        )
    if force or not _is_there(out):
        return False
    document = {}
    # A missing or damaged request is that of no result.
    with suppress(CnpgenError, ValueError):
        content = read_file(request_file(out), max_bytes=MAX_REQUEST_BYTES)
        document = parse_json(content.decode())
    # The checksum of the result shows whether it was changed since.
    if document == {"request": _digest(request), "result": content_sha256(out)}:
        return True
    raise UsageError(
        f"{out} exists: --force replaces it, -o names another file"
        + (" (it is of another request, or was changed since)" if document else "")
    )


def record_request(out: Path, request: object) -> None:
    """Write the request of a result that is complete.

    Raises:
        MachineError: The file cannot be written.
    """
    document = {"request": _digest(request), "result": content_sha256(out)}
    write_file(request_file(out), json.dumps(document) + "\n")


def content_sha256(path: Path) -> str:
    """Return a checksum of a file, or of the names and the contents of a folder's files.

    A path without a file has the checksum of its name: it names what is in the package.
    """
    if path.is_file():
        return file_sha256(path)
    digest = hashlib.sha256(b"" if path.is_dir() else str(path).encode())
    for name in _files(path):
        digest.update(f"{name}\0{file_sha256(path / name)}\n".encode())
    return digest.hexdigest()


def _is_there(out: Path) -> bool:
    """Return whether there is a file, or a folder that is not empty."""
    return any(out.iterdir()) if out.is_dir() else out.exists()


def _files(folder: Path) -> Iterator[str]:
    """Yield the files of a folder and of those in it, relative to it and in order."""
    if folder.is_dir():
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                yield path.relative_to(folder).as_posix()


def _digest(request: object) -> str:
    # Another version of the package may give another result.
    return canonical_sha256({"cnpgen": __version__, "request": request})
