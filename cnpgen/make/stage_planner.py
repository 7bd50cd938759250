"""Planner of a stage: rows depend on its weights, so recipes name the sha256 of its file."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.pipelines.context import Context
from cnpgen.plans.format import CONDITIONS
from cnpgen.problems.problem_record import record_problem
from cnpgen.store.files.atomic import file_sha256
from cnpgen.trajectory.boundary import Boundary

if TYPE_CHECKING:
    from cnpgen.planner.planner import Planner

Array = NDArray[np.float64]

SHA256 = "^([0-9a-f]{64})?$"


def model_sha256(model: str) -> str:
    """Return the sha256 of the file of a model, by the name of a shipped one or the file's path.

    Raises:
        UsageError: There is no such model.
    """
    from cnpgen.planner.model_file import find_model

    return file_sha256(find_model(model))


def load_stage_planner(model: str, sha256: str, context: Context) -> "Planner":
    """Load the planner of a stage, a shipped model or a model file with the digest ``sha256``.

    Raises:
        RecipeError: The file has another sha256, or the model is for another problem.
        UsageError: There is no such model.
    """
    from cnpgen.planner.model_file import load_model
    from cnpgen.planner.planner import Planner

    digest = model_sha256(model)
    if digest != sha256:
        raise RecipeError([f"sha256: the file of model {model!r} has {digest}, expected {sha256}"])
    loaded, problem = load_model(model), record_problem(context.problem)
    if loaded.problem.comparable_sha256 != problem.comparable_sha256:
        differs = ", ".join(problem.differences(loaded.problem)[:4])
        raise RecipeError([f"model: {model!r} plans for another problem, they differ in {differs}; leave it out"])
    return Planner(loaded, backend=context.kernels.backend)


def planner_boundary(columns: Mapping[str, Array], planner: "Planner") -> Boundary:
    """Return the boundary conditions of N rows for a planner, from columns of shape (N, width).

    Goal accelerations are omitted if the planner leaves them free.
    """
    names = [name for name in CONDITIONS if name != "goal_ddq" or planner.model.fixed_at_goal == 3]
    return Boundary(**{name: columns[name] for name in names if name in columns})
