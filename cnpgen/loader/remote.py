"""Datasets at URLs: packages register a function for each scheme in the group ``cnpgen.sources``."""

from collections.abc import Callable
from pathlib import Path

from cnpgen.errors import UsageError, listed
from cnpgen.schema import addons

SOURCES = "cnpgen.sources"


def local_folder(folder: str | Path) -> str | Path:
    """Return the folder of a dataset.

    That of a dataset at a URL, a text such as ``https://...``, is a local copy, which
    the function of its scheme downloads first.

    Raises:
        UsageError: No installed package reads URLs of the scheme.
        MissingAddonError: The scheme belongs to an add-on that this installation lacks.
    """
    scheme, mark, _ = str(folder).partition("://")
    if not mark or isinstance(folder, Path):
        return folder
    entry = addons.find(SOURCES, scheme)
    if entry is None:
        known = [f"{other.name}://" for other in addons.installed(SOURCES)]
        raise UsageError(
            f"{folder:.200}: no installed package reads datasets at {scheme:.50}://, only "
            f"{listed(known) or 'none'}",
            concerns="folder",
        )
    download: Callable[[str], Path] = addons.load_entry(
        entry, f"a dataset at {scheme}://"
    )
    return download(str(folder))
