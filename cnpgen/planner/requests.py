"""What is to be planned: rows of a dataset, or a file of boundary conditions; checked against what a model can do."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, UsageError, nearest
from cnpgen.planner.boundary_arguments import boundary_of
from cnpgen.planner.model import Model
from cnpgen.plans.layout import BOUNDARY
from cnpgen.plans.problem import ProblemRecord
from cnpgen.store.documents import canonical_sha256
from cnpgen.store.heaps import opened_foreign_hdf5
from cnpgen.store.places import require_file
from cnpgen.store.plan import DatasetPlan
from cnpgen.store.reader import open_dataset
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]

CERTIFIED = "certified-plan"  # the stage that plans every sample
CONTEXT = ("hit_angle", "hit_speed")  # columns of a dataset that plans keep


@dataclass(frozen=True)
class Requests:
    """N planning tasks.

    Attributes:
        boundary: Boundary conditions.
        sample_id: Which rows of a dataset these are, shape (N,).
        columns: What else is known of them.
    """

    boundary: Boundary
    sample_id: NDArray[np.int64]
    columns: Mapping[str, Array] = field(default_factory=dict)


def read_rows(
    folder: Path, model: Model, *, split: str = "validation", first: int = 0, n: int | None = None, other: bool = False
) -> Requests:
    """Read rows of a dataset.

    Args:
        folder: The dataset.
        model: What will plan for them.
        split: Which split.
        first: The first row.
        n: How many; all that follow by default.
        other: Whether rows may be drawn in another way than those that the model was trained on.

    Raises:
        DatasetError: The dataset is damaged, of another problem, or drawn in another way.
        UsageError: There are no such rows.
    """
    dataset = open_dataset(folder)
    _check_problem(str(folder), problem_of(dataset.plan), model)
    if not other:
        _check_stages(folder, dataset.plan, model)
    if split not in dataset.plan.splits:
        raise UsageError(f"{folder} has no split {split!r}{nearest(split, dataset.plan.splits)}")
    rows = dataset.plan.splits[split]
    stop = rows if n is None else first + n
    if not 0 <= first < stop <= rows:
        wanted = f"{max(stop - first, 1)} from row {first} on"
        raise UsageError(f"split {split!r} of {folder} has rows 0 to {rows - 1}, got {wanted}")
    known = {each.name for each in dataset.plan.fields}
    names = [name for name in (*BOUNDARY, "sample_id", *CONTEXT) if name in known]
    found = dataset.read(split, fields=names, start=first, stop=stop)
    columns = {name: np.asarray(found[name], np.float64) for name in CONTEXT if name in found}
    boundary = _boundary(str(folder), found, model)
    return Requests(boundary, found.get("sample_id", np.arange(first, stop)), columns)


def read_file(path: Path, model: Model) -> Requests:
    """Read boundary conditions from an HDF5 file: a shard, a file of plans, or one that holds nothing else.

    Args:
        path: The file, with datasets ``start_q`` and ``goal_q`` of shape (N, n), and ``start_dq``, ``start_ddq`` and
            ``goal_dq`` where they are not zero.
        model: What will plan for them.

    Raises:
        UsageError: There is no such file.
        DatasetError: The file is damaged, lacks something, or says that it is of another problem.
    """
    require_file(path, "a dataset or an HDF5 file of boundary conditions")
    with opened_foreign_hdf5(path) as file:
        digest = file.attrs.get("problem_sha256")
        found = {name: np.asarray(file[name][()]) for name in (*BOUNDARY, "sample_id") if name in file}
    if isinstance(digest, bytes | str):
        said = digest.decode(errors="replace") if isinstance(digest, bytes) else digest
        if said != model.problem.digest:
            raise DatasetError(f"{path} is of another problem than the model, which plans for {model.problem.name!r}")
    missing = [name for name in ("start_q", "goal_q") if name not in found]
    if missing:
        raise DatasetError(f"{path} lacks {' and '.join(missing)}: boundary conditions are needed to plan")
    boundary = _boundary(str(path), found, model)
    ids = found.get("sample_id")
    usable = ids is not None and ids.shape == (len(boundary),) and ids.dtype.kind in "iu"
    return Requests(boundary, ids.astype(np.int64) if usable and ids is not None else np.arange(len(boundary)))


def problem_of(plan: DatasetPlan) -> ProblemRecord:
    """Return the problem of a dataset."""
    return ProblemRecord(json.dumps(plan.recipe["pipeline"]["problem"], ensure_ascii=False), str(plan.robot["urdf"]))


def _boundary(where: str, found: Mapping[str, NDArray[Any]], model: Model) -> Boundary:
    try:
        return boundary_of(
            len(model.problem.joint_names),
            found["start_q"],
            found.get("start_dq"),
            found.get("start_ddq"),
            found["goal_q"],
            found.get("goal_dq"),
        )
    except UsageError as error:
        raise DatasetError(f"{where}: {error}") from error


def _check_problem(where: str, found: ProblemRecord, model: Model) -> None:
    if found.digest != model.problem.digest:
        differs = ", ".join(found.differences(model.problem)[:4])
        raise DatasetError(
            f"the model plans for {model.problem.name!r}, but {where} is of {found.name!r}: they differ in {differs}"
        )


def _drawing(stages: Iterable[Mapping[str, Any]]) -> str:
    """Digest of how rows are drawn; that of a certified dataset is the same, only that its rows have plans."""
    return canonical_sha256([stage for stage in stages if stage.get("use") != CERTIFIED])


def _check_stages(folder: Path, plan: DatasetPlan, model: Model) -> None:
    """Refuse rows that are drawn in another way than the training rows."""
    trained = model.training.get("stages")
    if trained is None or _drawing(trained) == _drawing(plan.recipe["pipeline"]["stage"]):
        return
    name = model.training.get("dataset", {}).get("name", "another dataset")
    raise DatasetError(
        f"the rows of {folder} are drawn in another way than those of {name!r} that the model was trained on: the"
        " recipe has changed since, or it is another one; --other-rows plans for them all the same"
    )
