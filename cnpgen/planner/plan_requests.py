"""Read planning tasks from datasets, HDF5 files and scenes, and check them against a model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.errors import DatasetError, UsageError
from cnpgen.planner.model import Model
from cnpgen.planner.planner import Planner
from cnpgen.plans.boundary_problems import (
    ASKED,
    CONTEXT,
    BoundaryFile,
    boundary_in,
    chosen_rows,
    read_boundary_file,
    scene_columns,
)
from cnpgen.plans.plans import Plans
from cnpgen.plans.plausible import check_boundary_units
from cnpgen.plans.scene_plans import scene_plans, shape_of
from cnpgen.problems.problem_record import ProblemRecord, as_record, open_problem
from cnpgen.problems.scenes.scene_problem import SceneProblem, checked_scene
from cnpgen.robots.scene import PARKED_POSITION_M
from cnpgen.store.files.documents import canonical_sha256
from cnpgen.store.reader import open_dataset
from cnpgen.store.scene_table import OBSTACLE_POSES, SCENE_ID
from cnpgen.trajectory.boundary import Boundary

CERTIFIED_STAGE = "certified-plan"  # the stage that plans every sample


@dataclass(frozen=True)
class Requests:
    """N planning tasks: boundary conditions, dataset rows, shape (N,), and further columns of the tasks."""

    boundary: Boundary
    sample_id: NDArray[np.int64]
    columns: Mapping[str, Array] = field(default_factory=dict)


def read_rows(
    folder: Path,
    model: Model,
    *,
    split: str = "validation",
    first: int = 0,
    n: int | None = None,
    other: bool = False,
) -> Requests:
    """Read n rows of a dataset, by default all from the first one on, for a model that will plan.

    Rows drawn by another recipe than the training rows are accepted if ``other`` is
    set.

    Raises:
        DatasetError: The dataset is damaged, of another problem, or drawn by another
            recipe.
        UsageError: There are no such rows.
    """
    dataset = open_dataset(folder)
    # A model is trained for the distribution of its rows: other rows need the caller's
    # consent.
    check_stages(
        str(folder),
        as_record(dataset.spec.problem),
        dataset.spec.stages,
        model,
        other=other,
    )
    rows = chosen_rows(folder, dataset.spec, split=split, start=first, n=n)
    stored = {column.name for column in dataset.spec.fields}
    # Only columns that a task needs are read.
    names = [name for name in (*ASKED, SCENE_ID) if name in stored]
    arrays = dataset.read(split, fields=names, start=rows.start, stop=rows.stop)
    columns = context_columns(arrays | scene_columns(dataset, split, rows, arrays))
    boundary = checked_boundary(str(folder), arrays, model)
    return Requests(boundary, arrays.get("sample_id", np.array(rows)), columns)


def read_file(
    path: Path, model: Model, *, other: bool = False, allow_large_angles: bool = False
) -> Requests:
    """Read boundary conditions from an HDF5 file: a shard, a plan file, or boundary conditions alone.

    Rows of a shard drawn by another recipe than the training rows are accepted if
    ``other`` is set.

    Raises:
        UnitError: Boundary conditions are probably in degrees or millimetres.
        UsageError: There is no such file, or ``other`` is set and the file is no shard.
        DatasetError: The file is damaged, incomplete, of another problem, of a shard of
            other rows, or prescribes goal accelerations that the model leaves free.
    """
    file = read_boundary_file(path)
    if file.is_shard:
        _check_shard(file, model, other=other)
    elif other:
        raise UsageError(
            f"{{other}} needs rows of a dataset, and {path} does not record how its rows were drawn",
            remedies={"other": True},
        )
    else:
        _check_recorded_problem(file, model)
    boundary = checked_boundary(str(path), file.columns, model)
    if not allow_large_angles:
        check_boundary_units(open_problem(model.problem)[1], boundary, where=str(path))
    file.check_obstacles(model.problem)
    return Requests(
        boundary, file.sample_id(len(boundary)), context_columns(file.columns)
    )


def plan_scenes(
    planner: Planner,
    scenes: Sequence[SceneProblem],
    *,
    goals: Sequence[NDArray[np.float64]] | None = None,
) -> Plans:
    """Plan the problems of scenes, from rest to rest.

    Args:
        planner: Planner of a model that was trained on scenes.
        scenes: The scenes.
        goals: Joint positions at the goals in the order of the planned joints [rad],
            shape (n,) each; by default the first goal state of each scene.

    Returns:
        A plan per scene, not checked yet (status UNKNOWN).

    Raises:
        SceneError: A scene does not fit the robot.
        UsageError: The model is for other problems, there are no scenes, or a scene has
            more obstacles of a kind than the model's problem.
    """
    requests = scene_requests(planner.model, scenes, goals=goals)
    return planner.plan_batch(
        requests.boundary, sample_id=requests.sample_id, columns=requests.columns
    )


def scene_requests(
    model: Model,
    scenes: Sequence[SceneProblem],
    *,
    goals: Sequence[NDArray[np.float64]] | None = None,
) -> Requests:
    """Return the tasks of scenes; see ``plan_scenes``."""
    if len(scenes) == 0:
        raise UsageError("there are no scenes", concerns="scenes")
    problem, _ = open_problem(model.problem)
    if not problem.has_sample_obstacles:
        raise UsageError(
            f"the model is for {problem.name!r}, whose obstacles do not differ from plan to plan: expected a model"
            " that was trained on scenes",
            concerns="model",
        )
    parked = Counter(
        shape_of(obstacle)
        for obstacle in problem.obstacle
        if obstacle.position == PARKED_POSITION_M
    )
    checked = [checked_scene(scene) for scene in scenes]
    plans = scene_plans(
        problem.with_obstacles(problem.own_obstacles),
        checked,
        goals=goals,
        capacity=parked,
    )
    return Requests(plans.boundary, plans.sample_id, context_columns(plans.columns))


def context_columns(columns: Mapping[str, NDArray[Any]]) -> dict[str, Array]:
    """Return the columns of tasks that plans keep: those of hits, and the obstacles of samples."""
    return {
        name: np.asarray(columns[name], np.float64)
        for name in (*CONTEXT, OBSTACLE_POSES)
        if name in columns
    }


def _check_shard(file: BoundaryFile, model: Model, *, other: bool) -> None:
    """Check a shard by its dataset's specification, or by its recipe's digest if it lies outside its dataset."""
    spec = file.spec()
    if spec is not None:
        check_stages(
            str(file.path), as_record(spec.problem), spec.stages, model, other=other
        )
    # Outside its dataset a shard has only the digest of its recipe.
    elif not other and file.text("recipe_sha256") != model.training.get(
        "dataset", {}
    ).get("recipe_sha256", ""):
        raise DatasetError(
            f"{file.path} is a shard outside its dataset, drawn by another recipe than the model's training rows;"
            " pass {other} to plan for it",
            remedies={"other": True},
        )


def _check_recorded_problem(file: BoundaryFile, model: Model) -> None:
    """Raise an error if a file records another problem than the model's.

    A file without a record is accepted.
    """
    record = file.problem()
    if record is not None:
        check_problem(str(file.path), record, model)
    elif file.text("problem_sha256") not in {"", model.problem.comparable_sha256}:
        raise DatasetError(
            f"{file.path} is of another problem than the model, which plans for {model.problem.name!r}"
        )


def checked_boundary(
    where: str, columns: Mapping[str, NDArray[Any]], model: Model
) -> Boundary:
    """Return the boundary conditions of ``boundary_in``.

    Raise DatasetError for goal accelerations if they are free.
    """
    # The converse, a fixed acceleration that the file lacks, is zero.
    if "goal_ddq" in columns and model.fixed_at_goal == 2:
        raise DatasetError(
            f"{where} prescribes goal accelerations (goal_ddq), and the model leaves them free"
        )
    return boundary_in(where, columns, len(model.problem.joint_names))


def check_problem(where: str, record: ProblemRecord, model: Model) -> None:
    """Raise an error if a record is of another problem than the model's."""
    if record.comparable_sha256 != model.problem.comparable_sha256:
        differs = ", ".join(record.differences(model.problem)[:4])
        raise DatasetError(
            f"the model plans for {model.problem.name!r}, but {where} is of {record.name!r}: they differ in {differs};"
            " train a model for it ('cnpgen train'), or plan without a model ('cnpgen solve')"
        )


def drawing_stages(stages: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the stages that draw rows: all but the stage that certifies them."""
    # Certifying removes rows without a valid plan and draws none.
    return [stage for stage in stages if stage.get("use") != CERTIFIED_STAGE]


def check_stages(
    where: str,
    record: ProblemRecord,
    drawn_by: Iterable[Mapping[str, Any]],
    model: Model,
    *,
    other: bool,
) -> None:
    """Raise an error for rows of another problem, and unless ``other`` for rows drawn by other resolved stages."""
    check_problem(where, record, model)
    stages = model.training.get("stages")
    if other or stages is None or _stages_sha256(stages) == _stages_sha256(drawn_by):
        return
    name = model.training.get("dataset", {}).get("name", "another dataset")
    raise DatasetError(
        f"the rows of {where} are drawn in another way than those of {name!r} that the model was trained on: the"
        " recipe has changed since, or is another one; pass {other} to plan for them",
        remedies={"other": True},
    )


def _stages_sha256(stages: Iterable[Mapping[str, Any]]) -> str:
    """Return the digest of the stages that draw rows."""
    return canonical_sha256(drawing_stages(stages))
