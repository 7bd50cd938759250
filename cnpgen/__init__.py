"""cnpgen: proven datasets of boundary problems for kinodynamic motion planning on constraint manifolds.

Names are loaded on first use, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from cnpgen.doctor import check_machine
    from cnpgen.errors import CnpgenError, DatasetError, MachineError, RecipeError, UsageError
    from cnpgen.evaluation import Evaluation, evaluate_plans
    from cnpgen.export.plans import export_plans
    from cnpgen.inspection import inspect_dataset
    from cnpgen.library import list_recipes, load_dataset_recipe, load_pipeline, load_problem
    from cnpgen.loader.load import load_dataset
    from cnpgen.losses.plan_loss import PlanLoss
    from cnpgen.make import make_dataset
    from cnpgen.plans.load import load_plans
    from cnpgen.plans.plans import Plans, make_plans
    from cnpgen.plans.save import save_plans
    from cnpgen.store.reader import open_dataset
    from cnpgen.trajectory.boundary import Boundary
    from cnpgen.validation import validate_dataset

_HOME = {
    "Boundary": "trajectory.boundary",
    "CnpgenError": "errors",
    "DatasetError": "errors",
    "Evaluation": "evaluation",
    "MachineError": "errors",
    "PlanLoss": "losses.plan_loss",
    "Plans": "plans.plans",
    "RecipeError": "errors",
    "UsageError": "errors",
    "check_machine": "doctor",
    "evaluate_plans": "evaluation",
    "export_plans": "export.plans",
    "inspect_dataset": "inspection",
    "list_recipes": "library",
    "load_dataset": "loader.load",
    "load_dataset_recipe": "library",
    "load_pipeline": "library",
    "load_plans": "plans.load",
    "load_problem": "library",
    "make_dataset": "make",
    "make_plans": "plans.plans",
    "open_dataset": "store.reader",
    "save_plans": "plans.save",
    "validate_dataset": "validation",
}

__all__ = [
    "Boundary",
    "CnpgenError",
    "DatasetError",
    "Evaluation",
    "MachineError",
    "PlanLoss",
    "Plans",
    "RecipeError",
    "UsageError",
    "__version__",
    "check_machine",
    "evaluate_plans",
    "export_plans",
    "inspect_dataset",
    "list_recipes",
    "load_dataset",
    "load_dataset_recipe",
    "load_pipeline",
    "load_plans",
    "load_problem",
    "make_dataset",
    "make_plans",
    "open_dataset",
    "save_plans",
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
