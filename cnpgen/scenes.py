"""Planning problems in scenes: files of other software, families, and plans ('cnpgen docs scene-files')."""

from cnpgen.make.solve_scenes import SolvedScenes, solve_scenes
from cnpgen.pipelines.families.catalog import load_family
from cnpgen.pipelines.families.family import Grasp, Layout, SceneFamily
from cnpgen.pipelines.families.scene_generator import make_scenes
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.problems.scenes.point_cloud import obstacles_of_points
from cnpgen.problems.scenes.scene_files import load_scenes, save_scenes
from cnpgen.problems.scenes.scene_problem import GoalPose, SceneError, SceneProblem

__all__ = [
    "GoalPose",
    "Grasp",
    "Layout",
    "SceneError",
    "SceneFamily",
    "SceneProblem",
    "SolvedScenes",
    "load_family",
    "load_scenes",
    "make_scenes",
    "obstacles_of_points",
    "save_scenes",
    "scene_plans",
    "solve_scenes",
]
