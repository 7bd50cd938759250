from typing import Any

from cnpgen.loader.batch import BatchObserver as BatchObserver
from cnpgen.make.solve_scenes import SceneOptions as SceneOptions
from cnpgen.make.solve_scenes import SolvedScenes as SolvedScenes
from cnpgen.make.solve_scenes import solve_scenes as solve_scenes
from cnpgen.pipelines.scene_family import Grasp as Grasp
from cnpgen.pipelines.scene_family import Layout as Layout
from cnpgen.pipelines.scene_family import SceneFamily as SceneFamily
from cnpgen.planner.plan_requests import plan_scenes as plan_scenes
from cnpgen.plans.scene_plans import scene_plans as scene_plans
from cnpgen.problems.scenes.observe import observe as observe
from cnpgen.problems.scenes.observe import scene_bodies as scene_bodies
from cnpgen.problems.scenes.scene_problem import GoalPose as GoalPose
from cnpgen.problems.scenes.scene_problem import SceneError as SceneError
from cnpgen.problems.scenes.scene_problem import SceneProblem as SceneProblem
from cnpgen.problems.scenes.scene_problem import make_mesh as make_mesh
from cnpgen.problems.scenes.scene_request import AttachedObject as AttachedObject
from cnpgen.problems.scenes.scene_request import SceneRequest as SceneRequest
from cnpgen.robots.observation.camera import Camera as Camera
from cnpgen.robots.observation.observations import BasisPoints as BasisPoints
from cnpgen.robots.observation.observations import CameraCloud as CameraCloud
from cnpgen.robots.observation.observations import DistanceGrid as DistanceGrid
from cnpgen.robots.observation.observations import ObjectTokens as ObjectTokens
from cnpgen.robots.observation.observations import SurfaceCloud as SurfaceCloud

def __getattr__(name: str) -> Any: ...  # names of add-ons
