"""Checks and broadcasting of boundary conditions that a user passes: one motion or many, zero terms omitted."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError
from cnpgen.schema.arguments import check_memory_of_rows, numbers
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]


def boundary_of(  # noqa: PLR0917 - in the order of the paper
    n: int,
    start_q: ArrayLike,
    start_dq: ArrayLike | None,
    start_ddq: ArrayLike | None,
    goal_q: ArrayLike,
    goal_dq: ArrayLike | None,
    goal_ddq: ArrayLike | None = None,
    parameters: ArrayLike | None = None,
) -> Boundary:
    """Check boundary conditions and bring them to shape (N, n).

    Positions [rad], velocities [rad/s] and accelerations [rad/s^2] of n joints have shape (n,) or (N, n), parameters
    (width,) or (N, width). Derivatives that are None are zero, at the goal's acceleration free.

    Raises:
        UsageError: A shape is wrong, or a value is not finite.
    """
    arguments = {
        "start_q": start_q,
        "start_dq": start_dq,
        "start_ddq": start_ddq,
        "goal_q": goal_q,
        "goal_dq": goal_dq,
        "goal_ddq": goal_ddq,
    }
    arrays = {name: _rows(name, values, n) for name, values in arguments.items() if values is not None}
    if parameters is not None:
        values = numbers("parameters", parameters)
        arrays["parameters"] = _rows("parameters", values, values.shape[-1] if values.ndim else 0)
    rows = max(len(values) for values in arrays.values())
    for name, values in arrays.items():
        if len(values) not in {1, rows}:
            raise UsageError(f"has {len(values)} rows, another boundary condition has {rows}", argument=name)
    check_memory_of_rows({name: len(values) for name, values in arrays.items()}, 6 * n)
    if goal_ddq is None:
        del arguments["goal_ddq"]
    zero = np.zeros((1, n))
    return Boundary(**{name: _repeated(arrays.get(name, zero), rows) for name in {**arguments, **arrays}})


def _rows(name: str, values: ArrayLike, n: int) -> Array:
    array = numbers(name, values)
    if array.ndim not in {1, 2} or array.shape[-1] != n or n == 0:
        raise UsageError(f"must have shape ({n},) or (N, {n}), got {array.shape}", argument=name)
    rows = array.reshape(-1, n)
    if not math.isfinite(rows.sum()) and not np.isfinite(rows).all():
        row = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise UsageError(f"must be finite, got {rows[row]} in row {row}", argument=name)
    return rows


def _repeated(rows: Array, count: int) -> Array:
    return rows if len(rows) == count else np.repeat(rows, count, axis=0)
