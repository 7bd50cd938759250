"""Remaining trajectories of motions after a time, as motions of their own, with refined knots if necessary.

The remainder of a spline is a spline, but its knots are not uniform, as those of a
motion must be. It is therefore fitted by least squares, with exact ends and the same
duration. If few knots remain, the fit is exact to rounding; if many remain, each span
is divided into two or three.
"""

from functools import cache

import numpy as np

from cnpgen.arrays import Array
from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.spline import basis, chebyshev
from cnpgen.trajectory.spline_motion import Motion, scaled_to_duration
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

# Relative to the limits; smaller than the tolerances of problems.

MAX_ACCELERATION_ERROR = 1e-3
# Then accelerations of motions at their limits differ by at most 0.5 %.
MAX_SPAN_DIVISIONS = 3
COMPARISON_SAMPLES = 64  # times at which accelerations are compared


def remaining_trajectory(
    motion: Motion,
    t: Array,
    boundary: Boundary,
    *,
    spec: TrajectorySpec,
    acceleration_limit: Array,
) -> Motion:
    """Fit a motion to the remaining trajectory of each of N motions after a time [s], shape (N,), before their end.

    Boundary conditions are the states at these times and the goals. Acceleration limits
    [rad/s^2] have shape (n,). Ends and durations are exact. Each span of ``spec`` is
    divided into two or three if accelerations would otherwise differ by more than 0.1 %
    of the limits.
    """
    duration = motion.duration() - t
    times = duration[:, None] * np.linspace(0, 1, COMPARISON_SAMPLES)
    expected = motion.at_times(t[:, None] + times).ddq
    # The coarsest spline that is accurate enough, so that plans stay small.
    for spans in range(1, MAX_SPAN_DIVISIONS + 1):
        fitted = _fitted(motion, t, duration, boundary, finer(spec, spans))
        error = np.abs(fitted.at_times(times).ddq - expected) / acceleration_limit
        if error.max(initial=0.0) <= MAX_ACCELERATION_ERROR:
            break
    return fitted


def finer(spec: TrajectorySpec, spans: int) -> TrajectorySpec:
    """Return a spec whose spans are each divided into ``spans``."""
    path, rate = (
        spans * (points - spec.degree) + spec.degree
        for points in (spec.path_control_points, spec.rate_control_points)
    )
    return TrajectorySpec(
        degree=spec.degree, path_control_points=path, rate_control_points=rate
    )


def is_finer(spec: TrajectorySpec, than: TrajectorySpec) -> bool:
    """Return whether a spec has two or three spans for each span of another one."""
    return spec in {finer(than, spans) for spans in range(2, MAX_SPAN_DIVISIONS + 1)}


def with_fewer_knots(
    motion: Motion, boundary: Boundary, spec: TrajectorySpec
) -> Motion:
    """Fit motions with the control points of a coarser spec by least squares, with exact ends and durations."""
    duration = motion.duration()
    return _fitted(motion, np.zeros(len(duration)), duration, boundary, spec)


def with_finer_knots(motion: Motion, spec: TrajectorySpec) -> Motion:
    """Represent motions with the control points of a finer spec.

    The motions do not change.
    """
    if motion.spec == spec:
        return motion
    path = (
        _refinement(motion.path.shape[1], spec.path_control_points, spec.degree)
        @ motion.path
    )
    rate = (
        motion.rate
        @ _refinement(motion.rate.shape[1], spec.rate_control_points, spec.degree).T
    )
    return Motion(path, rate, motion.degree)


def _fitted(
    motion: Motion, t: Array, duration: Array, boundary: Boundary, spec: TrajectorySpec
) -> Motion:
    """Fit rate and path to a motion after times t at equal phases, and scale the rate to the duration."""
    n = motion.path.shape[2]
    free = slice(3, spec.path_control_points - boundary.fixed_at_goal)
    # Phases of the remainder from 0 to 1; at these, q and r are those of the motion.
    phases, rate_fit, path_basis, path_fit = _fits(spec, free.stop)
    first = motion.phase_at(t[:, None])
    states = motion.at(first + (1 - first) * phases)
    # ds'/dt = r / (1 - first), since the remainder's phase s' covers the rest of s.
    rate = scaled_to_duration(states.rate / (1 - first) @ rate_fit.T, duration, spec)
    path = assemble(boundary, np.zeros((len(rate), free.stop - 3, n)), rate, spec)
    # Interior control points by least squares on what the boundary points leave.
    path[:, free] = path_fit @ (states.q - path_basis @ path)
    return Motion(path, rate, spec.degree)


@cache
def _fits(spec: TrajectorySpec, end: int) -> tuple[Array, Array, Array, Array]:
    """Return phases, the pseudoinverse of the rate's basis, the path's basis, and that of its columns 3 to ``end``."""
    phases = chebyshev(4 * max(spec.path_control_points, spec.rate_control_points))
    rate, path = (
        basis(phases, points, spec.degree)
        for points in (spec.rate_control_points, spec.path_control_points)
    )
    return (
        phases,
        np.asarray(np.linalg.pinv(rate)),
        path,
        np.asarray(np.linalg.pinv(path[:, 3:end])),
    )


@cache
def _refinement(points: int, more: int, degree: int) -> Array:
    """Return the knot refinement matrix of splines with uniform knots, shape (more, points)."""
    # Exact: splines with uniform knots are contained in those with finer knots.
    phases = chebyshev(4 * more)
    matrix: Array = np.linalg.pinv(basis(phases, more, degree)) @ basis(
        phases, points, degree
    )
    return matrix
