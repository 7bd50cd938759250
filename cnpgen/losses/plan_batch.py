"""Plans on their way into and out of the loss kernels: checked, cast, samples last, padded to whole vectors."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import count_numbers
from cnpgen.schema.arguments import numbers

Array = NDArray[Any]
BLOCK = 128  # plans at a time: their points stay in the cache
LANES = 16  # of the widest vectors


@dataclass(frozen=True)
class PlanBatch:
    """N plans and what the loss must know of their problems.

    Attributes:
        path: Path control points [rad], shape (N, C, n).
        rate: Rate control points [1/s], shape (N, R).
        tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers).
        start_tip: Positions of the tip at the start [m], shape (N, 3), float64, or None.
        good: Whether a plan is one: finite, with positive rate control points; shape (N,).
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
        UsageError: A shape is wrong, what says where the obstacles are is missing, or something is no real number.
    """
    given = {"path": (path, dtype), "rate": (rate, dtype), "tops": (tops, dtype), "start_tip": (start_tip, "float64")}
    found = {
        name: numbers(name, values, kind, differentiable=True)
        for name, (values, kind) in given.items()
        if values is not None
    }
    check_shapes(problem, {name: array.shape for name, array in found.items()})
    good = np.asarray((found["rate"] > 0).all(axis=1))
    for array in found.values():
        good &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    heights = found.get("tops", np.zeros((len(good), 0), dtype))
    return PlanBatch(found["path"], found["rate"], heights, found.get("start_tip"), good)


def check_shapes(problem: Problem, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse what cannot be plans of a problem by its shapes alone.

    Args:
        problem: The problem.
        shapes: Those of ``path``, ``rate`` and, where they are given, ``tops`` and ``start_tip``.

    Raises:
        UsageError: A shape is wrong, or what says where the obstacles are is missing.
    """
    spec, numbers = problem.trajectory, count_numbers(problem.obstacle)
    if numbers and "tops" not in shapes:
        names = ", ".join(box.name for box in problem.obstacle)
        raise UsageError(
            f"tops is missing: the problem {problem.name!r} has obstacles ({names}), and it says where they are:"
            " cnpgen.obstacle_tops"
        )
    count = next(iter(shapes["path"]), 0)
    tails = {
        "path": (spec.path_control_points, len(problem.robot.joints)),
        "rate": (spec.rate_control_points,),
        "tops": (numbers,),
        "start_tip": (3,),
    }
    for name, tail in tails.items():
        if name in shapes and shapes[name] != (count, *tail):
            expected = ", ".join(str(size) for size in ("N" if name == "path" else count, *tail))
            raise UsageError(f"{name} must have shape ({expected}), got {shapes[name]}")
