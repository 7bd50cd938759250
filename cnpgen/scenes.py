"""Planning problems in scenes: files of other software, families, observations, plans ('cnpgen docs scene-files')."""

from cnpgen.loader.batch_observer import BatchObserver
from cnpgen.make.solve_scenes import SolvedScenes, solve_scenes
from cnpgen.pipelines.families.catalog import load_family
from cnpgen.pipelines.families.family import Grasp, Layout, SceneFamily
from cnpgen.pipelines.families.scene_generator import make_scenes
from cnpgen.planner.plan_requests import plan_scenes
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.problems.scenes.observe import observe, scene_bodies
from cnpgen.problems.scenes.point_cloud import obstacles_of_points
from cnpgen.problems.scenes.scene_files import load_scenes, save_scenes
from cnpgen.problems.scenes.scene_problem import GoalPose, SceneError, SceneProblem
from cnpgen.robots.observation.camera import Camera
from cnpgen.robots.observation.observations import (
    BasisPoints,
    CameraCloud,
    DistanceGrid,
    ObjectTokens,
    SurfaceCloud,
)

__all__ = [
    "BasisPoints",
    "BatchObserver",
    "Camera",
    "CameraCloud",
    "DistanceGrid",
    "GoalPose",
    "Grasp",
    "Layout",
    "ObjectTokens",
    "SceneError",
    "SceneFamily",
    "SceneProblem",
    "SolvedScenes",
    "SurfaceCloud",
    "load_family",
    "load_scenes",
    "make_scenes",
    "observe",
    "obstacles_of_points",
    "plan_scenes",
    "save_scenes",
    "scene_bodies",
    "scene_plans",
    "solve_scenes",
]
