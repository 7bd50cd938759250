"""The reader of scene files by its name."""

from dataclasses import dataclass
from pathlib import Path

from cnpgen.addons.scene_files.scene_files import holds_scenes, load_scenes
from cnpgen.problems.scenes.scene_problem import SceneProblem
from cnpgen.problems.scenes.scene_reader import ReadingOptions, SceneReader


@dataclass(frozen=True)
class SceneFiles(SceneReader):
    """Reader: planning scenes and requests of MoveIt, robometrics, MPiNets and Avoid Everything."""

    def holds(self, path: Path) -> bool:
        """Return whether suffix and content are those of scenes."""
        return holds_scenes(path)

    def load(
        self, path: Path, *, start: int, n: int | None, options: ReadingOptions
    ) -> list[SceneProblem]:
        """Read scenes by ``load_scenes``."""
        return load_scenes(path, start=start, n=n, **vars(options))
