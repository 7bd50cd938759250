"""Contract of readers of scene files, and the scenes of a path by the reader that accepts it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cnpgen.problems.scenes.scene_problem import SceneProblem
from cnpgen.schema import addons, registry


@dataclass(frozen=True)
class ReadingOptions:
    """Options of readers of scenes.

    Attributes:
        allow_unused: Keys of elements that are accepted without effect.
        packages: Folders with packages of mesh files.
        present: Joint -> position [rad], the present state of the robot.
        allowed_elsewhere: Further such keys, which the scenes may lack.
    """

    allow_unused: Sequence[str] = ()
    packages: Sequence[Path] = ()
    present: Mapping[str, float] = field(default_factory=dict)
    allowed_elsewhere: Sequence[str] = ()


DEFAULT_OPTIONS = ReadingOptions()


class SceneReader(ABC):
    """Reader of the scene files of other programs.

    Packages register them in the group ``cnpgen.readers``.
    """

    @abstractmethod
    def holds(self, path: Path) -> bool:
        """Return whether a file or a folder contains scenes that this reader reads."""

    @abstractmethod
    def load(
        self, path: Path, *, start: int, n: int | None, options: ReadingOptions
    ) -> list[SceneProblem]:
        """Read scenes from the number ``start`` on, at most ``n`` of them, or all that follow.

        Every element of a file is used, refused by name, or cannot change the answer.

        Raises:
            UsageError: There are no scenes, or one is invalid; the message names file,
                scene and element.
            DatasetError: A file is damaged.
            MissingExtraError: A package for the format is missing.
        """


def holds_scenes(path: Path) -> bool:
    """Return whether an installed reader accepts a path."""
    return any(reader.holds(path) for reader in _readers())


def read_scenes(
    path: Path,
    *,
    start: int = 0,
    n: int | None = None,
    options: ReadingOptions = DEFAULT_OPTIONS,
) -> list[SceneProblem]:
    """Read the scenes of a path by the reader that accepts it; errors as of ``SceneReader.load``.

    Raises:
        MissingAddonError: No reader is installed.
    """
    readers = _readers()
    if not readers:
        raise addons.missing("scene_files", f"reading scenes from {path}")
    # A reader raises the error for a path that none accepts.
    chosen = next((reader for reader in readers if reader.holds(path)), readers[0])
    return chosen.load(path, start=start, n=n, options=options)


def _readers() -> list[SceneReader]:
    return [
        registry.load(registry.READERS, name)()
        for name in registry.names(registry.READERS)
    ]
