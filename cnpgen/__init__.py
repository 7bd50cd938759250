"""Datasets, planners and trajectory optimization for kinodynamic motion planning on constraint manifolds (CNP-B).

Example:
    >>> import cnpgen
    >>> made = cnpgen.make_dataset("airhockey-hit", "hits", n=2000)  # a folder with train/*.h5 and validation/*.h5
    >>> dataset = cnpgen.load_dataset("hits")
    >>> for batch in dataset.batches(64, seed=0):
    ...     inputs = batch.table  # float32, normalized, shape (64, D)
    >>> problems = cnpgen.load_boundary_problems("hits", n=8)
    >>> plans = cnpgen.Planner("airhockey-hit").plan_batch(problems.boundary)
    >>> refined = cnpgen.refine_plans(plans).plans  # optimize
    >>> cnpgen.evaluate_plans(refined).valid  # judge with Pinocchio and Coal
    >>> cnpgen.save_plans("plans.h5", refined)

Functions:
    Datasets: ``make_dataset``, ``extend_dataset``, ``merge_datasets``,
    ``load_dataset``, ``inspect_dataset``, ``validate_dataset``.
    Problems: ``load_problem``, ``load_boundary_problems``, ``draw_boundary_problems``,
        ``complete``.
    Plans: ``make_plans``, ``load_plans``, ``save_plans``, ``join_plans``,
    ``solve_plans``, ``refine_plans``, ``explain_plans``, ``evaluate_plans``,
    ``evaluate_trajectories``, ``export_plans``.
    Models: ``train_model``, ``load_model``, ``save_model``, ``plan_hits``.
    Machine: ``check_machine``.

Classes:
    ``Dataset``, ``Problem``, ``Scene``, ``RobotModel``, ``Boundary``, ``Motion``,
    ``Plans``, ``Planner``, ``Model``, ``BoundaryLayer``, ``PlanLoss``,
    ``TrainingSettings``, ``RefineOptions``, ``CnpgenError``.

``help(cnpgen.Plans)`` documents one name, and the command ``cnpgen docs`` prints pages
of the documentation. Other public names are in these modules:

* ``cnpgen.recipes``: recipes of problems, pipelines and datasets, and their parts.
* ``cnpgen.losses``: the loss of a plan, its metric and its margins.
* ``cnpgen.results``: classes that functions return.
* ``cnpgen.trajectories``: sampled trajectories of other planners: load, import, fit, and their verdicts.
* ``cnpgen.scenes``: planning problems in scene files, families of scenes, and plans for them.
* ``cnpgen.errors``: the exceptions.
* ``cnpgen.plugins``: contracts of stages, constraints, objectives and exporters.
* ``cnpgen.benchmark``: comparison of planners, and simulation of plans.

Names load on first use, so that importing the package is cheap. ``__init__.pyi`` lists
them for type checkers (SPEC 1).
"""

import sys
from importlib import import_module
from typing import Any

from cnpgen.schema.public_names import lazy_exports

_MODULES = (
    "benchmark",
    "errors",
    "losses",
    "plugins",
    "recipes",
    "results",
    "scenes",
    "trajectories",
)
_load, _names = lazy_exports(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Load a public name, or a module of public names."""
    return import_module(f"cnpgen.{name}") if name in _MODULES else _load(name)


def __dir__() -> list[str]:
    """List the public names.

    None for ``help(cnpgen)``, which would print every class in full.
    """
    caller = sys._getframe(1).f_globals.get("__name__")
    return [] if caller == "inspect" else _names()
