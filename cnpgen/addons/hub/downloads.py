"""Local copies of datasets that are published elsewhere.

A copy has the files of the manifest, each verified against its sha256. It is complete
or absent: files are collected in a folder beside it, which is renamed when all are
there. An interrupted download continues at the byte where it stopped.
"""

import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event

from tqdm import tqdm

from cnpgen.errors import CnpgenError, DatasetError, MachineError
from cnpgen.store.dataset_spec import load_dataset_spec
from cnpgen.store.files.atomic import file_sha256, machine_errors, write_file
from cnpgen.store.files.file_lock import try_lock, unlock
from cnpgen.store.files.size_limits import MAX_DOCUMENT_BYTES
from cnpgen.store.layout import DESCRIPTIONS, MANIFEST
from cnpgen.store.manifest import (
    LISTED,
    lists_shards_of,
    load_manifest,
    shard_entries,
)

HDF5 = "hdf5"  # folder of the dataset in a repository of ``cnpgen publish``
MAX_CONNECTIONS = 4


@dataclass(frozen=True)
class ListedFile:
    """A file of the manifest: its name, sha256, and the most bytes that it may have."""

    name: str
    sha256: str
    max_bytes: int = MAX_DOCUMENT_BYTES


class RemoteFolder(ABC):
    """The folder of a published dataset.

    Attributes:
        url: Its address, for messages.
    """

    url: str

    @abstractmethod
    def save(
        self, name: str, path: Path, *, max_bytes: int, anew: bool, stop: Event
    ) -> None:
        """Save a file, of at most so many bytes, at a path that may have its beginning.

        ``anew`` demands a new download of the whole file. A download ends early if
        ``stop`` is set.

        Raises:
            InterruptedError: It was set.
            FileNotFoundError: There is no such file.
            Exception: Any other error of the library or the system.
        """


def local_copy(remote: RemoteFolder, manifest: bytes, folder: Path) -> Path:
    """Return the folder of a copy; download what it lacks.

    Raises:
        DatasetError: A file is missing or damaged, or the manifest is.
        MachineError: The download was interrupted; the next call continues it.
    """
    if (folder / MANIFEST).is_file():
        return folder
    with machine_errors("write", folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
    with _one_process(folder.with_name(f"{folder.name}.lock")):
        if not (folder / MANIFEST).is_file():
            # Else another process was faster.
            # Files are collected beside the copy, so that an interrupted download is no
            # copy.
            unfinished = folder.with_name(f"{folder.name}.part")
            write_file(unfinished / MANIFEST, manifest)
            _download(remote, unfinished)
            with machine_errors("write", folder):
                # A copy without its manifest is no copy.
                shutil.rmtree(folder, ignore_errors=True)
                unfinished.replace(folder)
    return folder


@contextmanager
def _one_process(lock: Path) -> Iterator[None]:
    """Wait until no other process holds the lock, as those of distributed training would download the same files."""
    with machine_errors("write", lock):
        file = lock.open("ab")
    with file:
        while not try_lock(file):
            time.sleep(0.1)
        try:
            yield
        finally:
            unlock(file)


def _download(remote: RemoteFolder, folder: Path) -> None:
    """Download the documents, then the shards that both manifest and specification name."""
    try:
        manifest = load_manifest(folder)
        documents = [
            ListedFile(name, entry["sha256"], entry["bytes"])
            for name, entry in manifest["files"].items()
            if name in LISTED
        ]
        # Documents come first: the specification names the shards that are expected.
        _fetch(remote, folder, documents)
        # Only names of the specification are used, so that no path leads elsewhere.
        if not lists_shards_of(manifest, load_dataset_spec(folder)):
            raise DatasetError("manifest.json is not that of specification.json")
        entries = shard_entries(manifest).values()
        shards = [
            ListedFile(entry["file"], entry["sha256"], entry["bytes"])
            for entry in entries
        ]
        sidecars = [
            ListedFile(entry["sidecar"]["file"], entry["sidecar"]["sha256"])
            for entry in entries
        ]
        _fetch(remote, folder, [*shards, *sidecars])
    except MachineError:
        raise
    except CnpgenError as error:
        raise DatasetError(f"{remote.url}: {error}") from error


def _fetch(remote: RemoteFolder, folder: Path, files: Sequence[ListedFile]) -> None:
    """Download files, several at a time, with a bar on a terminal.

    After an error or Ctrl-C the files in transfer end early, and no other one begins.
    """
    stop = Event()
    save = partial(_save, remote, folder, stop)
    with (
        ThreadPoolExecutor(MAX_CONNECTIONS) as pool,
        tqdm(
            total=len(files), desc=remote.url, unit="file", disable=None, delay=1
        ) as bar,
    ):
        try:
            for done in as_completed([pool.submit(save, file) for file in files]):
                done.result()
                bar.update()
        finally:
            # Transfers look at the event between two blocks.
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)


def _save(remote: RemoteFolder, folder: Path, stop: Event, file: ListedFile) -> None:
    """Download a file unless an earlier call did, and verify it."""
    path = folder / file.name
    if path.is_file():
        # Has been verified before it got this name.
        return
    beginning = path.with_name(f"{path.name}.part")
    with machine_errors("write", path):
        path.parent.mkdir(parents=True, exist_ok=True)
    # A damaged file is downloaded once more.
    for anew in (False, True):
        try:
            remote.save(
                file.name, beginning, max_bytes=file.max_bytes, anew=anew, stop=stop
            )
        except FileNotFoundError as error:
            if file.name in DESCRIPTIONS:
                # A published folder may lack them.
                return
            raise DatasetError(
                f"{file.name} is missing, which manifest.json lists"
            ) from error
        except Exception as error:
            # Libraries of file systems raise any of them.
            raise MachineError(
                f"the download of {remote.url} was interrupted at {file.name}:"
                f" {type(error).__name__}: {error!s:.300}; the same call continues it"
            ) from error
        # Only verified files get their final name.
        if file_sha256(beginning) == file.sha256:
            beginning.replace(path)
            return
        beginning.unlink()
    raise DatasetError(
        f"{file.name} is damaged: its sha256 is not the one in manifest.json"
    )
