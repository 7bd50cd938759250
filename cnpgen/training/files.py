"""Where a model goes, and the files beside it: nothing of anybody else's is replaced."""

from pathlib import Path

from cnpgen.errors import UsageError
from cnpgen.store.files.leftovers import sweep_file
from cnpgen.training.log import is_log

CHECKPOINT, LOG, PICTURE = ".checkpoint", ".jsonl", ".png"  # in place of .h5


def check_out(out: Path) -> None:
    """Refuse a place where no model can go."""
    if out.suffix != ".h5" or out.is_dir() or not out.parent.is_dir():
        raise UsageError(f"{out} must be a file that ends in .h5, in a folder that exists")


def check_beside(out: Path) -> None:
    """Refuse to replace a log that no training run has written, and a picture that no such log belongs to.

    Args:
        out: The model's file.

    Raises:
        UsageError: There is such a file.
    """
    log, picture = out.with_suffix(LOG), out.with_suffix(PICTURE)
    hint = "out= names another model, force=True replaces it"
    if log.exists() and not is_log(log):
        raise UsageError(f"{log} is there and no training log: {hint}")
    if picture.exists() and not log.exists():
        raise UsageError(f"{picture} is there, and of no training run: {hint}")


def sweep_beside(out: Path) -> None:
    """Remove what killed runs have left of the files that they were writing."""
    for path in (out, *(out.with_suffix(suffix) for suffix in (CHECKPOINT, LOG))):
        sweep_file(path)
