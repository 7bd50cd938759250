"""Boundary problems of a dataset or file, as plans without motions; rows of a certified dataset have motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, UsageError, lacks
from cnpgen.plans.boundary_file import CONTEXT, read_boundary_file
from cnpgen.plans.format import GOAL_OPTION, OBSTACLE_POSES
from cnpgen.plans.plan_file import agreed_problem
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord, as_record, open_problem
from cnpgen.robots.scene import scene_poses
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.store.dataset_spec import DatasetSpec, StoredProblem
from cnpgen.store.paths import require_folder
from cnpgen.store.reader import StoredDataset, open_dataset
from cnpgen.store.scene_table import SCENE_ID
from cnpgen.trajectory.boundary import Boundary


@checked_arguments
def load_boundary_problems(
    path: str | Path,
    *,
    split: str | None = None,
    start: int | None = None,
    n: int | None = None,
    problem: Problem | StoredProblem | str | Path | None = None,
    allow_large_angles: bool = False,
) -> Plans:
    """Read boundary problems as plans without motions for ``solve_plans``: their control points are nan.

    Rows of a certified dataset have the stored plans. From a file, only the boundary conditions are read;
    ``load_plans`` reads its plans.

    Args:
        path: Folder of a dataset, or an HDF5 file of boundary conditions: a shard, a file of plans, or any other
            with ``start_q`` and ``goal_q`` of shape (N, joints), and ``start_dq``, ``start_ddq`` and ``goal_dq`` unless
            they are zero, and ``goal_ddq`` unless goal accelerations are free.
        split: Split of the dataset; "train" by default.
        start: First row of the split; 0 by default.
        n: Number of rows; by default all that follow.
        allow_large_angles: Whether to accept boundary conditions in a file that are probably in degrees or millimetres.
        problem: Required problem of a file: name, path, problem or record. Its tolerances replace those in the file.

    Raises:
        DatasetError: The dataset or the file cannot be read, is incomplete or is of another problem.
        UsageError: The folder, file, split or rows do not exist, or rows of a file are requested.
        UnitError: Boundary conditions of a file are probably in degrees or millimetres.
        RecipeError: ``problem`` has mistakes.
    """
    path = Path(path)
    if path.is_file() or (path.suffix == ".h5" and not path.is_dir()):
        if (split, start, n) != (None, None, None):
            raise UsageError(
                f"split, start and n choose rows of the folder of a dataset, {path} is a file", concerns="split"
            )
        return _of_file(path, None if problem is None else as_record(problem), allow_large_angles=allow_large_angles)
    require_folder(path, argument="path")
    if problem is not None:
        raise UsageError(
            f"problem says which problem a file is of: {path} is the folder of a dataset, which says it",
            concerns="problem",
        )
    return _of_folder(path, split or "train", 0 if start is None else start, n)


def _of_folder(folder: Path, split: str, start: int, n: int | None) -> Plans:
    """Return rows of a dataset."""
    dataset = open_dataset(folder)
    rows = chosen_rows(folder, dataset.spec, split=split, start=start, n=n)
    source = f"dataset {dataset.spec.name}, seed {dataset.spec.seed}, split {split}"
    columns = dataset.read(split, start=rows.start, stop=rows.stop)
    columns |= scene_columns(dataset, split, rows, columns)
    return plans_of_rows(as_record(dataset.spec.problem), columns, source=source)


def scene_columns(
    dataset: StoredDataset, split: str, rows: range, columns: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[Any]]:
    """Return the column with the obstacles of rows of a dataset; none if its samples have no scenes.

    The columns of the rows contain ``scene_id``.
    """
    if not dataset.spec.scene_obstacles:
        return {}
    scenes = dataset.read_scenes(split, start=rows.start, stop=rows.stop)
    obstacles = open_problem(as_record(dataset.spec.problem))[0].obstacle
    return {OBSTACLE_POSES: scene_poses(obstacles, scenes[scenes.rows_of(columns[SCENE_ID])])}


def chosen_rows(folder: Path, spec: DatasetSpec, *, split: str, start: int, n: int | None) -> range:
    """Return n rows of a split from ``start`` on as a range; by default all remaining rows.

    Raises:
        UsageError: The split or the rows do not exist.
    """
    start = integer("start", start, least=0)
    if split not in spec.splits:
        raise UsageError(f"{folder} {lacks('split', split, spec.splits)}", concerns="split")
    rows = spec.splits[split]
    stop = rows if n is None else start + integer("n", n, least=1)
    if not start < stop <= rows:
        wanted = f"{max(stop - start, 1)} from row {start} on"
        raise UsageError(f"split {split!r} of {folder} has {rows} rows, got {wanted}", concerns="n")
    return range(start, stop)


def _of_file(path: Path, wanted: ProblemRecord | None, *, allow_large_angles: bool) -> Plans:
    """Return the boundary problems of a file."""
    file = read_boundary_file(path)
    problem = agreed_problem(
        path, file.problem(required=wanted is None), wanted, content="boundary problems", command="solve"
    )
    if (recorded := file.text("problem_sha256")) and recorded != problem.comparable_sha256:
        raise DatasetError(f"{path} is of another problem than {problem.name!r}: its problem_sha256 is not this one's")
    file.check_obstacles(problem)
    boundary = file.boundary(open_problem(problem)[1], allow_large_angles=allow_large_angles)
    columns = {**file.columns, **boundary.arrays(), "sample_id": file.sample_id(len(boundary))}
    try:
        plans = plans_of_rows(problem, columns, source=f"boundary conditions in {path.name}")
    except UsageError as error:
        raise DatasetError(f"{path}: {error}") from error
    return replace(plans, has_checksum=file.has_checksum)


def plans_of_rows(problem: ProblemRecord, columns: Mapping[str, NDArray[Any]], *, source: str = "") -> Plans:
    """Return rows of a dataset, columns as in shards, as plans: those of a certified dataset, or of nan."""
    spec = problem.trajectory
    rows, n = columns["start_q"].shape
    kept = ("start_xyz", "goal_xyz", OBSTACLE_POSES, GOAL_OPTION, *CONTEXT)
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
        allow_large_angles=True,  # checked with the file or the tasks
    )
