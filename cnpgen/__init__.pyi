from typing import Any

from cnpgen.errors import CnpgenError as CnpgenError
from cnpgen.loader.batch_options import BatchOptions as BatchOptions
from cnpgen.loader.dataset import Dataset as Dataset
from cnpgen.loader.load import load_dataset as load_dataset
from cnpgen.losses.plan_loss import PlanLoss as PlanLoss
from cnpgen.machine.versions import __version__ as __version__
from cnpgen.make.complete import complete as complete
from cnpgen.make.draw_boundary_problems import (
    draw_boundary_problems as draw_boundary_problems,
)
from cnpgen.make.extend import extend_dataset as extend_dataset
from cnpgen.make.generation_options import GenerationOptions as GenerationOptions
from cnpgen.make.make_dataset import make_dataset as make_dataset
from cnpgen.make.merge import merge_datasets as merge_datasets
from cnpgen.planner.boundary_layer import BoundaryLayer as BoundaryLayer
from cnpgen.planner.model import Model as Model
from cnpgen.planner.model_file import load_model as load_model
from cnpgen.planner.model_file import save_model as save_model
from cnpgen.planner.planner import Planner as Planner
from cnpgen.plans.boundary_problems import (
    load_boundary_problems as load_boundary_problems,
)
from cnpgen.plans.evaluate import evaluate_plans as evaluate_plans
from cnpgen.plans.export import export_plans as export_plans
from cnpgen.plans.join import join_plans as join_plans
from cnpgen.plans.plan_file import load_plans as load_plans
from cnpgen.plans.plan_file import save_plans as save_plans
from cnpgen.plans.plans import Plans as Plans
from cnpgen.plans.plans import make_plans as make_plans
from cnpgen.problems.problem import Problem as Problem
from cnpgen.problems.problem_file import load_problem as load_problem
from cnpgen.problems.robot_model import RobotModel as RobotModel
from cnpgen.refine.options import RefineOptions as RefineOptions
from cnpgen.refine.proof.explain import explain_plans as explain_plans
from cnpgen.refine.refine_plans import refine_plans as refine_plans
from cnpgen.refine.refine_plans import solve_plans as solve_plans
from cnpgen.robots.scene import Scene as Scene
from cnpgen.store.inspection import inspect_dataset as inspect_dataset
from cnpgen.training.settings import TrainingSettings as TrainingSettings
from cnpgen.training.train import train_model as train_model
from cnpgen.training.training_options import TrainingOptions as TrainingOptions
from cnpgen.trajectory.boundary import Boundary as Boundary
from cnpgen.trajectory.spline_motion import Motion as Motion
from cnpgen.validate.machine import check_machine as check_machine
from cnpgen.validate.validate_dataset import validate_dataset as validate_dataset

def __getattr__(name: str) -> Any: ...  # names of add-ons
