"""Training data: a dataset on disk, or the problems of a scene file."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cnpgen.arrays import Array
from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.load import load_dataset
from cnpgen.planner.control_points import ControlPoints
from cnpgen.plans.format import BOUNDARY, CONDITIONS
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_problem
from cnpgen.problems.scenes.scene_problem import SceneError, SceneProblem
from cnpgen.problems.scenes.scene_reader import holds_scenes, read_scenes
from cnpgen.schema.arguments import concerning
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.training.training_rows import TrainingProblems
from cnpgen.trajectory.boundary import Boundary

# Columns of a certified dataset.
DEMONSTRATION = "path_control_points", "rate_control_points"
VALIDATION_SHARE = 0.05  # of the problems of scenes, the last ones
MAX_VALIDATION_ROWS = 200  # verdicts among obstacles take a quarter of a second
MIN_SCENE_ROWS = 40


@dataclass(frozen=True)
class TrainingData(ABC):
    """Rows to train on and to validate with.

    ``place`` is the folder or file, for messages. ``stages`` are those of the pipeline
    that made the rows, if any.
    """

    problem: StoredProblem
    place: str
    stages: list[JsonObject]
    n_validation: int

    @abstractmethod
    def training(self) -> TrainingProblems:
        """Read all training rows."""

    @abstractmethod
    def describe(self) -> JsonObject:
        """Return the identity of the rows, for the model's file."""

    def demonstrations(self, joints: int) -> ControlPoints | None:  # noqa: ARG002 - used by datasets
        """Read the plans of the training rows; None if there are none."""
        return None

    def checked(self, rows: int) -> TrainingProblems:
        """Read the validation rows that compare models: the first ones, at most half of all."""
        return self._validation(0, self._checks(rows))

    def judged(self, rows: int, *, after: int) -> TrainingProblems:
        """Read the validation rows for the final score: those that follow the ones of ``checked(after)``."""
        first = self._checks(after)
        return self._validation(first, min(first + rows, self.n_validation))

    def _checks(self, rows: int) -> int:
        return min(rows, self.n_validation // 2)

    @abstractmethod
    def _validation(self, first: int, stop: int) -> TrainingProblems:
        """Read a range of the validation rows."""


@dataclass(frozen=True)
class DatasetRows(TrainingData):
    """A dataset to train on, with the names of the splits for training and validation."""

    dataset: Dataset
    train: str
    validation: str

    def training(self) -> TrainingProblems:
        """Read all training rows."""
        return _problems(
            self.dataset.arrays(self.train, fields=self._names, dtype="float64")
        )

    def _validation(self, first: int, stop: int) -> TrainingProblems:
        rows = list(range(first, stop))
        return _problems(
            self.dataset.rows(
                self.validation, rows, fields=self._names, dtype="float64"
            )
        )

    @property
    def _names(self) -> list[str]:
        names = [name for name in CONDITIONS if name in self.dataset.fields]
        return [*names, OBSTACLE_POSES] if self.dataset.spec.scene_obstacles else names

    def demonstrations(self, joints: int) -> ControlPoints | None:
        """Read the plans of the training rows of a certified dataset.

        None for another one.
        """
        if not set(DEMONSTRATION) <= set(self.dataset.fields):
            return None
        columns = self.dataset.arrays(self.train, fields=DEMONSTRATION, dtype="float32")
        path, rate = (columns[name] for name in DEMONSTRATION)
        return ControlPoints(path.reshape(len(path), -1, joints), rate)

    def describe(self) -> JsonObject:
        """Return the identity of the dataset."""
        spec = self.dataset.spec
        return {
            "name": spec.name,
            "version": spec.version,
            "seed": spec.seed,
            "recipe_sha256": spec.recipe_sha256,
            "fingerprint": self.dataset.fingerprint,
            "rows": dict(self.dataset.splits),
        }


def _problems(columns: dict[str, Array]) -> TrainingProblems:
    """Return the problems in columns of a dataset.

    Missing conditions are zero, goal accelerations free.
    """
    zero = np.zeros_like(columns["start_q"])
    named = {
        name: columns.get(name, zero)
        for name in CONDITIONS
        if name in columns or name in BOUNDARY
    }
    return TrainingProblems(Boundary(**named), columns.get(OBSTACLE_POSES))


@dataclass(frozen=True)
class SceneRows(TrainingData):
    """Problems of scenes to train on; exact symmetries multiply the training rows.

    The training rows are the problems and their reverses, from the goal to the start.
    The last problems are the validation rows. Boundary conditions have shape (N, n)
    each, poses and sizes of the obstacles (N, width).
    """

    boundary: Boundary
    obstacle_poses: Array

    def training(self) -> TrainingProblems:
        """Return all training rows."""
        training = slice(0, len(self.boundary) - self.n_validation)
        start = self.boundary.start_q[training]
        goal = self.boundary.goal_q[training]
        zero = np.zeros((2 * len(start), start.shape[1]))
        # From rest to rest, each problem reversed is one, too.
        there = np.concatenate([start, goal])
        back = np.concatenate([goal, start])
        return TrainingProblems(
            Boundary(there, zero, zero, back, zero),
            np.tile(self.obstacle_poses[training], (2, 1)),
        )

    def _validation(self, first: int, stop: int) -> TrainingProblems:
        # Validation rows are the last ones, and not multiplied.
        offset = len(self.boundary) - self.n_validation
        rows = slice(offset + first, offset + stop)
        return TrainingProblems(self.boundary[rows], self.obstacle_poses[rows])

    def describe(self) -> JsonObject:
        """Return the identity of the problems."""
        digest = hashlib.sha256()
        for values in (
            self.boundary.start_q,
            self.boundary.goal_q,
            self.obstacle_poses,
        ):
            digest.update(np.ascontiguousarray(values).tobytes())
        return {
            "name": self.place,
            "fingerprint": digest.hexdigest(),
            "rows": {"scenes": len(self.boundary)},
        }


def make_scene_rows(
    problem: Problem, scenes: Sequence[SceneProblem], place: str
) -> SceneRows:
    """Make training rows of scenes; the last ones validate models, so they should be of other scenes.

    Raise SceneError if a scene does not fit the robot, and UsageError if there are too
    few, or no ``robot-clearance``.
    """
    if len(scenes) < MIN_SCENE_ROWS:
        raise UsageError(
            f"{place} has {len(scenes)} problems, expected at least {MIN_SCENE_ROWS} to train and validate",
            concerns="folder",
        )
    for scene in scenes:
        if scene.request.start_dq is not None and np.any(scene.request.start_dq):
            raise SceneError(
                f"{scene.place} has a start velocity, expected problems from rest to rest for training"
            )
    plans = scene_plans(problem, scenes)
    n_validation = min(round(VALIDATION_SHARE * len(plans)), MAX_VALIDATION_ROWS)
    return SceneRows(
        plans.problem,
        place,
        [],
        n_validation,
        plans.boundary,
        plans.columns[OBSTACLE_POSES],
    )


def open_training_data(
    folder: str | Path, robot: str | Path | None = None
) -> TrainingData:
    """Open a dataset for training or, with the problem of a robot, a scene file or a folder of scene files.

    Raises:
        DatasetError: It is missing, unfinished or damaged, or has no rows for training
            or validation.
        UsageError: There is no such robot or file.
        SceneError: A scene does not fit the robot.
    """
    if robot is not None:
        with concerning("robot"):
            problem = as_problem(robot)
        return make_scene_rows(problem, read_scenes(Path(folder)), str(folder))
    if Path(folder).exists() and holds_scenes(Path(folder)):
        raise UsageError(
            f"{folder} holds scenes: {{robot}} trains on them",
            remedies={"robot": "panda"},
            concerns="folder",
        )
    dataset = load_dataset(folder)
    names = [name for name, rows in dataset.splits.items() if rows]
    if len(names) < 2:
        raise DatasetError(
            f"{folder} needs a split to train on and another one to validate with, it has {names}"
        )
    # Splits of other names: the first trains, the second validates.
    train = "train" if "train" in names else names[0]
    others = [name for name in names if name != train]
    validation = "validation" if "validation" in others else others[0]
    n_validation = dataset.splits[validation]
    if n_validation < 2:
        raise DatasetError(
            f"{folder} has 1 row in {validation!r}: models are compared on some rows and scored on others"
        )
    return DatasetRows(
        dataset.problem,
        str(dataset.folder),
        dataset.spec.stages,
        n_validation,
        dataset,
        train,
        validation,
    )
