"""What users point at: the folder of a dataset, a file. What is not there is a mistake in an argument, not damage."""

from pathlib import Path

from cnpgen.errors import UsageError
from cnpgen.store.workspace import is_dataset


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
        UsageError: It is not there, or is a folder.
    """
    if path.is_dir():
        found, hint = ("the folder of a dataset", of_dataset) if is_dataset(path) else ("a folder", "")
        raise UsageError(f"{path} is {found}, expected {what}{hint and f': {hint}'}")
    if not path.exists():
        raise UsageError(f"{path} is not there, expected {what}")
