"""Boundary conditions, the control points that meet them exactly (paper, Appendix A), and their derivatives.

Rate control points [1/s], shape (N, R), are positive. Functions raise ``UsageError`` if
boundary conditions have different numbers of joints, or the spline has less than degree
+ 2 control points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.schema.arguments import check_memory_of_rows, integer, numbers
from cnpgen.schema.unchecked import unchecked
from cnpgen.trajectory.spline import EndDerivatives, end_derivatives
from cnpgen.trajectory.trajectory_spec import TrajectorySpec


class Scaling(Protocol):
    """Normalization of a dataset, as far as it is needed here."""

    def denormalize(self, rows: Mapping[str, Any]) -> Mapping[str, Any]:
        """Convert normalized rows to SI units."""
        ...


class Missing(Enum):
    """A missing argument, where None is a valid value."""

    MISSING = "missing"


MISSING = Missing.MISSING


OPTIONAL = ("goal_ddq", "parameters")  # fields that may be None


class MotionIndexError(UsageError, IndexError):
    """Index of a motion that does not exist."""


@dataclass(frozen=True)
class Boundary:
    """Boundary conditions of N motions of n joints.

    Attributes:
        start_q: Start positions [rad], shape (N, n).
        start_dq: Start velocities [rad/s].
        start_ddq: Start accelerations [rad/s^2].
        goal_q: Goal positions [rad].
        goal_dq: Goal velocities [rad/s].
        goal_ddq: Goal accelerations [rad/s^2], or None where they are free.
        parameters: Parameters of the problem that differ from motion to motion, shape
            (N, width), or None.
    """

    start_q: Array
    start_dq: Array
    start_ddq: Array
    goal_q: Array
    goal_dq: Array
    goal_ddq: Array | None = None
    parameters: Array | None = None

    @classmethod
    def from_batch(
        cls, batch: Mapping[str, Any], normalization: Scaling | Missing | None = MISSING
    ) -> Boundary:
        """Read the boundary conditions from a batch of rows, in SI units; ignore its other fields.

        Args:
            batch: Field name -> values, shape (N, n): a batch or another mapping of
                arrays or tensors.
            normalization: Normalization of the rows, or None for rows in SI units. It
                may be omitted for batches of a dataset, which hold it; other mappings
                need it.

        Raises:
            UsageError: A boundary condition is missing in the fields, or the
                normalization is unknown.
        """
        scaling = (
            getattr(batch, "normalization", MISSING)
            if normalization is MISSING
            else normalization
        )
        if isinstance(scaling, Missing):
            kind = type(batch).__name__
            raise UsageError(
                f"a {kind} needs {{normalization}}, which is dataset.normalization, or None for SI units",
                remedies={"normalization": None},
            )
        if not hasattr(batch, "keys"):
            raise UsageError(
                f"must be a batch or a mapping, got {type(batch).__name__}",
                argument="batch",
            )
        if scaling is not None and not hasattr(scaling, "denormalize"):
            got = type(scaling).__name__
            raise UsageError(
                f"must be dataset.normalization, or None for SI units, got {got}",
                argument="normalization",
            )
        names = [entry.name for entry in fields(cls)]
        missing = [name for name in names if name not in batch and name not in OPTIONAL]
        if missing:
            present = ", ".join(map(str, batch))
            text = f"the batch lacks {', '.join(missing)}: it has the fields {present:.200}"
            raise UsageError(text, concerns="batch")
        rows = {name: batch[name] for name in names if name in batch}
        return cls(**(rows if scaling is None else scaling.denormalize(rows)))

    def __repr__(self) -> str:
        return f"<Boundary of shape {np.shape(self.start_q)}>"

    @property
    def fixed_at_goal(self) -> int:
        """Number of path control points that the goal determines (the paper's N_d)."""
        return 2 if self.goal_ddq is None else 3

    def min_control_points(self, degree: int) -> int:
        """Return the minimum number of path control points of a spline of this degree that meets these conditions."""
        integer("degree", degree, least=1)
        return max(degree + 2, 3 + self.fixed_at_goal)

    def conditions(self) -> dict[str, Array]:
        """Return the boundary conditions that are not None: name -> values."""
        return {
            name: values
            for name, values in vars(self).items()
            if values is not None and name != "parameters"
        }

    def arrays(self) -> dict[str, Array]:
        """Return the boundary conditions and the parameters that are not None: name -> values."""
        return {
            name: values for name, values in vars(self).items() if values is not None
        }

    def astype(self, dtype: str) -> Boundary:
        """Return the boundary conditions in another float type."""
        return Boundary(
            **{
                name: np.asarray(values, dtype)
                for name, values in self.arrays().items()
            }
        )

    def __len__(self) -> int:
        return len(self.start_q)

    def __getitem__(self, index: slice | NDArray[Any]) -> Boundary:
        try:
            return Boundary(
                **{name: values[index] for name, values in self.arrays().items()}
            )
        except (IndexError, TypeError, ValueError) as error:
            raise MotionIndexError(
                f"motions are selected by a slice, numbers or a mask: {error}",
                concerns="index",
            ) from error


def join_boundaries(parts: Sequence[Boundary]) -> Boundary:
    """Return the boundary conditions of the motions of all parts, which have the same conditions."""
    arrays = [part.arrays() for part in parts]
    return Boundary(
        **{name: np.concatenate([part[name] for part in arrays]) for name in arrays[0]}
    )


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

    Positions [rad], velocities [rad/s] and accelerations [rad/s^2] of n joints have
    shape (n,) or (N, n), parameters (width,) or (N, width). Derivatives that are None
    are zero, at the goal's acceleration free.

    Raises:
        UsageError: A position is None, a shape is wrong, or a value is not finite.
    """
    for name, position in (("start_q", start_q), ("goal_q", goal_q)):
        if position is None:
            raise UsageError("must be joint positions, got None", argument=name)
    conditions = start_q, start_dq, start_ddq, goal_q, goal_dq, goal_ddq
    if parameters is None and (one := _one_motion(n, conditions)) is not None:
        return one
    pairs = zip(fields(Boundary), conditions, strict=False)
    arguments = {entry.name: values for entry, values in pairs}
    # Missing derivatives are zero, a missing goal acceleration is free.
    arrays = {
        name: _rows(name, values, n)
        for name, values in arguments.items()
        if values is not None
    }
    if parameters is not None:
        arrays["parameters"] = _parameter_rows(parameters)
    # Conditions of one row are repeated for all motions.
    rows = max(len(values) for values in arrays.values())
    for name, values in arrays.items():
        if len(values) not in {1, rows}:
            text = f"has {len(values)} rows, another boundary condition has {rows}"
            raise UsageError(text, argument=name)
    check_memory_of_rows({name: len(values) for name, values in arrays.items()}, 6 * n)
    if goal_ddq is None:
        del arguments["goal_ddq"]
    zero = np.zeros((1, n))
    names = {**arguments, **arrays}
    return Boundary(**{name: _repeated(arrays.get(name, zero), rows) for name in names})


def _one_motion(n: int, conditions: Sequence[ArrayLike | None]) -> Boundary | None:
    """Return the conditions of one motion in a quarter of the time; None if they need the checks of ``boundary_of``."""
    # Missing derivatives are zero, a missing goal acceleration is free.
    free = () if conditions[-1] is not None else (None,)
    given = conditions[: len(conditions) - len(free)]
    zero, shape = np.zeros(n), (n,)
    parts = [zero if values is None else values for values in given]
    for values in parts:
        # The type of most arrays is this object; others are converted elsewhere.
        if (
            type(values) is not np.ndarray
            or values.dtype is not zero.dtype
            or values.shape != shape
        ):
            return None
    # One array for all conditions needs one check.
    numbers_of_all = np.concatenate(parts)
    if not math.isfinite(np.add.reduce(numbers_of_all)):
        return None
    rows = numbers_of_all.reshape(len(parts), 1, n)
    return unchecked(Boundary, *rows, *free, None)


def _rows(name: str, values: ArrayLike, n: int) -> Array:
    array = numbers(name, values)
    if array.ndim not in {1, 2} or array.shape[-1] != n or n == 0:
        raise UsageError(
            f"must have shape ({n},) or (N, {n}), got {array.shape}", argument=name
        )
    rows = array.reshape(-1, n)
    # The sum is finite if all values are, and takes less time than a mask of them.
    if not math.isfinite(rows.sum()) and not np.isfinite(rows).all():
        row = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise UsageError(f"must be finite, got {rows[row]} in row {row}", argument=name)
    return rows


def _parameter_rows(parameters: ArrayLike) -> Array:
    values = numbers("parameters", parameters)
    width = values.shape[-1] if values.ndim else 0
    return _rows("parameters", values, width)


def _repeated(rows: Array, count: int) -> Array:
    return rows if len(rows) == count else np.repeat(rows, count, axis=0)


def start_points(boundary: Boundary, rate: Array, spec: TrajectorySpec) -> Array:
    """Compute the first three path control points [rad], shape (N, 3, n)."""
    _check_joints(boundary)
    return _three(
        boundary.start_q,
        boundary.start_dq,
        boundary.start_ddq,
        rate[:, :1],
        rate[:, 1:2],
        spec=spec,
    )


def goal_points(boundary: Boundary, rate: Array, spec: TrajectorySpec) -> Array:
    """Compute the last path control points [rad], in path order, shape (N, 2, n).

    They are three if the goal's acceleration is prescribed.
    """
    _check_joints(boundary)
    # With reversed phase, r' and p' change sign: the goal is a start with -dq.
    if boundary.goal_ddq is None:
        path, _ = _end_derivatives(spec)
        before = boundary.goal_q - boundary.goal_dq / rate[:, -1:] / path.eta
        return np.concatenate([before[:, None], boundary.goal_q[:, None]], axis=1)
    points = _three(
        boundary.goal_q,
        -boundary.goal_dq,
        boundary.goal_ddq,
        rate[:, -1:],
        rate[:, -2:-1],
        spec=spec,
    )
    return points[:, ::-1]


def _check_joints(boundary: Boundary) -> None:
    """Raise an error if the conditions have different numbers of joints."""
    # Shapes would broadcast otherwise, and one joint would stand for all.
    joints = {
        name: np.shape(values)[-1:] for name, values in boundary.conditions().items()
    }
    if len(set(joints.values())) > 1:
        counts = ", ".join(
            f"{name} {n[0] if n else None}" for name, n in joints.items()
        )
        raise UsageError(
            f"boundary conditions must have the same number of joints, got: {counts}"
        )


def _end_derivatives(spec: TrajectorySpec) -> tuple[EndDerivatives, EndDerivatives]:
    """Return eta and beta of p and of r."""
    if spec.path_control_points < spec.degree + 2:
        # With a single span, the second derivative has another factor.
        raise UsageError(
            f"boundary accelerations need at least {spec.degree + 2} path control points of degree {spec.degree},"
            f" got {spec.path_control_points}"
        )
    path = end_derivatives(spec.path_control_points, spec.degree)
    return path, end_derivatives(spec.rate_control_points, spec.degree)


def _three(
    q: Array, dq: Array, ddq: Array, outer: Array, inner: Array, *, spec: TrajectorySpec
) -> Array:
    """Compute the control points at s = 0 from q, dq, ddq and the first two rate control points, shape (N, 1) each."""
    path, speed = _end_derivatives(spec)
    first, dr = dq / outer, speed.eta * (inner - outer)  # p'(0), r'(0)
    # p''(0), from ddq = p'' r^2 + p' r' r
    second = (ddq - first * dr * outer) / outer**2
    c1 = q + first / path.eta
    # From p'(0) = eta (c1 - c0) and p''(0) = beta (c2 - 3 c1 + 2 c0).
    c2 = second / path.beta - 2 * q + 3 * c1
    # np.stack takes as long as the computation
    points = np.empty((len(q), 3, q.shape[1]), c2.dtype)
    points[:, 0] = q
    points[:, 1] = c1
    points[:, 2] = c2
    return points


def assemble(
    boundary: Boundary, interior: Array, rate: Array, spec: TrajectorySpec
) -> Array:
    """Compute all path control points [rad], shape (N, C, n), from the interior ones, shape (N, C - 3 - N_d, n)."""
    return np.concatenate(
        [
            start_points(boundary, rate, spec),
            interior,
            goal_points(boundary, rate, spec),
        ],
        axis=1,
    )


def anchor_line(boundary: Boundary, rate: Array, spec: TrajectorySpec) -> Array:
    """Compute interior control points on the line from C_2 to C_{C - N_d} [rad], shape (N, C - 3 - N_d, n).

    It is that of the paper's equation of the configuration points.
    """
    first = start_points(boundary, rate, spec)[:, 2:3]
    last = goal_points(boundary, rate, spec)[:, :1]
    count = spec.path_control_points - 3 - boundary.fixed_at_goal
    along = np.linspace(0, 1, count)[:, None]
    return first * (1 - along) + last * along


@dataclass(frozen=True)
class BoundaryDerivative:
    """Derivative of one path control point with respect to one rate control point."""

    point: int  # index of the path control point, 0 to C - 1
    variable: int  # index of the rate control point, 0 to R - 1
    # d(path control point) / d(rate control point) [rad s], shape (N, n).
    derivative: Array


def boundary_derivatives(
    boundary: Boundary, rate: Array, spec: TrajectorySpec
) -> list[BoundaryDerivative]:
    """Differentiate ``start_points`` and ``goal_points`` in rate control points, (N, R); other derivatives are zero."""
    b = boundary
    last = spec.rate_control_points - 1
    points = spec.path_control_points
    c1, c2, c2_inner = _three_derivatives(
        b.start_dq, b.start_ddq, rate[:, :1], rate[:, 1:2], spec
    )
    # The outermost point is q itself; the next depends on r0, and the third on r0 and
    # r1.
    derivatives = [
        BoundaryDerivative(1, 0, c1),
        BoundaryDerivative(2, 0, c2),
        BoundaryDerivative(2, 1, c2_inner),
    ]
    if b.goal_ddq is None:
        return [
            *derivatives,
            BoundaryDerivative(
                points - 2, last, _first_derivative(-b.goal_dq, rate[:, -1:], spec)
            ),
        ]
    c1, c2, c2_inner = _three_derivatives(
        -b.goal_dq, b.goal_ddq, rate[:, -1:], rate[:, -2:-1], spec
    )
    derivatives += [
        BoundaryDerivative(points - 2, last, c1),
        BoundaryDerivative(points - 3, last, c2),
    ]
    return [*derivatives, BoundaryDerivative(points - 3, last - 1, c2_inner)]


def _first_derivative(dq: Array, outer: Array, spec: TrajectorySpec) -> Array:
    """Return dc1/dr0 at the end where the path has velocity dq, with ``c1 = q + p' / eta`` and ``p' = dq / r0``."""
    return np.asarray(
        -dq / (outer**2 * end_derivatives(spec.path_control_points, spec.degree).eta)
    )


def _three_derivatives(
    dq: Array, ddq: Array, outer: Array, inner: Array, spec: TrajectorySpec
) -> tuple[Array, Array, Array]:
    """Return dc1/dr0, dc2/dr0 and dc2/dr1 at an end of ``_three``, with ``r' = eta_r (r1 - r0)``."""
    path, speed = _end_derivatives(spec)
    c1 = _first_derivative(dq, outer, spec)
    # Derivative of p''(0) = (ddq - dq eta_r (r1 - r0)) / r0^2 with respect to r0.
    second = (
        -2 * (ddq - dq * speed.eta * (inner - outer)) / outer + dq * speed.eta
    ) / outer**2
    return c1, second / path.beta + 3 * c1, -dq * speed.eta / (outer**2 * path.beta)
