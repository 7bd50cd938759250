"""The folder where tapes and compiled libraries are kept from run to run."""

import atexit
import os
import shutil
import tempfile
import warnings
from pathlib import Path

from cnpgen.errors import MachineError


def default_cache_folder() -> Path:
    """``$CNPGEN_CACHE``, else ``cnpgen`` in ``$XDG_CACHE_HOME`` or ``~/.cache``.

    Raises:
        MachineError: None of them is known.
    """
    if os.environ.get("CNPGEN_CACHE"):
        return Path(os.environ["CNPGEN_CACHE"])
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cnpgen"
    except RuntimeError as error:
        raise MachineError("this user has no home folder to keep kernels in: set CNPGEN_CACHE to a folder") from error


def writable_folder(folder: Path) -> Path:
    """Return the folder, or after a warning a temporary one if it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        warnings.warn(
            f"cannot write the kernel cache {folder} ({error.strerror or error}): kernels are built for this run only,"
            " in a temporary folder; set CNPGEN_CACHE to a folder that can be written",
            RuntimeWarning,
            stacklevel=3,
        )
        return temporary_folder()


def temporary_folder() -> Path:
    """Make a folder that is removed when this process ends; its workers may use it until then."""
    folder = Path(tempfile.mkdtemp(prefix="cnpgen-cache-"))
    atexit.register(_remove, folder, os.getpid())
    return folder


def _remove(folder: Path, owner: int) -> None:
    if os.getpid() == owner:  # a forked worker inherits what is registered
        shutil.rmtree(folder, ignore_errors=True)
