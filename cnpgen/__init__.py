"""cnpgen: proven datasets of boundary problems for kinodynamic motion planning on constraint manifolds.

Names are loaded on first use, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from cnpgen.doctor import check_machine
    from cnpgen.errors import CnpgenError, DatasetError, MachineError, RecipeError, UsageError
    from cnpgen.inspection import inspect_dataset
    from cnpgen.library import list_recipes, load_dataset_recipe, load_pipeline, load_problem
    from cnpgen.loader.load import load_dataset
    from cnpgen.make import make_dataset
    from cnpgen.store.reader import open_dataset
    from cnpgen.validation import validate_dataset

_HOME = {
    "CnpgenError": "errors",
    "DatasetError": "errors",
    "MachineError": "errors",
    "RecipeError": "errors",
    "UsageError": "errors",
    "check_machine": "doctor",
    "inspect_dataset": "inspection",
    "list_recipes": "library",
    "load_dataset": "loader.load",
    "load_dataset_recipe": "library",
    "load_pipeline": "library",
    "load_problem": "library",
    "make_dataset": "make",
    "open_dataset": "store.reader",
    "validate_dataset": "validation",
}

__all__ = [
    "CnpgenError",
    "DatasetError",
    "MachineError",
    "RecipeError",
    "UsageError",
    "__version__",
    "check_machine",
    "inspect_dataset",
    "list_recipes",
    "load_dataset",
    "load_dataset_recipe",
    "load_pipeline",
    "load_problem",
    "make_dataset",
    "open_dataset",
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
