"""What is to be planned: rows of a dataset, checked against what a model can do."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError
from cnpgen.planner.model import Model
from cnpgen.plans.boundary_file import ASKED, CONTEXT, boundary_in
from cnpgen.plans.boundary_problems import chosen_rows
from cnpgen.problems.record import ProblemRecord, as_record
from cnpgen.store.blueprint import Blueprint
from cnpgen.store.files.documents import canonical_sha256
from cnpgen.store.reader import open_dataset
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]

CERTIFIED = "certified-plan"  # the stage that plans every sample


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
    rows = chosen_rows(folder, dataset.blueprint, split=split, start=first, n=n)
    known = {each.name for each in dataset.blueprint.fields}
    names = [name for name in ASKED if name in known]
    found = dataset.read(split, fields=names, start=rows.start, stop=rows.stop)
    columns = {name: np.asarray(found[name], np.float64) for name in CONTEXT if name in found}
    boundary = checked_boundary(str(folder), found, model)
    return Requests(boundary, found.get("sample_id", np.array(rows)), columns)


def checked_boundary(where: str, found: Mapping[str, NDArray[Any]], model: Model) -> Boundary:
    """Take the boundary conditions that a model can plan for out of named columns; what is missing is zero.

    Raises:
        DatasetError: A shape is wrong, something is not finite, or goal accelerations are prescribed that the model
            leaves free.
    """
    if "goal_ddq" in found and model.fixed_at_goal == 2:
        raise DatasetError(f"{where} prescribes goal accelerations (goal_ddq), and the model leaves them free")
    return boundary_in(where, found, len(model.problem.joint_names))


def check_problem(where: str, found: ProblemRecord, model: Model) -> None:
    """Refuse what is of another problem than the model."""
    if found.comparable_sha256 != model.problem.comparable_sha256:
        differs = ", ".join(found.differences(model.problem)[:4])
        raise DatasetError(
            f"the model plans for {model.problem.name!r}, but {where} is of {found.name!r}: they differ in {differs}"
        )


def drawing_stages(stages: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the stages that draw rows: those of a certified dataset are the same, only that its rows have plans."""
    return [stage for stage in stages if stage.get("use") != CERTIFIED]


def _drawing(stages: Iterable[Mapping[str, Any]]) -> str:
    """Digest of how rows are drawn."""
    return canonical_sha256(drawing_stages(stages))


def check_drawing(where: str, blueprint: Blueprint, model: Model, *, other: bool) -> None:
    """Refuse rows of another problem, and if not ``other`` those drawn in another way than the training rows."""
    check_problem(where, as_record(blueprint.problem), model)
    trained = model.training.get("stages")
    if other or trained is None or _drawing(trained) == _drawing(blueprint.stages):
        return
    name = model.training.get("dataset", {}).get("name", "another dataset")
    raise DatasetError(
        f"the rows of {where} are drawn in another way than those of {name!r} that the model was trained on: the"
        " recipe has changed since, or it is another one; other=True plans for them all the same"
    )
