"""Quadratic program of some spans of splines: the smallest jerks within errors of samples and within limits.

Torques couple the joints, so one program may have the splines of several joints. The
errors of positions and velocities hardly change torques, which are affine in the
accelerations: tau = M(q) ddq + n(q, dq).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.addons.trajectories.refuted_torques import Torques
from cnpgen.addons.trajectories.witness import DEGREE
from cnpgen.arrays import Array, Indices

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

POINTS_PER_INTERVAL = 8  # of knots, at which the limits hold
PROGRAM_TOLERANCE = 1e-9
SPLINE_REGULARIZATION = 1e-9  # of the curvature of the quadratic program
NEAR_LIMIT = 0.7  # share of a limit, above which the program has it
PROGRAM_LIMIT_SHARE = 1 - 1e-4  # of the limit, in the program: it holds at points
ERROR_SHARE = 0.999  # of the errors, for the rounding of the program


def refined(spline: "BSpline", times: Array) -> "BSpline":
    """Return the same curve with further knots."""
    from scipy.interpolate import BSpline

    for time in times[~np.isin(times, spline.t)]:
        spline = spline.insert_knot(float(time))
    return BSpline(spline.t, spline.c[: len(spline.t) - DEGREE - 1], DEGREE)


@dataclass(frozen=True, eq=False)
class JointSplines:
    """Splines of m joints with different knots."""

    splines: Sequence["BSpline"]

    def at(self, t: Array) -> list[Array]:
        """Return positions, velocities and accelerations, shape (K, m) each."""
        return [
            np.stack([spline(t, order) for spline in self.splines], axis=1)
            for order in range(3)
        ]

    def points(self, low: float, high: float) -> Array:
        """Return points between two times, several in every interval of knots."""
        knots = np.concatenate([spline.t for spline in self.splines])
        inside = np.unique(knots[(knots >= low) & (knots <= high)])
        parts = np.arange(POINTS_PER_INTERVAL) / POINTS_PER_INTERVAL
        points = inside[:-1, None] + np.diff(inside)[:, None] * parts
        return np.append(points.ravel(), inside[-1])


@dataclass(frozen=True, eq=False)
class TorqueBounds:
    """Inverse dynamics, and the largest absolute torques [N m], shape (n,)."""

    torques: Torques
    limit: Array


@dataclass(frozen=True, eq=False)
class Limits:
    """Largest absolute accelerations of m joints, shape (m,), and torques of all joints."""

    acceleration: Array
    torques: TorqueBounds | None = None

    def excess(self, states: list[Array]) -> Array:
        """Return the largest excess over a limit, relative to it, at K states, shape (K,)."""
        shares = np.abs(states[2]) / self.acceleration
        if self.torques is not None:
            q, dq, ddq = states
            tau = self.torques.torques(q, dq, ddq)
            shares = np.hstack([shares, np.abs(tau) / self.torques.limit])
        return np.asarray(shares.max(axis=1) - 1)

    def rows(self, states: list[Array]) -> list[tuple[Array, Array, Indices]]:
        """Return the limited quantities near their limits as affine functions of the accelerations at K states.

        Returns:
            Of every quantity: its values and its derivatives by the accelerations of m
            joints relative to the limit, shapes (C,) and (C, m), and the indices of the
            states, shape (C,).
        """
        q, dq, ddq = states
        unit = np.eye(ddq.shape[1])
        found = []
        quantities = [
            (ddq[:, joint] / limit, np.broadcast_to(unit[joint] / limit, ddq.shape))
            for joint, limit in enumerate(self.acceleration)
        ]
        if self.torques is not None:
            of, limit = self.torques.torques, self.torques.limit
            tau = of(q, dq, ddq)
            # Columns of the mass matrix: M e_j = tau(ddq + e_j) - tau(ddq).
            columns = [of(q, dq, ddq + each) - tau for each in unit]
            matrix = np.stack(columns, axis=2) / limit[:, None]
            quantities += [
                (tau[:, joint] / limit[joint], matrix[:, joint])
                for joint in range(len(limit))
            ]
        for values, derivatives in quantities:
            near = np.flatnonzero(np.abs(values) > NEAR_LIMIT)
            found.append((values[near], derivatives[near], near))
        return found


@dataclass(frozen=True, eq=False)
class Part:
    """Part of the spline of one joint between two samples, with the data at the samples in between."""

    spline: "BSpline"
    t: Array
    data: list[Array]

    @property
    def span(self) -> float:
        """Mean span [s], the unit of time of the program."""
        return float(np.diff(self.t).mean())

    @property
    def free(self) -> Indices:
        """Indices of the coefficients whose supports are between both ends."""
        knots = self.spline.t
        index = np.arange(len(self.spline.c))
        inside = (knots[index] >= self.t[0]) & (knots[index + DEGREE + 1] <= self.t[-1])
        return np.asarray(index[inside], np.intp)

    def rows(self, times: Array, order: int) -> Array:
        """Return derivatives of the free basis functions, with a span as unit of time."""
        from scipy.interpolate import BSpline

        size = len(self.spline.c)
        basis = BSpline(self.spline.t, np.eye(size)[:, self.free], DEGREE)
        return np.asarray(basis(times, order) * self.span**order)

    def errors(self, allowed: Array, unit: float) -> tuple[Array, Array, Array]:
        """Return rows and both bounds of the changes of the coefficients for the errors at the samples."""
        rows = []
        lower = []
        upper = []
        for order, values in enumerate(self.data):
            # The variables are changes: bounds are differences from the present curve.
            now = self.spline(self.t, order)
            factor = self.span**order / unit
            # Near the ends of the window, samples keep errors that it cannot change.
            error = np.maximum(ERROR_SHARE * allowed[order], np.abs(values - now))
            rows.append(self.rows(self.t, order))
            lower.append((values - error - now) * factor)
            upper.append((values + error - now) * factor)
        return np.concatenate(rows), np.concatenate(lower), np.concatenate(upper)

    def changed(self, change: Array) -> "BSpline":
        """Return the spline with changed free coefficients."""
        from scipy.interpolate import BSpline

        coefficients = self.spline.c.copy()
        coefficients[self.free] += change
        return BSpline(self.spline.t, coefficients, DEGREE)

    def jerks(self, unit: float) -> tuple[Array, Array]:
        """Return curvature and gradient of half the integral of the squared jerk."""
        inner = np.unique(np.clip(self.spline.t, self.t[0], self.t[-1]))
        # Jerks are quadratic in every interval: exact with three nodes.
        nodes, weights = np.polynomial.legendre.leggauss(DEGREE - 2)
        spans = np.diff(inner)
        # Gauss nodes x in [-1, 1] map to t = a + h (x + 1) / 2, with weights h w / 2.
        times = (inner[:-1, None] + spans[:, None] * (nodes + 1) / 2).ravel()
        strength = (spans[:, None] / self.span * weights / 2).ravel()
        third = self.rows(times, 3)
        now = self.spline(times, 3) * self.span**3 / unit
        # With jerks j + R x, half the squared integral has the Hessian R^T W R and the
        # gradient R^T W j.
        return third.T @ (strength[:, None] * third), third.T @ (strength * now)


def smoothest(
    parts: list["Part"], allowed: Array, limits: Limits, core: tuple[float, float]
) -> "list[BSpline] | None":
    """Return the splines with the smallest jerks that meet the errors, and the limits between two times, or None."""
    import daqp
    from scipy.linalg import block_diag

    # The error of positions is the unit of the program, so its numbers are near one.
    unit = float(allowed[0])
    sizes = [len(part.free) for part in parts]
    if not all(sizes):
        return None
    jerks = [part.jerks(unit) for part in parts]
    curvature = block_diag(*(curvature for curvature, _ in jerks))
    gradient = np.concatenate([gradient for _, gradient in jerks])
    errors = [part.errors(allowed, unit) for part in parts]
    groups = [
        (
            block_diag(*(rows for rows, _, _ in errors)),
            np.concatenate([lower for _, lower, _ in errors]),
            np.concatenate([upper for _, _, upper in errors]),
        ),
        *_limit_rows(parts, limits, core, unit),
    ]
    rows, lower, upper = (np.concatenate(each) for each in zip(*groups, strict=True))
    # The Hessian has largest entries of 1, to which the regularization refers.
    scale = float(np.abs(curvature).max())
    solution: tuple[Any, ...] = daqp.solve(
        curvature / scale + SPLINE_REGULARIZATION * np.eye(len(gradient)),
        gradient / scale,
        np.ascontiguousarray(rows),
        upper,
        lower,
        np.zeros(len(rows), np.intc),
        primal_tol=PROGRAM_TOLERANCE,
    )
    if solution[2] != 1:
        return None
    changes = np.split(unit * np.array(solution[0]), np.cumsum(sizes)[:-1])
    return [part.changed(change) for part, change in zip(parts, changes, strict=True)]


def _limit_rows(
    parts: list["Part"], limits: Limits, core: tuple[float, float], unit: float
) -> list[tuple[Array, Array, Array]]:
    """Return rows and both bounds of the changes for the limits at many points.

    Outside of the core, where no coefficient or few ones are free, an excess may stay:
    it is the core of a later window.
    """
    joints = JointSplines([part.spline for part in parts])
    points = joints.points(parts[0].t[0], parts[0].t[-1])
    span = parts[0].span
    basis = [part.rows(points, 2) for part in parts]
    found = []
    for values, derivatives, near in limits.rows(joints.at(points)):
        # In the unit of the program, an acceleration of 1 is span^2 / unit. Divided by
        # it, the rows have coefficients of the size of the derivatives.
        weights = derivatives / np.abs(derivatives).max(axis=1, keepdims=True)
        factor = span**2 / unit / np.abs(derivatives).max(axis=1)
        rows = np.hstack([weights[:, [j]] * each[near] for j, each in enumerate(basis)])
        inside = (points[near] >= core[0]) & (points[near] <= core[1])
        present = np.where(inside, 0.0, np.abs(values))
        share = np.maximum(PROGRAM_LIMIT_SHARE, present)
        found.append((rows, (-share - values) * factor, (share - values) * factor))
    return found
