"""Training data: a dataset on disk, or the problems of a scene file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.load import load_dataset
from cnpgen.planner.control_points import ControlPoints
from cnpgen.plans.format import CONDITIONS, OBSTACLE_POSES
from cnpgen.problems.problem_record import as_problem
from cnpgen.problems.scenes.scene_files import holds_scenes, load_scenes
from cnpgen.schema.arguments import concerning
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.training.scene_rows import make_scene_rows
from cnpgen.training.training_rows import TrainingProblems, boundary_columns

DEMONSTRATION = ("path_control_points", "rate_control_points")  # columns of a certified dataset


class TrainingData(Protocol):
    """Rows to train on and to validate with."""

    @property
    def problem(self) -> StoredProblem:
        """The problem of all rows."""

    @property
    def place(self) -> str:
        """Folder or file, for messages."""

    @property
    def stages(self) -> list[dict[str, Any]]:
        """Stages of the pipeline that made the rows; empty for other rows."""

    def training(self) -> TrainingProblems:
        """Read all training rows."""

    def checked(self, rows: int) -> TrainingProblems:
        """Read the validation rows that compare models: the first ones, at most half of all."""

    def judged(self, rows: int, *, after: int) -> TrainingProblems:
        """Read the validation rows for the final score: those that follow the ones of ``checked(after)``."""

    def demonstrations(self, joints: int) -> ControlPoints | None:
        """Read the plans of the training rows; None if there are none."""

    def describe(self) -> dict[str, Any]:
        """Return the identity of the rows, for the model's file."""


@dataclass(frozen=True)
class DatasetRows:
    """A dataset to train on; see ``TrainingData``.

    Attributes:
        dataset: The dataset.
        train: Name of the split to train on.
        validation: Name of the split to validate on.
    """

    dataset: Dataset
    train: str
    validation: str

    @property
    def problem(self) -> StoredProblem:
        """See ``TrainingData``."""
        return self.dataset.problem

    @property
    def place(self) -> str:
        """See ``TrainingData``."""
        return str(self.dataset.folder)

    @property
    def stages(self) -> list[dict[str, Any]]:
        """See ``TrainingData``."""
        return self.dataset.spec.stages

    def training(self) -> TrainingProblems:
        """See ``TrainingData``."""
        columns = self.dataset.arrays(self.train, fields=self._names, dtype="float64")
        return TrainingProblems(boundary_columns(columns), columns.get(OBSTACLE_POSES))

    def checked(self, rows: int) -> TrainingProblems:
        """See ``TrainingData``."""
        return self._validation(0, self._checks(rows))

    def judged(self, rows: int, *, after: int) -> TrainingProblems:
        """See ``TrainingData``."""
        first = self._checks(after)
        return self._validation(first, first + rows)

    def _checks(self, rows: int) -> int:
        return min(rows, self.dataset.splits[self.validation] // 2)

    def _validation(self, first: int, stop: int) -> TrainingProblems:
        rows = list(range(first, min(stop, self.dataset.splits[self.validation])))
        columns = self.dataset.rows(self.validation, rows, fields=self._names, dtype="float64")
        return TrainingProblems(boundary_columns(columns), columns.get(OBSTACLE_POSES))

    @property
    def _names(self) -> list[str]:
        names = [name for name in CONDITIONS if name in self.dataset.fields]
        return [*names, OBSTACLE_POSES] if self.dataset.spec.scene_obstacles else names

    def demonstrations(self, joints: int) -> ControlPoints | None:
        """See ``TrainingData``."""
        if not set(DEMONSTRATION) <= set(self.dataset.fields):
            return None
        columns = self.dataset.arrays(self.train, fields=DEMONSTRATION, dtype="float32")
        path, rate = (columns[name] for name in DEMONSTRATION)
        return ControlPoints(path.reshape(len(path), -1, joints), rate)

    def describe(self) -> dict[str, Any]:
        """See ``TrainingData``."""
        spec = self.dataset.spec
        return {
            "name": spec.name,
            "version": spec.version,
            "seed": spec.seed,
            "recipe_sha256": spec.recipe_sha256,
            "fingerprint": self.dataset.fingerprint,
            "rows": dict(self.dataset.splits),
        }


def open_training_data(folder: str | Path, robot: str | Path | None = None) -> TrainingData:
    """Open a dataset, or the problems of a scene file, for training.

    Args:
        folder: The dataset; with ``robot`` a scene file, or a folder of scene files.
        robot: Problem of the robot in these scenes.

    Raises:
        DatasetError: It is missing, unfinished or damaged, or has no rows for training or validation.
        UsageError: There is no such robot or file.
        SceneError: A scene does not fit the robot.
    """
    if robot is not None:
        with concerning("robot"):
            problem = as_problem(robot)
        return make_scene_rows(problem, load_scenes(folder), str(folder))
    if Path(folder).exists() and holds_scenes(Path(folder)):
        raise UsageError(f"{folder} holds scenes: {{robot}} trains on them", remedies={"robot": "panda"})
    dataset = load_dataset(folder)
    names = [name for name, rows in dataset.splits.items() if rows]
    if len(names) < 2:
        raise DatasetError(f"{folder} needs a split to train on and another one to validate with, it has {names}")
    train = "train" if "train" in names else names[0]
    others = [name for name in names if name != train]
    validation = "validation" if "validation" in others else others[0]
    if dataset.splits[validation] < 2:
        raise DatasetError(
            f"{folder} has 1 row in {validation!r}: models are compared on some rows and scored on others"
        )
    return DatasetRows(dataset, train, validation)
