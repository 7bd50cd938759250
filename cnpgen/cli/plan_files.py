"""Files of plans as commands read them, and what those that they write are called."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cnpgen.plans import Plans


def read_plans(path: Path, *, problem: str | None = None) -> "Plans":
    """Read the plans of a file; see ``cnpgen.load_plans``.

    Raises:
        DatasetError: It has none, too.
    """
    from cnpgen.errors import DatasetError
    from cnpgen.plans import load_plans

    plans = load_plans(path, problem=problem)
    if not len(plans):
        raise DatasetError(f"no plans in {path}")
    return plans


def checksum_text(plans: "Plans") -> str:
    """Say whether the file that plans were read from has a checksum."""
    return "the file's checksum is right" if plans.sealed else "the file has no checksum"


def check_suffix(out: Path) -> None:
    """Refuse a file for plans that does not end as they do."""
    from cnpgen.errors import UsageError

    if out.suffix != ".h5":
        raise UsageError(f"{out} must be a file that ends in .h5, in a folder that exists")
