"""The rows that are trained on, prepared once: tasks, features and obstacles in memory."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.network.features import Features, fit_features
from cnpgen.network.omega import ControlPoints
from cnpgen.network.tasks import Tasks
from cnpgen.planner.preparation import Preparation
from cnpgen.plans.layout import BOUNDARY
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[Any]
BLOCK = 8192  # rows prepared at once


@dataclass(frozen=True)
class Rows:
    """N rows ready for training.

    Attributes:
        tasks: The tasks.
        features: The network's inputs, shape (N, F).
        tops: Heights of the obstacles' upper faces [m], shape (N, obstacles).
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
    """Return the boundary conditions among the columns of a dataset; what it lacks is zero."""
    zero = np.zeros_like(columns["start_q"], np.float64)
    return Boundary(*(np.asarray(columns.get(name, zero), np.float64) for name in BOUNDARY))


def prepare_rows(
    boundary: Boundary, prepare: Preparation, *, features: Features | None = None, dtype: str = "float32"
) -> tuple[Rows, Features]:
    """Prepare rows.

    Args:
        boundary: Boundary conditions of N rows.
        prepare: What prepares tasks of the problem.
        features: How features are standardised; by these rows if None.
        dtype: Float type of the rows.

    Returns:
        The rows, and how their features are standardised.
    """
    tasks = prepare(boundary)
    features = features or fit_features(tasks)
    tops = prepare.tops(tasks.start_xyz, tasks.goal_xyz).astype(dtype)
    return Rows(tasks.astype(dtype), features.of(tasks, dtype), tops), features


def resting(boundary: Boundary) -> tuple[str, ...]:
    """Name the boundary conditions that are zero in every row."""
    return tuple(name for name in BOUNDARY if name.endswith("dq") and not np.any(getattr(boundary, name)))
