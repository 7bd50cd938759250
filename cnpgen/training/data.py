"""Training data: a dataset on disk, its problem and its splits."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.load import load_dataset
from cnpgen.planner.control_points import ControlPoints
from cnpgen.plans.format import CONDITIONS
from cnpgen.training.training_rows import boundary_columns
from cnpgen.trajectory.boundary import Boundary

DEMONSTRATION = ("path_control_points", "rate_control_points")  # columns of a certified dataset


@dataclass(frozen=True)
class TrainingData:
    """A dataset to train on.

    Attributes:
        dataset: The dataset.
        train: Name of the split to train on.
        validation: Name of the split to validate on.
    """

    dataset: Dataset
    train: str
    validation: str

    def training(self) -> Boundary:
        """Read the boundary conditions of all training rows."""
        return boundary_columns(self.dataset.arrays(self.train, fields=self._names, dtype="float64"))

    def checked(self, rows: int) -> Boundary:
        """Read the validation rows that compare models: the first ones, at most half of all."""
        return self._validation(0, self._checks(rows))

    def judged(self, rows: int, *, after: int) -> Boundary:
        """Read the validation rows for the final score: those that follow the ones of ``checked(after)``."""
        first = self._checks(after)
        return self._validation(first, first + rows)

    def _checks(self, rows: int) -> int:
        return min(rows, self.dataset.splits[self.validation] // 2)

    def _validation(self, first: int, stop: int) -> Boundary:
        rows = list(range(first, min(stop, self.dataset.splits[self.validation])))
        return boundary_columns(self.dataset.rows(self.validation, rows, fields=self._names, dtype="float64"))

    @property
    def _names(self) -> list[str]:
        return [name for name in CONDITIONS if name in self.dataset.fields]

    def demonstrations(self, joints: int) -> ControlPoints | None:
        """Read the plans of a certified dataset's training rows; None if it has none."""
        if not set(DEMONSTRATION) <= set(self.dataset.fields):
            return None
        columns = self.dataset.arrays(self.train, fields=DEMONSTRATION, dtype="float32")
        path, rate = (columns[name] for name in DEMONSTRATION)
        return ControlPoints(path.reshape(len(path), -1, joints), rate)

    def describe(self) -> dict[str, Any]:
        """Return the identity of the rows, for the model's file."""
        spec = self.dataset.spec
        return {
            "name": spec.name,
            "version": spec.version,
            "seed": spec.seed,
            "recipe_sha256": spec.recipe_sha256,
            "fingerprint": self.dataset.fingerprint,
            "rows": dict(self.dataset.splits),
        }


def open_training_data(folder: str | Path) -> TrainingData:
    """Open a dataset for training.

    Raises:
        DatasetError: It is missing, unfinished or damaged, has scenes, or has no rows for training or validation.
    """
    dataset = load_dataset(folder)
    if dataset.spec.scene_obstacles:
        raise DatasetError(f"{folder} has scenes, which networks do not observe yet: train with other data")
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
    return TrainingData(dataset, train, validation)
