"""Plan files that commands read and write."""

from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.errors import DatasetError

if TYPE_CHECKING:
    from cnpgen.plans import Plans


def read_plans(path: Path, *, problem: str | None = None) -> "Plans":
    """Read the plans of a file, as ``cnpgen.load_plans`` does; refuse files without plans."""
    from cnpgen.plans import load_plans

    plans = load_plans(path, problem=problem)
    if not len(plans):
        raise DatasetError(f"no plans in {path}")
    return plans


def checksum_text(plans: "Plans") -> str:
    """Return whether the source of the plans has a checksum, as text."""
    return "the file's checksum is right" if plans.has_checksum else "the file has no checksum"
