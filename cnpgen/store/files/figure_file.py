"""Figures of matplotlib, which is an optional dependency: creating and saving them."""

from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.errors import requires_extra
from cnpgen.store.files.atomic import machine_errors

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float, dpi: int = 110) -> "Figure":
    """Return an empty figure with a size [inch] and automatic layout.

    Raise MissingExtraError without matplotlib.
    """
    with requires_extra("plot", "matplotlib"):
        from matplotlib.figure import Figure
    return Figure(figsize=(width, height), layout="constrained", dpi=dpi)


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure in the format of the suffix.

    Create its folder if it does not exist.
    """
    with machine_errors("write", path):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
