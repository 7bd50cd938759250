"""Packages with plug-ins, as if pip had installed them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cnpgen.addons.benchmark.benchmark_planner import PLANNERS
from cnpgen.schema.entry_points import entry_points


@contextmanager
def installed_kind(
    folder: Path,
    name: str,
    target: str,
    monkeypatch: pytest.MonkeyPatch,
    *,
    group: str = PLANNERS,
) -> Iterator[None]:
    """Install a package of a folder whose entry point has the name of the package, for the duration of the block."""
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8"
    )
    (about / "entry_points.txt").write_text(
        f"[{group}]\n{name} = {target}\n", encoding="utf-8"
    )
    monkeypatch.syspath_prepend(str(folder))
    entry_points.cache_clear()
    try:
        yield
    finally:
        entry_points.cache_clear()
