"""What is to be planned, from a file: a shard, a file of plans, or boundary conditions and nothing else."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.errors import DatasetError, UsageError
from cnpgen.planner.model import Model
from cnpgen.planner.requests import ASKED, CONTEXT, Requests, boundary_in, check_drawing, check_problem
from cnpgen.plans.load import stored_problem
from cnpgen.store.blueprint import load_blueprint
from cnpgen.store.files.hdf5 import opened_foreign_hdf5
from cnpgen.store.paths import require_file
from cnpgen.store.shard import FORMAT


def read_file(path: Path, model: Model, *, other: bool = False) -> Requests:
    """Read boundary conditions from an HDF5 file.

    Args:
        path: The file, with datasets ``start_q`` and ``goal_q`` of shape (N, n), and ``start_dq``, ``start_ddq`` and
            ``goal_dq`` where they are not zero.
        model: What will plan for them.
        other: Whether the rows of a shard may be drawn in another way than those that the model was trained on.

    Raises:
        UsageError: There is no such file, or it is no shard and its rows were to be other ones.
        DatasetError: The file is damaged, lacks something, prescribes goal accelerations, is of another problem, or a
            shard of other rows.
    """
    require_file(path, "a dataset or an HDF5 file of boundary conditions")
    with opened_foreign_hdf5(path) as file:
        said = {name: _text(value) for name, value in file.attrs.items()}
        found = {name: np.asarray(file[name][()]) for name in ASKED if name in file}
    missing = [name for name in ("start_q", "goal_q") if name not in found]
    if missing:
        raise DatasetError(f"{path} lacks {' and '.join(missing)}: boundary conditions are needed to plan")
    if said.get("format") == FORMAT:
        _check_shard(path, said, model, other=other)
    elif other:
        raise UsageError(f"other=True is for rows of a dataset, and {path} does not say how its rows were drawn")
    else:
        _check_said(path, said, model)
    boundary = boundary_in(str(path), found, model)
    columns = {name: np.asarray(found[name], np.float64) for name in CONTEXT if name in found}
    ids = found.get("sample_id", np.arange(len(boundary)))
    if ids.shape != (len(boundary),) or ids.dtype.kind not in "iu":
        raise DatasetError(f"{path}: sample_id must hold {len(boundary)} integers, got {ids.dtype} of {ids.shape}")
    return Requests(boundary, ids.astype(np.int64), columns)


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _check_shard(path: Path, said: Mapping[str, str], model: Model, *, other: bool) -> None:
    """Check a shard by the plan of its dataset; one that was taken out of it, by the digest of its recipe."""
    try:
        plan = load_blueprint(path.absolute().parents[1])
    except (DatasetError, IndexError):
        plan = None
    if plan is not None and plan.fingerprint == said.get("plan_fingerprint"):
        check_drawing(str(path), plan, model, other=other)
    elif not other and said.get("recipe_sha256") != model.training.get("dataset", {}).get("recipe_sha256"):
        raise DatasetError(
            f"{path} is a shard whose dataset is not beside it, and of another recipe than the rows that the model was"
            " trained on; other=True plans for it all the same"
        )


def _check_said(path: Path, said: Mapping[str, str], model: Model) -> None:
    """Check the problem that a file says it is of; one that says nothing is taken at its joints."""
    record = stored_problem(path, said)
    if record is not None:
        check_problem(str(path), record, model)
    elif said.get("problem_sha256", model.problem.comparable_sha256) != model.problem.comparable_sha256:
        raise DatasetError(f"{path} is of another problem than the model, which plans for {model.problem.name!r}")
