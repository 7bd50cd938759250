"""What is to be planned: rows of a dataset, checked against what a model can do."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, UsageError, lacks
from cnpgen.planner.boundary_arguments import boundary_of
from cnpgen.planner.model import Model
from cnpgen.plans.format import BOUNDARY
from cnpgen.problems.record import ProblemRecord
from cnpgen.store.blueprint import Blueprint
from cnpgen.store.files.documents import canonical_sha256
from cnpgen.store.reader import open_dataset
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]

CERTIFIED = "certified-plan"  # the stage that plans every sample
CONTEXT = ("hit_angle", "hit_speed")  # columns of a dataset that plans keep
ASKED = (*BOUNDARY, "goal_ddq", "sample_id", *CONTEXT)


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
    check_drawing(str(folder), dataset.blueprint, model, other=other)
    if split not in dataset.blueprint.splits:
        raise UsageError(f"{folder} {lacks('split', split, dataset.blueprint.splits)}")
    rows = dataset.blueprint.splits[split]
    stop = rows if n is None else first + n
    if not 0 <= first < stop <= rows:
        wanted = f"{max(stop - first, 1)} from row {first} on"
        raise UsageError(f"split {split!r} of {folder} has rows 0 to {rows - 1}, got {wanted}")
    known = {each.name for each in dataset.blueprint.fields}
    names = [name for name in ASKED if name in known]
    found = dataset.read(split, fields=names, start=first, stop=stop)
    columns = {name: np.asarray(found[name], np.float64) for name in CONTEXT if name in found}
    boundary = boundary_in(str(folder), found, model)
    return Requests(boundary, found.get("sample_id", np.arange(first, stop)), columns)


def record_of(blueprint: Blueprint) -> ProblemRecord:
    """Return the problem of a dataset."""
    return ProblemRecord(
        json.dumps(blueprint.recipe["pipeline"]["problem"], ensure_ascii=False), str(blueprint.robot["urdf"])
    )


def boundary_in(where: str, found: Mapping[str, NDArray[Any]], model: Model) -> Boundary:
    """Take the boundary conditions out of named columns; what is missing is zero.

    Raises:
        DatasetError: A shape is wrong, something is not finite, or goal accelerations are prescribed.
    """
    if "goal_ddq" in found:
        raise DatasetError(f"{where} prescribes goal accelerations (goal_ddq), and the model leaves them free")
    try:
        given = (found.get(name) for name in BOUNDARY)
        return boundary_of(len(model.problem.joint_names), *given)  # type: ignore[arg-type]
    except UsageError as error:
        raise DatasetError(f"{where}: {error}") from error


def check_problem(where: str, found: ProblemRecord, model: Model) -> None:
    """Refuse what is of another problem than the model."""
    if found.comparable_sha256 != model.problem.comparable_sha256:
        differs = ", ".join(found.differences(model.problem)[:4])
        raise DatasetError(
            f"the model plans for {model.problem.name!r}, but {where} is of {found.name!r}: they differ in {differs}"
        )


def _drawing(stages: Iterable[Mapping[str, Any]]) -> str:
    """Digest of how rows are drawn; that of a certified dataset is the same, only that its rows have plans."""
    return canonical_sha256([stage for stage in stages if stage.get("use") != CERTIFIED])


def check_drawing(where: str, blueprint: Blueprint, model: Model, *, other: bool) -> None:
    """Refuse rows of another problem, and if not ``other`` those drawn in another way than the training rows."""
    check_problem(where, record_of(blueprint), model)
    trained = model.training.get("stages")
    if other or trained is None or _drawing(trained) == _drawing(blueprint.recipe["pipeline"]["stage"]):
        return
    name = model.training.get("dataset", {}).get("name", "another dataset")
    raise DatasetError(
        f"the rows of {where} are drawn in another way than those of {name!r} that the model was trained on: the"
        " recipe has changed since, or it is another one; other=True plans for them all the same"
    )
