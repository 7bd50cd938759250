"""Checks of paths given by users: a missing file or folder is a usage error, not a damaged dataset."""

from pathlib import Path

from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.store.files.kind import PLANS, is_hdf5, own_kind
from cnpgen.store.workspace import is_dataset

_KIND_OF_FORMAT = {"cnpgen-plans": PLANS, "cnpgen-shard": "a shard of a dataset"}


def require_folder(folder: str | Path, *, argument: str = "folder") -> Path:
    """Return the path of a folder that exists.

    Args:
        folder: Folder of a dataset.
        argument: Name of the argument, for the error.

    Raises:
        UsageError: It is no text or path, or the folder is missing or is a file.
    """
    if not isinstance(folder, str | Path) or not str(folder) or "\0" in str(folder):
        raise UsageError(f"must name a folder, got {folder!r:.100}", argument=argument)
    folder = Path(folder)
    if not folder.is_dir():
        actual = "a file" if folder.exists() else "not there"
        raise UsageError(f"{folder} is {actual}, expected the folder of a dataset", concerns=argument)
    return folder


def require_file(path: Path, expected: str, *, of_dataset: str = "", argument: str = "path") -> None:
    """Raise an error if a path is not a file.

    Args:
        path: The path.
        expected: Expected content: "a file of plans".
        of_dataset: Hint in the case of the folder of a dataset.
        argument: Name of the argument, for the error.

    Raises:
        UsageError: The path does not exist, or is a folder, a device or a pipe.
    """
    if path.is_dir():
        actual, hint = ("the folder of a dataset", of_dataset) if is_dataset(path) else ("a folder", "")
        raise UsageError(f"{path} is {actual}, expected {expected}{hint and f': {hint}'}", concerns=argument)
    if not path.exists():
        raise UsageError(f"{path} is not there, expected {expected}", concerns=argument)
    if not path.is_file():
        raise UsageError(f"{path} is a device or a pipe, expected {expected}", concerns=argument)


def file_kind(path: Path) -> str:
    """Return the kind of a file, "a model of cnpgen" or "a file of plans"; empty if it is not known."""
    if not path.is_file():  # opening a pipe would block
        return ""
    try:
        with path.open("rb") as file:
            head = file.read(64)
        return own_kind(head) or (_hdf5_kind(path) if is_hdf5(path) else "")
    except OSError:
        return ""


def _hdf5_kind(path: Path) -> str:
    from cnpgen.store.files.hdf5 import opened_hdf5

    try:
        with opened_hdf5(path) as file:
            format_name, names = file.attributes.some(["format"]).get("format"), set(file)
    except (DatasetError, MachineError):
        return "an HDF5 file"
    if isinstance(format_name, bytes):
        format_name = format_name.decode(errors="replace")
    if (
        format_name is None and {"path_control_points", "rate_control_points"} <= names
    ):  # files of other software may have no format
        return PLANS
    return _KIND_OF_FORMAT.get(str(format_name), "an HDF5 file")
