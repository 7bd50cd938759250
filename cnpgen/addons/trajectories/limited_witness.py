"""A smooth curve within the errors of all samples, and within acceleration and torque limits.

Where a motion changes its acceleration faster than the samples resolve, the smoothest
spline swings over the limit that the motion keeps (Gibbs). There the spline is
computed again: of all splines within the errors of the samples and within the limits at
many points, it has the smallest integral of the squared jerk (``window_program``). All
other coefficients stay, so the curve keeps its derivatives. Accelerations are limited
joint by joint, then torques, for all joints together.
"""

from typing import TYPE_CHECKING

import numpy as np

from cnpgen.addons.trajectories.curve_family import CurveFamily
from cnpgen.addons.trajectories.interpolate import data_of, family_of_data
from cnpgen.addons.trajectories.sample_errors import SampleErrors
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.window_program import (
    JointSplines,
    Limits,
    Part,
    TorqueBounds,
    refined,
    smoothest,
)
from cnpgen.addons.trajectories.witness import DEGREE, MIN_ERRORS, fitted, is_within
from cnpgen.arrays import Array

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

WINDOW_SPANS = 10  # on both sides of a violation
REFINED_SPANS = 3  # on both sides of a violation, with further knots
PARTS = 6  # of these spans between knots, times the size
MAX_WINDOWS = 12  # of a joint
MAX_SIZE = 3  # of a window, in multiples of the numbers of spans
MAX_COUPLED_EXCESS = 0.2  # relative; a larger one is that of the motion itself


def limited_witness(
    trajectory: Trajectory,
    errors: SampleErrors,
    limit: Array,
    torques: TorqueBounds | None = None,
) -> CurveFamily | None:
    """Return a curve within the errors of all samples, whose accelerations are within limits [rad/s^2], shape (n,).

    Its torques are within their limits if the program finds such a curve, too. None
    without a spline within the errors, with a jitter of the times, or if the program
    finds none.
    """
    from scipy.interpolate import BSpline

    smooth = None if errors.t else fitted(trajectory, errors, 0.0)
    if smooth is None or not np.isfinite(limit).all():
        return None
    allowed = np.maximum(errors.values, MIN_ERRORS)
    n = len(limit)
    data = [[values[:, joint] for values in data_of(trajectory)] for joint in range(n)]
    splines = []
    for joint in range(n):
        spline = BSpline(smooth.t, smooth.c[:, joint], DEGREE)
        limits = Limits(limit[joint : joint + 1])
        limited = _limited(
            [spline], trajectory.t, data[joint : joint + 1], allowed, limits
        )
        if limited is None:
            return None
        splines += limited
    if torques is not None:
        limits = Limits(limit, torques)
        splines = _limited(splines, trajectory.t, data, allowed, limits) or splines
    # The programs meet errors up to their tolerance, so all samples are compared again.
    joints = JointSplines(splines)
    if not is_within(joints.at, trajectory, errors):
        return None
    # Between knots of any joint, every spline is one quintic. Its q, dq and ddq at both
    # ends determine it exactly.
    times = np.unique(np.concatenate([spline.t for spline in splines]))
    return family_of_data(times, joints.at(times))


def _limited(
    splines: list["BSpline"],
    t: Array,
    data: list[list[Array]],
    allowed: Array,
    limits: Limits,
) -> "list[BSpline] | None":
    """Return the splines of some joints within the limits, or None."""
    for _ in range(MAX_WINDOWS):
        joints = JointSplines(splines)
        points = joints.points(t[0], t[-1])
        excess = limits.excess(joints.at(points))
        # Each pass removes the worst excess; the window may leave others for the next
        # pass.
        if excess.max() <= 0:
            return splines
        # The dense program of all joints takes seconds.
        if len(splines) > 1 and excess.max() > MAX_COUPLED_EXCESS:
            return None
        sample = int(np.searchsorted(t, points[excess.argmax()]))
        found = None
        for size in range(1, (MAX_SIZE if len(splines) == 1 else 1) + 1):
            # More knots and a longer part of the motion, if there is no solution.
            near = _around(t, sample, size * REFINED_SPANS)
            steps = np.diff(near)[:, None] * np.arange(1, PARTS * size) / (PARTS * size)
            times = (near[:-1, None] + steps).ravel()
            splines = [refined(spline, times) for spline in splines]
            window = _around(t, sample, size * WINDOW_SPANS)
            chosen = np.isin(t, window)
            parts = [
                Part(spline, window, [values[chosen] for values in columns])
                for spline, columns in zip(splines, data, strict=True)
            ]
            found = smoothest(parts, allowed, limits, (near[0], near[-1]))
            if found is not None:
                break
        if found is None:
            return None
        splines = found
    return None


def _around(t: Array, sample: int, count: int) -> Array:
    """Return the times of a sample and of some on both sides."""
    return t[max(sample - count, 0) : sample + count + 1]
