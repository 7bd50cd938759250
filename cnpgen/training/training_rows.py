"""Training rows in memory: tasks and features."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cnpgen.arrays import AnyArray, Columns, Indices, Integers
from cnpgen.loader.windows import Order
from cnpgen.planner.control_points import ControlPoints
from cnpgen.planner.network.features import Features, feature_blocks, fit_features
from cnpgen.planner.task_preprocessor import TaskPreprocessor
from cnpgen.planner.tasks import Tasks
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary

PREPARED_ROWS_PER_BLOCK = 8192


@dataclass(frozen=True)
class Rows:
    """N training rows: tasks, inputs of the network, shape (N, F), and control points of demonstrations or None."""

    tasks: Tasks
    features: AnyArray
    target: ControlPoints | None = None

    def __len__(self) -> int:
        return len(self.features)

    def take(self, which: Indices) -> "Rows":
        """Return a subset of the rows."""
        target = (
            None
            if self.target is None
            else ControlPoints(self.target.path[which], self.target.rate[which])
        )
        return Rows(self.tasks.take(which), self.features[which], target)


@dataclass(frozen=True)
class TrainingProblems:
    """N boundary problems to train on or to validate with.

    Poses and sizes of obstacles that samples place have shape (N, width); they are None
    for other problems.
    """

    boundary: Boundary
    obstacle_poses: AnyArray | None = None


def prepare_rows(
    boundary: Boundary,
    prepare: TaskPreprocessor,
    *,
    features: Features | None = None,
    blocks: tuple[str, ...] | None = None,
    lines: Callable[[Boundary], Tasks] | None = None,
    dtype: str = "float32",
    obstacle_poses: AnyArray | None = None,
) -> tuple[Rows, Features]:
    """Prepare rows in blocks, because temporary arrays take four times the memory of the result.

    Without ``features``, they are standardized by these rows, with some or all
    ``blocks``. ``lines`` preprocesses tasks along other lines than ``prepare``.
    Obstacles that samples place have poses and sizes of shape (N, width). Return the
    rows, and the standardization of their features.
    """
    parts = [
        slice(first, first + PREPARED_ROWS_PER_BLOCK)
        # At least one block, which gives shapes to empty arrays.
        for first in range(0, max(len(boundary), 1), PREPARED_ROWS_PER_BLOCK)
    ]
    # Features do not depend on the projected line, which takes most of the time.
    straight = replace(prepare, line=None)
    placed = bool(prepare.placed)
    poses = [None if obstacle_poses is None else obstacle_poses[part] for part in parts]
    pairs = list(zip(parts, poses, strict=True))
    definition = features or fit_features(
        (straight(boundary[part], obstacle_poses=own) for part, own in pairs),
        blocks or feature_blocks(boundary, placed=placed),
    )
    arrays: Columns = {}
    for part, own in pairs:
        rows = boundary[part]
        tasks = prepare(rows, obstacle_poses=own) if lines is None else lines(rows)
        for name, values in _arrays(tasks, definition, dtype).items():
            if name not in arrays:
                arrays[name] = np.empty((len(boundary), *values.shape[1:]), dtype)
            arrays[name][part] = values
    ends = Boundary(**{name: arrays.pop(name) for name in boundary.arrays()})
    row_features = arrays.pop("features")
    scene = Scene(tuple(prepare.problem.obstacle), arrays.pop("poses"))
    obstacles = Scene(prepare.placed, arrays.pop("placed")) if placed else None
    tasks = Tasks(ends, scene=scene, placed=obstacles, **arrays)
    return Rows(tasks, row_features), definition


def _arrays(tasks: Tasks, features: Features, dtype: str) -> Columns:
    """Return all arrays of a block of rows with one entry per task, by name."""
    arrays = tasks.boundary.arrays()
    parts = {
        name: values
        for name, values in vars(tasks).items()
        if isinstance(values, np.ndarray)
    }
    # It is part of the features.
    parts.pop("observation", None)
    parts |= {} if tasks.placed is None else {"placed": tasks.placed.poses}
    return (
        arrays
        | parts
        | {"features": features.of(tasks, dtype), "poses": tasks.scene.poses}
    )


def zero_conditions(boundary: Boundary) -> tuple[str, ...]:
    """Return the names of the boundary conditions that are zero in all rows."""
    return tuple(
        name
        for name, values in boundary.conditions().items()
        if name.endswith("dq") and not np.any(values)
    )


class StepRows:
    """Batches of shuffled rows.

    Every epoch has another order, and rows that do not fill a batch are omitted.
    """

    def __init__(self, rows: int, batch_size: int, seed: int) -> None:
        self.batch_size = min(batch_size, rows)
        self.batches = rows // self.batch_size
        self._rows = rows
        self._seed = seed
        self._epoch = -1
        self._order: Integers = np.empty(0, np.int64)

    def batch(self, step: int) -> Integers:
        """Return the rows of the batch of one step, shape (batch_size,)."""
        # The order of an epoch follows from seed and epoch, so that a resumed run
        # continues it.
        epoch, index = divmod(step, self.batches)
        if epoch != self._epoch:
            self._epoch = epoch
            self._order = Order("train", (self._rows,), self._seed, epoch).rows_of(0)
        return self._order[index * self.batch_size : (index + 1) * self.batch_size]
