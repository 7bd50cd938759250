"""What users point at: the folder of a dataset, a file. What is not there is a mistake in an argument, not damage."""

from pathlib import Path

from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.store.files.kind import PLANS, is_hdf5, own_kind
from cnpgen.store.workspace import is_dataset

_SAID = {"cnpgen-plans": PLANS, "cnpgen-shard": "a shard of a dataset"}


def require_folder(folder: Path) -> None:
    """Refuse what is no folder.

    Args:
        folder: What should be the folder of a dataset.

    Raises:
        UsageError: It is not there, or is a file.
    """
    if not folder.is_dir():
        what = "a file" if folder.exists() else "not there"
        raise UsageError(f"{folder} is {what}, expected the folder of a dataset")


def require_file(path: Path, what: str, *, of_dataset: str = "") -> None:
    """Refuse what is no file.

    Args:
        path: What should be a file.
        what: What it should hold: "a file of plans".
        of_dataset: What to do if it is the folder of a dataset instead.

    Raises:
        UsageError: It is not there, or is a folder, a device or a pipe.
    """
    if path.is_dir():
        found, hint = ("the folder of a dataset", of_dataset) if is_dataset(path) else ("a folder", "")
        raise UsageError(f"{path} is {found}, expected {what}{hint and f': {hint}'}")
    if not path.exists():
        raise UsageError(f"{path} is not there, expected {what}")
    if not path.is_file():
        raise UsageError(f"{path} is a device or a pipe, expected {what}")


def file_kind(path: Path) -> str:
    """Say what a file is: "a model of cnpgen", "a file of plans"; nothing where that is not known."""
    if not path.is_file():  # to open a pipe is to wait for somebody
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
            said, names = file.attributes.some(["format"]).get("format"), set(file)
    except (DatasetError, MachineError):
        return "an HDF5 file"
    said = said.decode(errors="replace") if isinstance(said, bytes) else said
    if said is None and {"path_control_points", "rate_control_points"} <= names:  # others' files need not say it
        return PLANS
    return _SAID.get(str(said), "an HDF5 file")
