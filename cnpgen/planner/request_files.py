"""What is to be planned, from a file: a shard, a file of plans, or boundary conditions and nothing else."""

from pathlib import Path

import numpy as np

from cnpgen.errors import DatasetError, UsageError
from cnpgen.planner.model import Model
from cnpgen.planner.requests import Requests, check_drawing, check_problem, checked_boundary
from cnpgen.plans.boundary_file import CONTEXT, BoundaryFile, read_boundary_file


def read_file(path: Path, model: Model, *, other: bool = False) -> Requests:
    """Read boundary conditions from an HDF5 file.

    Args:
        path: The file, as ``read_boundary_file`` reads it.
        model: What will plan for them.
        other: Whether the rows of a shard may be drawn in another way than those that the model was trained on.

    Raises:
        UsageError: There is no such file, or it is no shard and its rows were to be other ones.
        DatasetError: The file is damaged, lacks something, prescribes goal accelerations that the model leaves free, is
            of another problem, or a shard of other rows.
    """
    file = read_boundary_file(path)
    if file.is_shard:
        _check_shard(file, model, other=other)
    elif other:
        raise UsageError(f"other=True is for rows of a dataset, and {path} does not say how its rows were drawn")
    else:
        _check_said(file, model)
    boundary = checked_boundary(str(path), file.columns, model)
    columns = {name: np.asarray(file.columns[name], np.float64) for name in CONTEXT if name in file.columns}
    return Requests(boundary, file.sample_id(len(boundary)), columns)


def _check_shard(file: BoundaryFile, model: Model, *, other: bool) -> None:
    """Check a shard by the blueprint of its dataset; one that was taken out of it, by the digest of its recipe."""
    blueprint = file.blueprint()
    if blueprint is not None:
        check_drawing(str(file.path), blueprint, model, other=other)
    elif not other and file.text("recipe_sha256") != model.training.get("dataset", {}).get("recipe_sha256", ""):
        raise DatasetError(
            f"{file.path} is a shard whose dataset is not beside it, and of another recipe than the rows that the model"
            " was trained on; other=True plans for it all the same"
        )


def _check_said(file: BoundaryFile, model: Model) -> None:
    """Check the problem that a file says it is of; one that says nothing is taken at its joints."""
    record = file.problem()
    if record is not None:
        check_problem(str(file.path), record, model)
    elif file.text("problem_sha256") not in {"", model.problem.comparable_sha256}:
        raise DatasetError(f"{file.path} is of another problem than the model, which plans for {model.problem.name!r}")
