"""cnpgen: proven datasets of boundary problems for kinodynamic motion planning on constraint manifolds.

Names are loaded on first use, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cnpgen.machine.versions import __version__

if TYPE_CHECKING:
    from cnpgen.errors import CnpgenError, DatasetError, MachineError, RecipeError, UsageError
    from cnpgen.loader.load import load_dataset
    from cnpgen.losses.margins import Margins
    from cnpgen.losses.metric import Metric
    from cnpgen.losses.metric_settings import suggested_weights
    from cnpgen.losses.plan_loss import PlanLoss
    from cnpgen.losses.quadrature import rotating_shift
    from cnpgen.make.boundary_problems import draw_boundary_problems
    from cnpgen.make.dataset import make_dataset
    from cnpgen.make.load import load_dataset_recipe
    from cnpgen.pipelines.load import load_pipeline
    from cnpgen.planner.model_file import load_model
    from cnpgen.planner.omega import Omega
    from cnpgen.planner.planner import Planner, states_at
    from cnpgen.plans.boundary_problems import load_boundary_problems
    from cnpgen.plans.evaluate import Evaluation, evaluate_plans
    from cnpgen.plans.export import export_plans
    from cnpgen.plans.load import load_plans
    from cnpgen.plans.plans import Plans, make_plans
    from cnpgen.plans.save import save_plans
    from cnpgen.problems.load import load_problem
    from cnpgen.problems.obstacles import obstacle_tops
    from cnpgen.refine.options import RefineOptions
    from cnpgen.refine.plans import Refinement, refine_plans, solve_plans
    from cnpgen.refine.proof.proof import explain_plans
    from cnpgen.schema.catalogue import list_recipes
    from cnpgen.store.inspection import inspect_dataset
    from cnpgen.store.reader import open_dataset
    from cnpgen.training.settings import TrainingSettings
    from cnpgen.training.train import train_model
    from cnpgen.trajectory.boundary import Boundary
    from cnpgen.trajectory.fit import fit_motion
    from cnpgen.trajectory.motion import Motion
    from cnpgen.validate.dataset import validate_dataset
    from cnpgen.validate.machine import check_machine

_HOME = {
    "Boundary": "trajectory.boundary",
    "CnpgenError": "errors",
    "DatasetError": "errors",
    "Evaluation": "plans.evaluate",
    "MachineError": "errors",
    "Margins": "losses.margins",
    "Metric": "losses.metric",
    "Motion": "trajectory.motion",
    "Omega": "planner.omega",
    "PlanLoss": "losses.plan_loss",
    "Planner": "planner.planner",
    "Plans": "plans.plans",
    "RecipeError": "errors",
    "RefineOptions": "refine.options",
    "Refinement": "refine.plans",
    "TrainingSettings": "training.settings",
    "UsageError": "errors",
    "check_machine": "validate.machine",
    "draw_boundary_problems": "make.boundary_problems",
    "evaluate_plans": "plans.evaluate",
    "explain_plans": "refine.proof.proof",
    "export_plans": "plans.export",
    "fit_motion": "trajectory.fit",
    "inspect_dataset": "store.inspection",
    "list_recipes": "schema.catalogue",
    "load_boundary_problems": "plans.boundary_problems",
    "load_dataset": "loader.load",
    "load_dataset_recipe": "make.load",
    "load_model": "planner.model_file",
    "load_pipeline": "pipelines.load",
    "load_plans": "plans.load",
    "load_problem": "problems.load",
    "make_dataset": "make.dataset",
    "make_plans": "plans.plans",
    "obstacle_tops": "problems.obstacles",
    "open_dataset": "store.reader",
    "refine_plans": "refine.plans",
    "rotating_shift": "losses.quadrature",
    "save_plans": "plans.save",
    "solve_plans": "refine.plans",
    "states_at": "planner.planner",
    "suggested_weights": "losses.metric_settings",
    "train_model": "training.train",
    "validate_dataset": "validate.dataset",
}

__all__ = [
    "Boundary",
    "CnpgenError",
    "DatasetError",
    "Evaluation",
    "MachineError",
    "Margins",
    "Metric",
    "Motion",
    "Omega",
    "PlanLoss",
    "Planner",
    "Plans",
    "RecipeError",
    "RefineOptions",
    "Refinement",
    "TrainingSettings",
    "UsageError",
    "__version__",
    "check_machine",
    "draw_boundary_problems",
    "evaluate_plans",
    "explain_plans",
    "export_plans",
    "fit_motion",
    "inspect_dataset",
    "list_recipes",
    "load_boundary_problems",
    "load_dataset",
    "load_dataset_recipe",
    "load_model",
    "load_pipeline",
    "load_plans",
    "load_problem",
    "make_dataset",
    "make_plans",
    "obstacle_tops",
    "open_dataset",
    "refine_plans",
    "rotating_shift",
    "save_plans",
    "solve_plans",
    "states_at",
    "suggested_weights",
    "train_model",
    "validate_dataset",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'cnpgen' has no attribute {name!r}")
    value = getattr(import_module(f"cnpgen.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
