"""What is left of motions after a moment, as motions of their own, with finer knots where that takes them.

The rest of a spline is a spline, but not one whose knots are evenly spaced, as those of motions are. So it is written
anew, by least squares, with exact ends and the same duration. Where few knots are left that is exact to rounding; where
many are, two or three spans take the place of one.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.motion import Motion, lasting
from cnpgen.trajectory.spec import TrajectorySpec
from cnpgen.trajectory.spline import basis, chebyshev

Array = NDArray[np.float64]

FAITHFUL = 1e-3  # of the acceleration limits: what accelerations may differ by; tolerances of problems are larger
MOST_SPANS = 3  # spans in the place of one; then accelerations of motions at their limits differ by 0.5 % at most
LOOKS = 64  # moments at which accelerations are compared


def rest_of(motion: Motion, t: Array, boundary: Boundary, *, spec: TrajectorySpec, acceleration_limit: Array) -> Motion:
    """Write what is left of each of N motions after a time as a motion.

    Args:
        motion: N motions.
        t: Since their start [s], shape (N,), before their end.
        boundary: The states at that time, and the motions' own goals.
        spec: Degree and numbers of control points that the rests should have.
        acceleration_limit: Limits of the joints [rad/s^2], shape (n,).

    Returns:
        N motions, with exact ends and durations, of as many control points as ``spec`` says; with two or three spans
        for each of its spans where accelerations would otherwise differ by more than 0.1 % of the limits.
    """
    left = motion.duration() - t
    moments = left[:, None] * np.linspace(0, 1, LOOKS)
    wanted = motion.at_times(t[:, None] + moments).ddq
    for spans in range(1, MOST_SPANS + 1):
        found = _written(motion, t, left, boundary, finer(spec, spans))
        off = np.abs(found.at_times(moments).ddq - wanted) / acceleration_limit
        if off.max(initial=0.0) <= FAITHFUL:
            break
    return found


def finer(spec: TrajectorySpec, spans: int) -> TrajectorySpec:
    """Return a spec with so many spans in the place of each."""
    path, rate = (
        spans * (points - spec.degree) + spec.degree for points in (spec.path_control_points, spec.rate_control_points)
    )
    return TrajectorySpec(degree=spec.degree, path_control_points=path, rate_control_points=rate)


def is_finer(spec: TrajectorySpec, than: TrajectorySpec) -> bool:
    """Whether a spec has two or three spans in the place of each of another one."""
    return spec in {finer(than, spans) for spans in range(2, MOST_SPANS + 1)}


def with_fewer_knots(motion: Motion, boundary: Boundary, spec: TrajectorySpec) -> Motion:
    """Write motions with the control points of a coarser spec, by least squares, with exact ends and durations."""
    left = motion.duration()
    return _written(motion, np.zeros(len(left)), left, boundary, spec)


def with_finer_knots(motion: Motion, spec: TrajectorySpec) -> Motion:
    """Write motions with the control points of a finer spec: they stay the same."""
    if motion.spec == spec:
        return motion
    path = _refinement(motion.path.shape[1], spec.path_control_points, spec.degree) @ motion.path
    rate = motion.rate @ _refinement(motion.rate.shape[1], spec.rate_control_points, spec.degree).T
    return Motion(path, rate, motion.degree)


def _written(motion: Motion, t: Array, left: Array, boundary: Boundary, spec: TrajectorySpec) -> Motion:
    """Fit rate and path at equal phases, then scale the rate to the duration."""
    n, free = motion.path.shape[2], slice(3, spec.path_control_points - boundary.fixed_at_goal)
    phases, rate_fit, path_basis, path_fit = _fits(spec, free.stop)
    begun = motion.phase_at(t[:, None])
    states = motion.at(begun + (1 - begun) * phases)
    rate = lasting(states.rate / (1 - begun) @ rate_fit.T, left, spec)
    path = assemble(boundary, np.zeros((len(rate), free.stop - 3, n)), rate, spec)
    path[:, free] = path_fit @ (states.q - path_basis @ path)
    return Motion(path, rate, spec.degree)


@cache
def _fits(spec: TrajectorySpec, end: int) -> tuple[Array, Array, Array, Array]:
    """Return phases, what fits rates there, the path's basis, and what fits its control points from 3 to ``end``."""
    phases = chebyshev(4 * max(spec.path_control_points, spec.rate_control_points))
    rate, path = (basis(phases, points, spec.degree) for points in (spec.rate_control_points, spec.path_control_points))
    return phases, np.asarray(np.linalg.pinv(rate)), path, np.asarray(np.linalg.pinv(path[:, 3:end]))


@cache
def _refinement(points: int, more: int, degree: int) -> Array:
    """Return the matrix that writes splines of evenly spaced knots with more of them, shape (more, points)."""
    phases = chebyshev(4 * more)
    found: Array = np.linalg.pinv(basis(phases, more, degree)) @ basis(phases, points, degree)
    return found
