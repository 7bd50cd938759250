"""Boundary problems to solve: rows of a dataset or boundary conditions in a file, as plans that are still to be made.

Rows of a certified dataset have their plans already.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, UsageError, lacks
from cnpgen.plans.boundary_file import CONTEXT, read_boundary_file
from cnpgen.plans.load import agreed_problem
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.record import ProblemRecord, as_record
from cnpgen.schema.arguments import integer
from cnpgen.store.blueprint import StoredProblem
from cnpgen.store.paths import require_folder
from cnpgen.store.reader import open_dataset
from cnpgen.trajectory.boundary import Boundary

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cnpgen.store.blueprint import Blueprint


def load_boundary_problems(
    path: str | Path,
    *,
    split: str | None = None,
    start: int | None = None,
    n: int | None = None,
    problem: Problem | StoredProblem | str | Path | None = None,
) -> Plans:
    """Read boundary problems as plans that ``solve_plans`` is still to make: their control points are nan.

    Rows of a certified dataset have the stored plans. Of a file only the boundary conditions are read, also where it
    has plans: ``load_plans`` reads these.

    Args:
        path: The folder of a dataset, or an HDF5 file of boundary conditions: a shard, a file of plans, or any other
            with ``start_q`` and ``goal_q`` of shape (N, joints), and ``start_dq``, ``start_ddq`` and ``goal_dq`` where
            they are not zero, and ``goal_ddq`` where goal accelerations are not free.
        split: Which split of the dataset; "train" by default.
        start: The first row of the split; 0 by default.
        n: How many rows; by default all that follow.
        problem: The problem that a file must be of, by name, path or as loaded, or its record. Tolerances may differ
            from those in the file; those given here count.

    Raises:
        DatasetError: The dataset or the file cannot be read, lacks something or is of another problem.
        UsageError: There is no such folder, file or split, the split has no such rows, or rows of a file are asked for.
        RecipeError: ``problem`` has mistakes.
    """
    path = Path(path)
    if path.is_file() or (path.suffix == ".h5" and not path.is_dir()):
        if (split, start, n) != (None, None, None):
            raise UsageError(f"split, start and n choose rows of the folder of a dataset, {path} is a file")
        return _of_file(path, None if problem is None else as_record(problem))
    require_folder(path)
    if problem is not None:
        raise UsageError(f"problem says which problem a file is of: {path} is the folder of a dataset, which says it")
    return _of_folder(path, split or "train", 0 if start is None else start, n)


def _of_folder(folder: Path, split: str, start: int, n: int | None) -> Plans:
    """Return rows of a dataset."""
    dataset = open_dataset(folder)
    rows = chosen_rows(folder, dataset.blueprint, split=split, start=start, n=n)
    source = f"dataset {dataset.blueprint.name}, seed {dataset.blueprint.seed}, split {split}"
    columns = dataset.read(split, start=rows.start, stop=rows.stop)
    return plans_of_rows(as_record(dataset.blueprint.problem), columns, source=source)


def chosen_rows(folder: Path, blueprint: "Blueprint", *, split: str, start: int, n: int | None) -> range:
    """Return which rows of a split are meant.

    Args:
        folder: The dataset, for messages.
        blueprint: Its blueprint.
        split: Which split.
        start: The first row.
        n: How many; by default all that follow.

    Raises:
        UsageError: There is no such split, or it has no such rows.
    """
    start = integer("start", start, least=0)
    if split not in blueprint.splits:
        raise UsageError(f"{folder} {lacks('split', split, blueprint.splits)}")
    rows = blueprint.splits[split]
    stop = rows if n is None else start + integer("n", n, least=1)
    if not start < stop <= rows:
        wanted = f"{max(stop - start, 1)} from row {start} on"
        raise UsageError(f"split {split!r} of {folder} has {rows} rows, got {wanted}")
    return range(start, stop)


def _of_file(path: Path, wanted: ProblemRecord | None) -> Plans:
    """Return the boundary problems of a file."""
    file = read_boundary_file(path)
    problem = agreed_problem(path, file.problem(), wanted, content="boundary problems", command="solve")
    if (said := file.text("problem_sha256")) and said != problem.comparable_sha256:
        raise DatasetError(f"{path} is of another problem than {problem.name!r}: its problem_sha256 is not this one's")
    boundary = file.boundary(len(problem.joint_names))
    conditions = {name: values for name, values in vars(boundary).items() if values is not None}
    columns = {**file.columns, **conditions, "sample_id": file.sample_id(len(boundary))}
    try:
        plans = plans_of_rows(problem, columns, source=f"boundary conditions in {path.name}")
    except UsageError as error:
        raise DatasetError(f"{path}: {error}") from error
    return replace(plans, sealed=file.sealed)


def plans_of_rows(problem: ProblemRecord, columns: "Mapping[str, NDArray[Any]]", *, source: str = "") -> Plans:
    """Return rows of a dataset as plans: with those of a certified dataset, else with control points of nan.

    Args:
        problem: Their problem.
        columns: Field -> values, shape (N,) or (N, w), as shards hold them.
        source: Where they are from.
    """
    spec = problem.trajectory
    rows, n = columns["start_q"].shape
    kept = ("start_xyz", "goal_xyz", *CONTEXT)
    points, rates = spec.path_control_points, spec.rate_control_points
    path, rate = (columns.get(f"{part}_control_points", np.array(np.nan)) for part in ("path", "rate"))
    return make_plans(
        problem,
        Boundary.from_batch(columns, None),
        path_control_points=np.broadcast_to(path, (rows, points * n)).reshape(rows, points, n),
        rate_control_points=np.broadcast_to(rate, (rows, rates)),
        columns={name: columns[name] for name in kept if name in columns},
        sample_id=columns.get("sample_id"),
        source=source,
    )
