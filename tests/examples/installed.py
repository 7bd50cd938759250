"""Packages with planners, as if pip had installed them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cnpgen.schema import registry


@contextmanager
def installed_planner(folder: Path, name: str, target: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install a package of a folder whose entry point is a planner of the same name, for as long as the block lasts."""
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    (about / "entry_points.txt").write_text(f"[cnpgen.planners]\n{name} = {target}\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(folder))
    registry.installed.cache_clear()
    try:
        yield
    finally:
        registry.installed.cache_clear()
