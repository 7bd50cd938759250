"""Plans on their way into and out of the loss kernels: checked, cast, samples last, padded to whole vectors."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError
from cnpgen.recipes import Problem

Array = NDArray[Any]
BLOCK = 128  # plans at a time: their points stay in the cache
LANES = 16  # of the widest vectors


@dataclass(frozen=True)
class PlanBatch:
    """N plans and what the loss must know of their problems.

    Attributes:
        path: Path control points [rad], shape (N, C, n).
        rate: Rate control points [1/s], shape (N, R).
        tops: Heights of the obstacles [m], shape (N, obstacles).
        start_tip: Positions of the tip at the start [m], shape (N, 3), float64, or None.
        good: Whether a plan is one: finite, with a positive rate; shape (N,).
    """

    path: Array
    rate: Array
    tops: Array
    start_tip: Array | None
    good: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.rate)

    def __getitem__(self, rows: slice) -> "PlanBatch":
        start_tip = None if self.start_tip is None else self.start_tip[rows]
        return PlanBatch(self.path[rows], self.rate[rows], self.tops[rows], start_tip, self.good[rows])

    def lanes(self, values: Array) -> Array:
        """Return values of shape (N, ...) as (..., lanes): samples last, ones for what is no plan or none at all."""
        n = len(values)
        out = np.empty((*values.shape[1:], -(-n // LANES) * LANES), values.dtype)
        out[..., :n] = np.moveaxis(values, 0, -1)
        out[..., n:] = 1
        if not self.good.all():
            out[..., :n][..., ~self.good] = 1
        return out

    def back(self, lanes: Array) -> Array:
        """Return values of shape (..., lanes) as (N, ...), nan for what is no plan."""
        values = np.moveaxis(lanes[..., : len(self)], -1, 0)
        if not self.good.all():
            values[~self.good] = np.nan
        return values


def check_batch(
    problem: Problem,
    path: ArrayLike,
    rate: ArrayLike,
    tops: ArrayLike | None,
    start_tip: ArrayLike | None,
    *,
    dtype: str,
) -> PlanBatch:
    """Make a batch of what a caller gives.

    Raises:
        UsageError: A shape is wrong, or the heights of the obstacles are missing.
    """
    spec, n, obstacles = problem.trajectory, len(problem.robot.joints), len(problem.obstacle)
    if tops is None and obstacles:
        names = ", ".join(box.name for box in problem.obstacle)
        raise UsageError(
            f"tops is missing: the problem {problem.name!r} has obstacles ({names}), whose heights it gives"
        )
    with np.errstate(over="ignore"):
        control = _array("path", path, (None, spec.path_control_points, n), dtype)
        rates = _array("rate", rate, (len(control), spec.rate_control_points), dtype)
    heights = _array("tops", np.zeros((len(control), 0)) if tops is None else tops, (len(control), obstacles), dtype)
    tips = None if start_tip is None else _array("start_tip", start_tip, (len(control), 3), "float64")
    good = (rates > 0).all(axis=1)
    for array in (control, rates, heights, *([] if tips is None else [tips])):
        good &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    return PlanBatch(control, rates, heights, tips, np.asarray(good))


def _array(name: str, values: ArrayLike, shape: tuple[int | None, ...], dtype: str) -> Array:
    """Cast, or raise UsageError for another shape; None is any length."""
    try:
        array = np.asarray(values, dtype)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name} must be an array of numbers, got {type(values).__name__}: {error}") from error
    if array.ndim != len(shape) or any(want not in (None, have) for want, have in zip(shape, array.shape, strict=True)):
        expected = ", ".join("N" if size is None else str(size) for size in shape)
        raise UsageError(f"{name} must have shape ({expected}), got {array.shape}")
    return array
