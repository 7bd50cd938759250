"""Batches of plans for the loss kernels: checked, cast, samples last, padded to whole vectors."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.arrays import AnyArray
from cnpgen.errors import UsageError
from cnpgen.problems.problem import Problem
from cnpgen.schema.arguments import numbers

PLANS_PER_BLOCK = 128  # their points fit into the cache
MAX_VECTOR_LANES = 16


@dataclass(frozen=True)
class PlanBatch:
    """N plans with their obstacle poses and start positions."""

    path: AnyArray  # path control points [rad], shape (N, C, n)
    rate: AnyArray  # rate control points [1/s], shape (N, R)
    obstacle_poses: AnyArray  # poses and sizes of the obstacles, shape (N, width)
    # Positions of the tip at the start [m], shape (N, 3), float64, or None.
    start_tip: AnyArray | None
    # Mask of the plans that are finite with positive rate control points, shape (N,).
    valid: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.rate)

    def __getitem__(self, rows: slice) -> "PlanBatch":
        start_tip = None if self.start_tip is None else self.start_tip[rows]
        return PlanBatch(
            self.path[rows],
            self.rate[rows],
            self.obstacle_poses[rows],
            start_tip,
            self.valid[rows],
        )

    def lanes(self, values: AnyArray) -> AnyArray:
        """Return values of shape (N, ...) as (..., lanes), with ones for invalid plans and padding."""
        n = len(values)
        # Whole vectors: kernels have no code for the remaining lanes then.
        out = np.empty(
            (*values.shape[1:], -(-n // MAX_VECTOR_LANES) * MAX_VECTOR_LANES),
            values.dtype,
        )
        out[..., :n] = np.moveaxis(values, 0, -1)
        # Ones are harmless in every operation of the kernels: no division by 0, no root of
        # a negative number that would slow the whole vector down.
        out[..., n:] = 1
        if not self.valid.all():
            out[..., :n][..., ~self.valid] = 1
        return out

    def samples(self, lanes: AnyArray) -> AnyArray:
        """Return values of shape (..., lanes) as (N, ...), with nan for invalid plans."""
        values = np.moveaxis(lanes[..., : len(self)], -1, 0)
        if not self.valid.all():
            values[~self.valid] = np.nan
        return values


def check_batch(
    problem: Problem,
    path: ArrayLike,
    rate: ArrayLike,
    obstacle_poses: ArrayLike | None,
    start_tip: ArrayLike | None,
    *,
    dtype: str,
) -> PlanBatch:
    """Check the caller's arguments and make a batch of them.

    Raises:
        UsageError: A shape is wrong, the obstacle poses are missing, or a value is not
            a real number.
    """
    arguments = {
        "path": (path, dtype),
        "rate": (rate, dtype),
        "obstacle_poses": (obstacle_poses, dtype),
        "start_tip": (start_tip, "float64"),
    }
    arrays = {
        name: numbers(name, values, kind, differentiable=True)  # type: ignore[arg-type]
        for name, (values, kind) in arguments.items()
        if values is not None or name in {"path", "rate"}
    }
    check_shapes(problem, {name: array.shape for name, array in arrays.items()})
    # Sufficient for r(s) > 0, since basis functions are not negative.
    valid = np.asarray((arrays["rate"] > 0).all(axis=1))
    for array in arrays.values():
        valid &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    poses = arrays.get("obstacle_poses", np.zeros((len(valid), 0), dtype))
    return PlanBatch(
        arrays["path"], arrays["rate"], poses, arrays.get("start_tip"), valid
    )


def check_shapes(problem: Problem, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Check the shapes of ``path``, ``rate`` and, if present, ``obstacle_poses`` and ``start_tip``.

    Raises:
        UsageError: A shape is wrong, or the obstacle poses are missing.
    """
    spec = problem.trajectory
    width = problem.scene_width
    if width and "obstacle_poses" not in shapes:
        names = ", ".join(box.name for box in problem.obstacle) or "a puck for each hit"
        raise UsageError(
            f"obstacle_poses is missing: the problem {problem.name!r} has obstacles ({names});"
            " the scene of plans and tasks has their poses and sizes, scene.poses",
            concerns="obstacle_poses",
        )
    count = next(iter(shapes["path"]), 0)
    tails = {
        "path": (spec.path_control_points, len(problem.robot.joints)),
        "rate": (spec.rate_control_points,),
        "obstacle_poses": (width,),
        "start_tip": (3,),
    }
    for name, tail in tails.items():
        if name in shapes and shapes[name] != (count, *tail):
            expected = ", ".join(
                str(size) for size in ("N" if name == "path" else count, *tail)
            )
            raise UsageError(
                f"must have shape ({expected}), got {shapes[name]}", argument=name
            )
