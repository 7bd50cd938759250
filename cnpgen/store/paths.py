"""Checks of paths given by users: a missing file or folder is a usage error, not a damaged dataset."""

import itertools
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path

from cnpgen.errors import DatasetError, MachineError, UsageError, nearest
from cnpgen.store.files.atomic import check_readable
from cnpgen.store.files.kind import PLANS, is_hdf5, kind_of_content, own_kind
from cnpgen.store.layout import SPECIFICATION
from cnpgen.store.workspace import is_dataset

# Names of a folder that are compared, and their share of equal letters.
MAX_SIMILAR_PATHS = 1000
MIN_SIMILARITY = 0.65
ANY_HDF5 = "an HDF5 file"  # of other software
_KIND_OF_FORMAT = {"cnpgen-plans": PLANS, "cnpgen-shard": "a shard of a dataset"}
HDF5_KINDS = (ANY_HDF5, *_KIND_OF_FORMAT.values())


def require_folder(folder: str | Path, *, argument: str = "folder") -> Path:
    """Return the path of a folder that exists; errors name the argument.

    No text or path, a missing folder and a file raise UsageError, and a folder that
    cannot be read MachineError.
    """
    if not isinstance(folder, str | Path) or not str(folder) or "\0" in str(folder):
        raise UsageError(f"must name a folder, got {folder!r:.100}", argument=argument)
    folder = Path(folder)
    require_path(folder, "the folder of a dataset", argument=argument)
    if not folder.is_dir():
        raise UsageError(
            f"{folder} is a file, expected the folder of a dataset", concerns=argument
        )
    return folder


def require_dataset(folder: str | Path, *, argument: str = "folder") -> Path:
    """Return the path of a folder that contains a dataset, possibly unfinished or damaged; see ``require_folder``."""
    folder = require_folder(folder, argument=argument)
    if is_dataset(folder):
        return folder
    # As of 'cnpgen copy'.
    recipe = folder / "dataset.toml"
    hint = f": 'cnpgen make-dataset {recipe}' makes one" if recipe.is_file() else ""
    raise UsageError(
        f"{folder} is not a dataset of cnpgen: it has no {SPECIFICATION}{hint}",
        concerns=argument,
    )


def require_file(
    path: Path,
    expected: str,
    *,
    kinds: Collection[str] = (),
    of_dataset: str = "",
    argument: str = "path",
) -> None:
    """Raise an error that names the argument if a path is not a file with some expected content: "a file of plans".

    Files of other ``kinds``, as of ``file_kind``, are refused, if any are listed.
    ``of_dataset`` is a hint for the folder of a dataset. Files that cannot be read
    raise MachineError, other paths UsageError.
    """
    require_path(path, expected, argument=argument)
    if path.is_dir():
        # The folder of a dataset is a common mistake, with a remedy of its own.
        actual, hint = (
            ("the folder of a dataset", of_dataset)
            if is_dataset(path)
            else ("a folder", "")
        )
        raise UsageError(
            f"{path} is {actual}, expected {expected}{hint and f': {hint}'}",
            concerns=argument,
        )
    if not path.is_file():
        raise UsageError(
            f"{path} is a device or a pipe, expected {expected}", concerns=argument
        )
    kind = file_kind(path) or kind_of_content(path) if kinds else ""
    if kind and kind not in kinds:
        raise UsageError(f"{path} is {kind}, expected {expected}", concerns=argument)


def require_path(path: Path, expected: str, *, argument: str = "path") -> None:
    """Raise UsageError, naming the argument, if a path is missing, and MachineError if it cannot be read."""
    check_readable(path)
    try:
        present = path.exists()
    except (OSError, ValueError) as error:
        # A name that is too long, or with NUL.
        reason = getattr(error, "strerror", None) or str(error)
        raise UsageError(
            f"{str(path)!r:.100} cannot be a path: {reason}, expected {expected}",
            concerns=argument,
        ) from error
    if not present:
        raise UsageError(
            f"{path} is not there, expected {expected}{similar_path(path)}",
            concerns=argument,
        )


def similar_path(path: Path, names: Iterable[str] = ()) -> str:
    """Return ``" (did you mean 'x'?)"`` for the most similar of names and of paths beside it, or an empty text."""
    with suppress(OSError):
        beside = itertools.islice(path.parent.iterdir(), MAX_SIMILAR_PATHS)
        names = [
            *names,
            *(
                each.name
                for each in beside
                # Only files of the same kind, and folders, are meant.
                if path.suffix in ("", each.suffix) or each.is_dir()
            ),
        ]
    # A link may lead nowhere.
    others = [name for name in names if name != path.name]
    return nearest(path.name, others, similarity=MIN_SIMILARITY)


def file_kind(path: Path) -> str:
    """Return the kind of a file, "a model of cnpgen" or "a file of plans".

    Empty if it is not known.
    """
    if not path.is_file():
        # Opening a pipe would block.
        return ""
    try:
        with path.open("rb") as file:
            head = file.read(64)
        return own_kind(head) or (_hdf5_kind(path) if is_hdf5(path) else "")
    except OSError:
        return ""


def _hdf5_kind(path: Path) -> str:
    from cnpgen.store.files.hdf5 import open_hdf5

    try:
        with open_hdf5(path) as file:
            format_name = file.attributes.some(["format"]).get("format")
            names = set(file)
    except (DatasetError, MachineError):
        return ANY_HDF5
    if isinstance(format_name, bytes):
        format_name = format_name.decode(errors="replace")
    # Files of other software may have no format.
    if format_name is None and {"path_control_points", "rate_control_points"} <= names:
        return PLANS
    return _KIND_OF_FORMAT.get(str(format_name), ANY_HDF5)
