"""The rows that are trained on, prepared once: tasks, features and obstacles in memory."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader.order import Order
from cnpgen.planner.control_points import ControlPoints
from cnpgen.planner.network.features import Features, fit_features, usual_blocks
from cnpgen.planner.preparation import Preparation
from cnpgen.planner.tasks import Tasks
from cnpgen.plans.format import BOUNDARY, CONDITIONS
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[Any]
BLOCK = 8192  # rows prepared at once


@dataclass(frozen=True)
class Rows:
    """N rows ready for training.

    Attributes:
        tasks: The tasks.
        features: The network's inputs, shape (N, F).
        tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers).
        shown: Control points of demonstrations; None where there are none.
    """

    tasks: Tasks
    features: Array
    tops: Array
    shown: ControlPoints | None = None

    def __len__(self) -> int:
        return len(self.features)

    def take(self, which: NDArray[np.intp]) -> "Rows":
        """Return some of the rows."""
        shown = None if self.shown is None else ControlPoints(self.shown.path[which], self.shown.rate[which])
        return Rows(self.tasks.take(which), self.features[which], self.tops[which], shown)


def boundary_columns(columns: dict[str, Array]) -> Boundary:
    """Return the boundary conditions among the columns of a dataset; what it lacks is zero, goal accelerations free."""
    zero = np.zeros_like(columns["start_q"], np.float64)
    named = {name: columns.get(name, zero) for name in CONDITIONS if name in columns or name in BOUNDARY}
    return Boundary(**{name: np.asarray(values, np.float64) for name, values in named.items()})


def prepare_rows(
    boundary: Boundary,
    prepare: Preparation,
    *,
    features: Features | None = None,
    lines: Callable[[Boundary], Tasks] | None = None,
    dtype: str = "float32",
) -> tuple[Rows, Features]:
    """Prepare rows, a block at a time: what is needed on the way takes four times what is kept.

    Args:
        boundary: Boundary conditions of N rows.
        prepare: What prepares tasks of the problem.
        features: How features are standardised; by these rows if None.
        lines: What prepares tasks along other lines; ``prepare`` if None.
        dtype: Float type of the rows.

    Returns:
        The rows, and how their features are standardised.
    """
    blocks = [slice(first, first + BLOCK) for first in range(0, max(len(boundary), 1), BLOCK)]
    straight = replace(prepare, line=None)  # features know nothing of the bent line, which is most of the work
    chosen = features or fit_features((straight(boundary[block]) for block in blocks), usual_blocks(boundary))
    kept: dict[str, Array] = {}
    for block in blocks:
        for name, values in _arrays((lines or prepare)(boundary[block]), prepare, chosen, dtype).items():
            if name not in kept:
                kept[name] = np.empty((len(boundary), *values.shape[1:]), dtype)
            kept[name][block] = values
    ends = Boundary(**{name: kept.pop(name) for name in boundary.given()})
    rows = Rows(features=kept.pop("features"), tops=kept.pop("tops"), tasks=Tasks(ends, **kept))
    return rows, chosen


def _arrays(tasks: Tasks, prepare: Preparation, features: Features, dtype: str) -> dict[str, Array]:
    """Return everything of a block of rows that has a row per task, by name."""
    found = tasks.boundary.given()
    found |= {name: values for name, values in vars(tasks).items() if name != "boundary" and values is not None}
    return found | {"features": features.of(tasks, dtype), "tops": prepare.tops(tasks.start_xyz, tasks.goal_xyz)}


def resting(boundary: Boundary) -> tuple[str, ...]:
    """Name the boundary conditions that are zero in every row."""
    return tuple(name for name, values in boundary.given().items() if name.endswith("dq") and not np.any(values))


class StepRows:
    """Batches of shuffled rows; every epoch has another order, what does not fill a batch is left out.

    Args:
        rows: Number of rows.
        batch_size: Rows per batch.
        seed: Seed.
    """

    def __init__(self, rows: int, batch_size: int, seed: int) -> None:
        self.batch_size = min(batch_size, rows)
        self.batches = rows // self.batch_size
        self._rows, self._seed, self._epoch = rows, seed, -1
        self._order: NDArray[np.int64] = np.empty(0, np.int64)

    def batch(self, step: int) -> NDArray[np.int64]:
        """Return the rows of the batch of one step, shape (batch_size,)."""
        epoch, index = divmod(step, self.batches)
        if epoch != self._epoch:
            self._epoch, self._order = epoch, Order("train", (self._rows,), self._seed, epoch).rows_of(0)
        return self._order[index * self.batch_size : (index + 1) * self.batch_size]
