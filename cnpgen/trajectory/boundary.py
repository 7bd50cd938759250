"""Boundary control points: position, velocity and acceleration at the ends, exactly (paper, Appendix A)."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.trajectory.spec import TrajectorySpec
from cnpgen.trajectory.spline import EndDerivatives, end_derivatives

Array = NDArray[np.float64]


class Scaling(Protocol):
    """What rows were normalised with, as far as it is needed here."""

    def denormalize(self, rows: Mapping[str, Any]) -> Mapping[str, Any]:
        """Bring rows back into their units."""
        ...


class Unsaid(Enum):
    """An argument that was not given, where None means something."""

    UNSAID = "not said"


UNSAID = Unsaid.UNSAID


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
    """

    start_q: Array
    start_dq: Array
    start_ddq: Array
    goal_q: Array
    goal_dq: Array
    goal_ddq: Array | None = None

    @classmethod
    def from_batch(cls, batch: Mapping[str, Any], normalization: Scaling | Unsaid | None = UNSAID) -> "Boundary":
        """Take the boundary conditions out of a batch of rows, in their units, whatever else is in it.

        Args:
            batch: Field name -> values, shape (N, n): a batch, rows, or any mapping; arrays, or tensors.
            normalization: What the rows were normalised with; None for rows in their units. Batches of a dataset know
                it themselves, of other mappings it must be said.

        Raises:
            UsageError: A boundary condition is not among the fields, or it is not known how they were normalised.
        """
        scaling = getattr(batch, "normalization", UNSAID) if normalization is UNSAID else normalization
        if isinstance(scaling, Unsaid):
            kind = type(batch).__name__
            raise UsageError(f"normalization= must be said of a {kind}: dataset.normalization, or None for SI units")
        names = [each.name for each in fields(cls)]
        missing = [name for name in names if name not in batch and name != "goal_ddq"]
        if missing:
            raise UsageError(f"the batch lacks {', '.join(missing)}: it has the fields {', '.join(map(str, batch))}")
        rows = {name: batch[name] for name in names if name in batch}
        return cls(**(rows if scaling is None else scaling.denormalize(rows)))

    def __repr__(self) -> str:
        return f"<Boundary of shape {np.shape(self.start_q)}>"

    @property
    def fixed_at_goal(self) -> int:
        """Number of path control points that the goal fixes (the paper's N_d)."""
        return 2 if self.goal_ddq is None else 3

    def fewest_points(self, degree: int) -> int:
        """Return how many path control points a spline of a degree needs at least to meet these conditions."""
        return max(degree + 2, 3 + self.fixed_at_goal)

    def given(self) -> dict[str, Array]:
        """Return the boundary conditions that there are: name -> values."""
        return {name: values for name, values in vars(self).items() if values is not None}

    def __len__(self) -> int:
        return len(self.start_q)

    def __getitem__(self, index: slice | NDArray[Any]) -> "Boundary":
        return Boundary(
            self.start_q[index],
            self.start_dq[index],
            self.start_ddq[index],
            self.goal_q[index],
            self.goal_dq[index],
            None if self.goal_ddq is None else self.goal_ddq[index],
        )


def start_points(boundary: Boundary, rate: Array, spec: TrajectorySpec) -> Array:
    """First three path control points.

    Args:
        boundary: Boundary conditions.
        rate: Rate control points [1/s], shape (N, R), positive.
        spec: Degree and numbers of control points.

    Returns:
        Shape (N, 3, n), in rad.

    Raises:
        UsageError: Boundary conditions of different numbers of joints are mixed.
    """
    _check_joints(boundary)
    path, speed = _end_derivatives(spec)
    slope = speed.eta * (rate[:, 1:2] - rate[:, :1])
    return _three(boundary.start_q, boundary.start_dq, boundary.start_ddq, rate[:, :1], slope=slope, path=path)


def goal_points(boundary: Boundary, rate: Array, spec: TrajectorySpec) -> Array:
    """Last two path control points, or three where the goal's acceleration is given, in the order of the path.

    Args:
        boundary: Boundary conditions.
        rate: Rate control points [1/s], shape (N, R), positive.
        spec: Degree and numbers of control points.

    Returns:
        Shape (N, 2 or 3, n), in rad.

    Raises:
        UsageError: Boundary conditions of different numbers of joints are mixed.
    """
    _check_joints(boundary)
    path, speed = _end_derivatives(spec)
    # Reversed in phase, r' and p' change sign: the goal is a start with -dq.
    if boundary.goal_ddq is None:
        before = boundary.goal_q - boundary.goal_dq / rate[:, -1:] / path.eta
        return np.concatenate([before[:, None], boundary.goal_q[:, None]], axis=1)
    slope = speed.eta * (rate[:, -2:-1] - rate[:, -1:])
    points = _three(boundary.goal_q, -boundary.goal_dq, boundary.goal_ddq, rate[:, -1:], slope=slope, path=path)
    return points[:, ::-1]


def _check_joints(boundary: Boundary) -> None:
    """Refuse conditions that are of different robots, before NumPy does in its own words."""
    joints = {name: np.shape(values)[-1:] for name, values in vars(boundary).items() if values is not None}
    if len(set(joints.values())) > 1:
        found = ", ".join(f"{name} {n[0] if n else None}" for name, n in joints.items())
        raise UsageError(f"boundary conditions must all be of the same joints, got of each: {found}")


def _end_derivatives(spec: TrajectorySpec) -> tuple[EndDerivatives, EndDerivatives]:
    """Return eta and beta of p and of r."""
    if spec.path_control_points < spec.degree + 2:  # a single span, whose second derivative is another
        raise UsageError(
            f"boundary accelerations need at least {spec.degree + 2} path control points of degree {spec.degree},"
            f" got {spec.path_control_points}"
        )
    path = end_derivatives(spec.path_control_points, spec.degree)
    return path, end_derivatives(spec.rate_control_points, spec.degree)


def _three(q: Array, dq: Array, ddq: Array, rate: Array, *, slope: Array, path: EndDerivatives) -> Array:
    """Control points at s = 0 from q, dq, ddq, r(0) and r'(0)."""
    eta, beta = path.eta, path.beta
    first = dq / rate  # p'(0)
    second = (ddq - first * slope * rate) / rate**2  # p''(0), from ddq = p'' r^2 + p' r' r
    c1 = q + first / eta
    c2 = second / beta - 2 * q + 3 * c1
    points = np.empty((len(q), 3, q.shape[1]), c2.dtype)  # np.stack takes as long as all that came before
    points[:, 0], points[:, 1], points[:, 2] = q, c1, c2
    return points


def assemble(boundary: Boundary, interior: Array, rate: Array, spec: TrajectorySpec) -> Array:
    """Path control points from the interior ones.

    Args:
        boundary: Boundary conditions.
        interior: Interior path control points [rad], shape (N, C - 3 - N_d, n).
        rate: Rate control points [1/s], shape (N, R), positive.
        spec: Degree and numbers of control points.

    Returns:
        Shape (N, C, n), in rad.

    Raises:
        UsageError: Boundary conditions of different numbers of joints are mixed, or C is below degree + 2.
    """
    return np.concatenate([start_points(boundary, rate, spec), interior, goal_points(boundary, rate, spec)], axis=1)


def anchor_line(boundary: Boundary, rate: Array, spec: TrajectorySpec) -> Array:
    """Interior control points on the line from C_2 to C_{C - N_d} (paper, eq. of the configuration points).

    Args:
        boundary: Boundary conditions.
        rate: Rate control points [1/s], shape (N, R), positive.
        spec: Degree and numbers of control points.

    Returns:
        Shape (N, C - 3 - N_d, n), in rad.

    Raises:
        UsageError: As of ``assemble``.
    """
    first, last = start_points(boundary, rate, spec)[:, 2:3], goal_points(boundary, rate, spec)[:, :1]
    count = spec.path_control_points - 3 - boundary.fixed_at_goal
    along = np.linspace(0, 1, count)[:, None]
    return first * (1 - along) + last * along
