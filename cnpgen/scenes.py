"""Planning problems in scenes: files of other software, families, and plans ('cnpgen docs scene-files')."""

from cnpgen.problems.scenes.scene_files import load_scenes, save_scenes
from cnpgen.problems.scenes.scene_problem import GoalPose, SceneError, SceneProblem

__all__ = [
    "GoalPose",
    "SceneError",
    "SceneProblem",
    "load_scenes",
    "save_scenes",
]
