"""Files of plans as commands read them: without plans there is nothing to do."""

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
