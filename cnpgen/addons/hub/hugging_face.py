"""Datasets of the Hugging Face Hub: ``hf://datasets/USER/NAME@REVISION``, through the library of the Hub.

Its cache and its variables apply: HF_HOME, HF_TOKEN, HF_ENDPOINT and HF_HUB_OFFLINE.
The files of that cache are links. Links out of the folder of a dataset are refused, so
the copy has the same files under a second name, in HF_HOME/assets.
"""

import re
import urllib.parse
from dataclasses import dataclass
from pathlib import Path
from threading import Event

from cnpgen.addons.hub.downloads import HDF5, RemoteFolder, local_copy
from cnpgen.addons.hub.publish import REPOSITORY, link_or_copy
from cnpgen.errors import DatasetError, MachineError, UsageError, requires_extra
from cnpgen.store.files.atomic import read_file
from cnpgen.store.layout import MANIFEST

_URL = re.compile(
    rf"hf://datasets/(?P<repository>{REPOSITORY.pattern})"
    r"(?:@(?P<revision>[^/@]+))?(?:/(?P<folder>[^@]+?))?/?"
)


@dataclass(frozen=True)
class HubFolder(RemoteFolder):
    """A folder of a repository of the Hub at a revision.

    Attributes:
        url: Its address.
        repository: Name of the repository, USER/NAME.
        revision: A commit, a tag or a branch; None for the newest state.
        folder: Path in the repository, with a slash at its end; empty for its root.
    """

    url: str
    repository: str
    revision: str | None
    folder: str

    def save(
        self,
        name: str,
        path: Path,
        *,
        max_bytes: int,  # noqa: ARG002 - the sha256 is verified
        anew: bool,
        stop: Event,  # noqa: ARG002 - the library downloads whole files
    ) -> None:
        """Give a file of the Hub's cache a second name, and download it before; see ``RemoteFolder.save``."""
        source = self.cached(name, anew=anew).resolve()
        path.unlink(missing_ok=True)
        link_or_copy(source, path)

    def cached(self, name: str, *, anew: bool = False) -> Path:
        """Return a file in the Hub's cache."""
        import huggingface_hub
        from huggingface_hub.errors import LocalEntryNotFoundError

        try:
            file = huggingface_hub.hf_hub_download(
                self.repository,
                f"{self.folder}{name}",
                repo_type="dataset",
                revision=self.revision,
                force_download=anew,
                library_name="cnpgen",
            )
        except LocalEntryNotFoundError as error:
            # Is a FileNotFoundError, too.
            raise ConnectionError(f"{error}") from error
        return Path(file)


def download(url: str) -> Path:
    """Return the local copy of a dataset of the Hub, which is downloaded first.

    Raises:
        UsageError: The URL is not ``hf://datasets/USER/NAME@REVISION``, or there is no
            such repository or revision.
        DatasetError: It has no finished dataset, or a file is missing or damaged.
        MissingExtraError: huggingface_hub is not installed.
        MachineError: The Hub cannot be reached, or the download was interrupted.
    """
    parts = _URL.fullmatch(url)
    if parts is None:
        raise UsageError(
            f"expected hf://datasets/USER/NAME@REVISION, got {url:.200}",
            concerns="folder",
        )
    revision = parts["revision"] and urllib.parse.unquote(parts["revision"])
    inside = f"{parts['folder']}/" if parts["folder"] else ""
    with requires_extra("hub", "huggingface_hub"):
        import huggingface_hub
    for folder in (f"{inside}{HDF5}/", inside):
        remote = HubFolder(url, parts["repository"], revision, folder)
        if (manifest := _manifest(remote)) is None:
            continue
        # .../snapshots/COMMIT/hdf5/manifest.json: all files are of this commit
        commit = manifest.parents[folder.count("/")].name
        place = huggingface_hub.cached_assets_path(
            "cnpgen", "datasets", f"{remote.repository}@{commit}/{folder}"
        )
        remote = HubFolder(url, remote.repository, commit, folder)
        return local_copy(remote, read_file(manifest), place / "dataset")
    raise DatasetError(
        f"{url} has no finished dataset: neither {HDF5}/{MANIFEST} nor {MANIFEST}"
    )


def _manifest(remote: HubFolder) -> Path | None:
    """Return the manifest of a folder in the Hub's cache; None if it has none."""
    from huggingface_hub.errors import (
        EntryNotFoundError,
        RepositoryNotFoundError,
        RevisionNotFoundError,
    )

    try:
        return remote.cached(MANIFEST)
    except EntryNotFoundError:
        return None
    except (RepositoryNotFoundError, RevisionNotFoundError) as error:
        raise UsageError(
            f"{remote.url} was not found; a private repository needs HF_TOKEN or 'hf auth login'",
            concerns="folder",
        ) from error
    except (OSError, ValueError) as error:
        # The others of huggingface_hub.
        raise MachineError(f"{remote.url} cannot be read: {error!s:.300}") from error
