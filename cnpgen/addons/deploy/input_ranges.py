"""Ranges of a network's inputs in its training rows: outside of them a plan is an extrapolation.

Inputs are standardized features. Those that were constant in the rows that
standardized them are zero, so the network ignores them, and so do the ranges.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cnpgen.arrays import Array
from cnpgen.planner.inference_pipeline import LoadedProblem
from cnpgen.planner.model import Model
from cnpgen.planner.plan_requests import read_rows
from cnpgen.planner.task_preprocessor import make_task_preprocessor

MAX_DEVIATIONS = 6.0  # of inputs of a model that stores no ranges
ROUNDING_TOLERANCE = (
    1e-5  # of a standard deviation, since the stored ranges are rounded
)
ROWS_PER_BLOCK = 4096
_UNLIMITED = 1e300  # no range
_NO_RANGES = "since the model stores no ranges"


@dataclass(frozen=True)
class InputRanges:
    """Ranges of the inputs, shape (F,) each.

    Attributes:
        low: Smallest inputs.
        high: Largest inputs.
        source: A text that says where they are from.
    """

    low: Array
    high: Array
    source: str


def input_ranges(
    model: Model, loaded: LoadedProblem, rows: Path | None = None
) -> InputRanges:
    """Return the ranges of the inputs: of a dataset, or stored in the model, or a substitute.

    Raises:
        DatasetError: The dataset is damaged, or not of the rows that the model was
            trained on.
    """
    stored = model.training.get("input_ranges")
    if rows is not None:
        low, high, count = _of_dataset(model, loaded, rows)
        source = f"smallest and largest values in {count:,} training rows of a dataset"
        # Rows at the edge of the ranges are inside in spite of rounding.
        return InputRanges(low - ROUNDING_TOLERANCE, high + ROUNDING_TOLERANCE, source)
    if stored is not None:
        low, high = np.array(stored["low"], float), np.array(stored["high"], float)
        source = "smallest and largest values in the training rows, stored in the model"
        return InputRanges(low - ROUNDING_TOLERANCE, high + ROUNDING_TOLERANCE, source)
    return _substitute(model)


def _substitute(model: Model) -> InputRanges:
    """Return ranges from the standardization, if that is of the model's own rows."""
    if not model.features.mean.any():
        # Preset "paper": states in units of the limits.
        limit = 1 + ROUNDING_TOLERANCE
        source = f"positions within pi, velocities and accelerations within the limits, {_NO_RANGES}"
    elif model.training.get("start_from"):
        # Its features are those of other rows.
        limit = _UNLIMITED
        source = f"unknown, {_NO_RANGES}: no input is refused as outside of it"
    else:
        limit = MAX_DEVIATIONS
        source = f"mean +- {limit:g} standard deviations of each feature, {_NO_RANGES}"
    high = np.full(model.architecture.inputs, limit)
    return InputRanges(-high, high, source)


def _of_dataset(
    model: Model, loaded: LoadedProblem, folder: Path
) -> tuple[Array, Array, int]:
    """Return the smallest and largest inputs of the training rows of a dataset, and their number."""
    boundary = read_rows(folder, model, split="train").boundary
    prepare = make_task_preprocessor(
        loaded.problem.for_planning,
        loaded.robot,
        loaded.kernels,
        model.config,
        fixed_at_goal=model.fixed_at_goal,
        placed=(),
    )
    # Blocks bound the memory of the features.
    parts = [
        model.features.of(prepare(boundary[first : first + ROWS_PER_BLOCK]), "float64")
        for first in range(0, len(boundary), ROWS_PER_BLOCK)
    ]
    low = np.min([part.min(axis=0) for part in parts], axis=0)
    high = np.max([part.max(axis=0) for part in parts], axis=0)
    return low, high, len(boundary)
