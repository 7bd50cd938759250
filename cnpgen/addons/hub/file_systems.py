"""Datasets on web servers and in object stores, through fsspec: ``https://``, ``s3://``, ``gs://``.

Credentials and addresses of stores are those of their libraries, such as
AWS_ACCESS_KEY_ID, and of the configuration of fsspec.
"""

import hashlib
import io
import re
from dataclasses import dataclass, replace
from http import HTTPStatus
from pathlib import Path
from threading import Event
from typing import IO, Any

from cnpgen.addons.hub.downloads import HDF5, RemoteFolder, local_copy
from cnpgen.errors import (
    DatasetError,
    MachineError,
    MissingExtraError,
    UsageError,
    requires_extra,
)
from cnpgen.store.files.atomic import machine_errors
from cnpgen.store.files.cache_folder import default_cache_folder, make_private_folder
from cnpgen.store.files.size_limits import MAX_DOCUMENT_BYTES
from cnpgen.store.layout import MANIFEST

DATASETS = "datasets"  # folder of the copies in the cache
BLOCK_BYTES = 1 << 16  # a transfer is ended between two blocks
_PACKAGES = {"s3": "s3fs", "gs": "gcsfs"}


@dataclass(frozen=True)
class FileSystemFolder(RemoteFolder):
    """A folder of a file system of fsspec.

    Attributes:
        url: Its address.
        system: The file system.
        path: Path of the folder in it.
    """

    url: str
    system: Any
    path: str

    def save(
        self, name: str, path: Path, *, max_bytes: int, anew: bool, stop: Event
    ) -> None:
        """Append the rest of a file to a path; see ``RemoteFolder.save``."""
        if anew:
            path.unlink(missing_ok=True)
        try:
            with path.open("ab") as target:
                self.append(name, target, max_bytes, stop)
        except ValueError:
            # From servers that cannot begin in the middle of a file.
            path.unlink()
            with path.open("ab") as target:
                self.append(name, target, max_bytes, stop)

    def append(self, name: str, target: IO[bytes], max_bytes: int, stop: Event) -> None:
        """Append what a file has beyond the bytes that are already there."""
        first = target.tell()
        # Over HTTP, one request for a whole file, instead of one for each block.
        is_http = self.url.startswith(("http://", "https://"))
        options = {"block_size": 0} if is_http and not first else {}
        with self._open(f"{self.path}/{name}", options) as source:
            if first:
                source.seek(first)
            # No more bytes than the manifest states are read, whatever the server
            # sends.
            left = max_bytes - first
            while left > 0 and (block := source.read(min(BLOCK_BYTES, left))):
                if stop.is_set():
                    raise InterruptedError("another file or the caller ended it")
                target.write(block)
                left -= len(block)

    def _open(self, path: str, options: dict[str, int]) -> Any:
        """Open a file; HTTP of fsspec takes a server that cannot be reached for a missing file."""
        try:
            return self.system.open(path, "rb", **options)
        except FileNotFoundError as error:
            cause = error.__cause__
            missing = isinstance(cause, FileNotFoundError) or cause is None
            if missing or getattr(cause, "status", None) == HTTPStatus.NOT_FOUND:
                raise
            raise ConnectionError(str(cause)) from error


def download(url: str) -> Path:
    """Return the local copy of a dataset at a URL, which is downloaded first.

    Only the manifest is read if the copy is complete.

    Raises:
        UsageError: The URL has a query.
        DatasetError: It has no finished dataset, or a file is missing or damaged.
        MissingExtraError: A package that reads the URL is not installed.
        MachineError: The server cannot be reached, or the download was interrupted.
    """
    if "?" in url or "#" in url:
        raise UsageError(
            f"{url:.200}: expected the URL of a folder, without a query or an anchor",
            concerns="folder",
        )
    remote = _open_folder(url.rstrip("/"))
    # The dataset is at the URL itself, or in a repository of ``publish_dataset``.
    for folder in (remote, replace(remote, path=f"{remote.path}/{HDF5}")):
        if manifest := _read_manifest(folder):
            return local_copy(folder, manifest, _cache_folder(url, manifest))
    raise DatasetError(
        f"{remote.url} has no finished dataset: neither {MANIFEST} nor {HDF5}/{MANIFEST}"
    )


def _open_folder(url: str) -> FileSystemFolder:
    scheme = url.partition(":")[0]
    with requires_extra("hub", "fsspec"):
        import fsspec
    try:
        # Messages name the address without user and password.
        shown = re.sub("//[^/@]*@", "//", url)
        return FileSystemFolder(shown, *fsspec.url_to_fs(url))
    except ImportError as error:
        package = _PACKAGES.get(scheme, "'cnpgen[hub]'")
        raise MissingExtraError(
            f"{scheme}:// needs a package that is missing: pip install {package}"
        ) from error


def _read_manifest(folder: FileSystemFolder) -> bytes:
    """Read the manifest of a folder; empty if it has none."""
    content = io.BytesIO()
    try:
        folder.append(MANIFEST, content, MAX_DOCUMENT_BYTES, Event())
    except FileNotFoundError:
        return b""
    except Exception as error:
        # Libraries of file systems raise any of them.
        text = f"{type(error).__name__}: {error!s:.300}"
        raise MachineError(f"{folder.url} cannot be read: {text}") from error
    return content.getvalue()


def _cache_folder(url: str, manifest: bytes) -> Path:
    """Return the place of a copy in the cache: one for each URL and state of the dataset there."""
    # A changed dataset at the same URL gets a folder of its own.
    place, state = (
        hashlib.sha256(content).hexdigest()[:16] for content in (url.encode(), manifest)
    )
    cache = default_cache_folder()
    with machine_errors("write", cache):
        make_private_folder(cache)
    return cache / DATASETS / place / state
