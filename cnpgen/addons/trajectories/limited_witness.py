"""A smooth curve within the errors of all samples and within acceleration limits.

Where a motion changes its acceleration faster than the samples resolve, the smoothest
spline swings over the limit that the motion keeps (Gibbs). There the spline is
computed again: of all splines within the errors of the samples and within the limits at
many points, it has the smallest integral of the squared jerk (a quadratic program of
some spans). All other coefficients stay, so the curve keeps its derivatives.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.addons.trajectories.curve_family import CurveFamily
from cnpgen.addons.trajectories.interpolate import data_of, family_of_data
from cnpgen.addons.trajectories.sample_errors import SampleErrors
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.witness import (
    DEGREE,
    MIN_ERRORS,
    derivatives_of,
    fitted,
    is_within,
)
from cnpgen.arrays import Array, Indices

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

WINDOW_SPANS = 10  # on both sides of a violation
REFINED_SPANS = 3  # on both sides of a violation, with further knots
PARTS = 6  # of these spans between knots, times the size
POINTS_PER_INTERVAL = 8  # of knots, at which the limits hold
MAX_WINDOWS = 12  # of a joint
MAX_SIZE = 3  # of a window, in multiples of the numbers of spans
PROGRAM_TOLERANCE = 1e-9
SPLINE_REGULARIZATION = 1e-9  # of the curvature of the quadratic program
PROGRAM_LIMIT_SHARE = 1 - 1e-4  # of the limit, in the program: it holds at points
ERROR_SHARE = 0.999  # of the errors, for the rounding of the program


def limited_witness(
    trajectory: Trajectory, errors: SampleErrors, limit: Array
) -> CurveFamily | None:
    """Return a curve within the errors of all samples, whose accelerations are within limits [rad/s^2], shape (n,).

    None without a spline within the errors, with a jitter of the times, or if the
    program finds none.
    """
    from scipy.interpolate import BSpline

    smooth = None if errors.t else fitted(trajectory, errors, 0.0)
    if smooth is None or not np.isfinite(limit).all():
        return None
    allowed = np.maximum(errors.values, MIN_ERRORS)
    splines = []
    for joint, bound in enumerate(limit.tolist()):
        data = [values[:, joint] for values in data_of(trajectory)]
        spline = BSpline(smooth.t, smooth.c[:, joint], DEGREE)
        limited = _limited(spline, trajectory.t, data, allowed, bound)
        if limited is None:
            return None
        splines.append(limited)

    def at(t: Array) -> list[Array]:
        orders = zip(*(derivatives_of(spline, t) for spline in splines), strict=True)
        return [np.stack(columns, axis=1) for columns in orders]

    # The programs meet errors up to their tolerance, so all samples are compared again.
    if not is_within(at, trajectory, errors):
        return None
    # Between knots of any joint, every spline is one quintic. Its q, dq and ddq at both
    # ends determine it exactly.
    times = np.unique(np.concatenate([spline.t for spline in splines]))
    return family_of_data(times, at(times))


def _refined(spline: "BSpline", times: Array) -> "BSpline":
    """Return the same curve with further knots."""
    from scipy.interpolate import BSpline

    for time in times[~np.isin(times, spline.t)]:
        spline = spline.insert_knot(float(time))
    return BSpline(spline.t, spline.c[: len(spline.t) - DEGREE - 1], DEGREE)


def _points(spline: "BSpline", low: float, high: float) -> Array:
    """Return points between two times, several in every interval of knots."""
    inside = np.unique(spline.t[(spline.t >= low) & (spline.t <= high)])
    parts = np.arange(POINTS_PER_INTERVAL) / POINTS_PER_INTERVAL
    points = inside[:-1, None] + np.diff(inside)[:, None] * parts
    return np.append(points.ravel(), inside[-1])


def _limited(
    spline: "BSpline", t: Array, data: list[Array], allowed: Array, limit: float
) -> "BSpline | None":
    """Return the spline of one joint within the limit, or None."""
    for _ in range(MAX_WINDOWS):
        points = _points(spline, t[0], t[-1])
        excess = np.abs(spline(points, 2)) - limit
        # Each pass removes the worst excess; the window may leave others for the next
        # pass.
        if excess.max() <= 0:
            return spline
        sample = int(np.searchsorted(t, points[excess.argmax()]))
        found = None
        for size in range(1, MAX_SIZE + 1):
            # More knots and a longer part of the motion, if there is no solution.
            near = _around(t, sample, size * REFINED_SPANS)
            steps = np.diff(near)[:, None] * np.arange(1, PARTS * size) / (PARTS * size)
            spline = _refined(spline, (near[:-1, None] + steps).ravel())
            window = _around(t, sample, size * WINDOW_SPANS)
            chosen = np.isin(t, window)
            part = _Part(spline, window, [values[chosen] for values in data])
            found = part.smoothest(allowed, PROGRAM_LIMIT_SHARE * limit)
            if found is not None:
                break
        if found is None:
            return None
        spline = found
    return None


def _around(t: Array, sample: int, count: int) -> Array:
    """Return the times of a sample and of some on both sides."""
    return t[max(sample - count, 0) : sample + count + 1]


@dataclass(frozen=True, eq=False)
class _Part:
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

    def smoothest(self, allowed: Array, limit: float) -> "BSpline | None":
        """Return the spline with the smallest jerks that meets the errors and the limit, or None."""
        import daqp
        from scipy.interpolate import BSpline

        # The error of positions is the unit of the program, so its numbers are near
        # one.
        free = self.free
        unit = float(allowed[0])
        if not len(free):
            return None
        curvature, gradient = self._jerks(unit)
        rows, lower, upper = self._constraints(allowed, limit, unit)
        # The Hessian has largest entries of 1, to which the regularization refers.
        scale = float(np.abs(curvature).max())
        solution: tuple[Any, ...] = daqp.solve(
            curvature / scale + SPLINE_REGULARIZATION * np.eye(len(free)),
            gradient / scale,
            np.ascontiguousarray(rows),
            upper,
            lower,
            np.zeros(len(rows), np.intc),
            primal_tol=PROGRAM_TOLERANCE,
        )
        if solution[2] != 1:
            return None
        coefficients = self.spline.c.copy()
        # The program states changes in units, not the coefficients themselves.
        coefficients[free] += unit * np.array(solution[0])
        return BSpline(self.spline.t, coefficients, DEGREE)

    def _constraints(
        self, allowed: Array, limit: float, unit: float
    ) -> tuple[Array, Array, Array]:
        """Return rows and both bounds of the changes: errors at the samples, and the limit at the points."""
        points = _points(self.spline, self.t[0], self.t[-1])
        groups = [
            (self.t, order, values, ERROR_SHARE * allowed[order])
            for order, values in enumerate(self.data)
        ]
        groups.append((points, 2, np.zeros(len(points)), limit))
        rows = []
        lower = []
        upper = []
        for times, order, values, error in groups:
            # The variables are changes: bounds are differences from the present curve.
            now = self.spline(times, order)
            factor = self.span**order / unit
            rows.append(self.rows(times, order))
            lower.append((values - error - now) * factor)
            upper.append((values + error - now) * factor)
        return np.concatenate(rows), np.concatenate(lower), np.concatenate(upper)

    def _jerks(self, unit: float) -> tuple[Array, Array]:
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
