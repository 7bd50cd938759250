"""Check the output files of a run: no file of another origin is replaced."""

from pathlib import Path

from cnpgen.errors import UsageError
from cnpgen.store.files.atomic import check_writable
from cnpgen.store.files.leftovers import remove_leftovers_of
from cnpgen.training.log import is_log

CHECKPOINT, LOG, PICTURE, LOCK = ".checkpoint", ".jsonl", ".png", ".lock"  # in place of .h5


def check_out(out: Path) -> None:
    """Raise an error if the path is no possible model file, or cannot be written."""
    if out.suffix != ".h5" or out.is_dir() or not out.parent.is_dir():
        raise UsageError(f"{out} must be a file that ends in .h5, in a folder that exists", concerns="out")
    check_writable(out)


def check_beside(out: Path) -> None:
    """Raise an error if a log or a picture of another origin would be replaced.

    Args:
        out: The model's file.

    Raises:
        UsageError: There is such a file.
    """
    log, picture = out.with_suffix(LOG), out.with_suffix(PICTURE)
    hint, remedies = "choose another {out}, or replace it with {force}", {"out": None, "force": True}
    if log.exists() and not is_log(log):
        raise UsageError(f"{log} exists and is no training log: {hint}", remedies=remedies)
    if picture.exists() and not log.exists():
        raise UsageError(f"{picture} exists and is of no training run: {hint}", remedies=remedies)


def remove_temporary_files(out: Path) -> None:
    """Remove the temporary files of killed runs."""
    for path in (out, *(out.with_suffix(suffix) for suffix in (CHECKPOINT, LOG))):
        remove_leftovers_of(path)
