"""Search with a time limit: a first valid plan in milliseconds, and better ones until the limit.

The first plan follows the path q(s) of the first trees that connect, fitted to a spline,
which rounds its corners. With the rate r = ds/dt the motion has

    dq/dt = q' r,    d2q/dt2 = q'' r^2 + q' r r'.

The limits v and a bound the rate by r_max(s) = min(v / |q'|, sqrt(a / |q''|)) where r' is
small. Each control point of the rate is the smallest r_max in its support, so that
r <= r_max (convex hull of B-splines). One factor then accounts for r'. Uniform time scaling
meets all other limits, and the independent verdict decides.
"""

import time
from collections.abc import Iterator

import numpy as np

from cnpgen.arrays import Array
from cnpgen.refine.initial_guesses import SAMPLES_PER_CONTROL_POINT
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.strategy import PlanChecker, RefinementSearch, refine_task
from cnpgen.refine.task import MAX_JUDGED_VIOLATION, Attempt, Outcome, RefinementTask
from cnpgen.trajectory.spline import basis, clamped_knots
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

# Of the control points of a rate: the largest to the smallest. At rest r_max is infinite.
MAX_RATE_RATIO = 4.0


@np.errstate(all="ignore")  # see ``refine_task``
def refine_task_within(
    refiner: Refiner, checker: PlanChecker, task: RefinementTask, seconds: float
) -> Attempt:
    """Plan, or refine the input plan, as ``refine_task`` does; after ``seconds`` [s] the first valid plan ends it.

    Without an input plan a first plan is searched before anything else.
    """
    end = time.perf_counter() + seconds
    first = (
        _first_valid(refiner, checker, task)
        if task.is_finite and task.at_rest and refiner.input_variables(task) is None
        else None
    )

    def is_over(valid: bool) -> bool:
        return (valid or first is not None) and time.perf_counter() >= end

    if first is not None and is_over(valid=True):
        return first.result(first.iterations)
    best = refine_task(refiner, checker, task, is_over)
    # The first plan is kept where the complete search finds none that is better.
    if first is None or (best.valid and best.cost <= first.cost):
        return best
    return first.result(best.iterations)


def _first_valid(
    refiner: Refiner, checker: PlanChecker, task: RefinementTask
) -> Attempt | None:
    """Return the first plan that the verdict accepts, or None."""
    search = RefinementSearch(refiner, checker, task)
    for attempt in first_plans(refiner, task):
        if attempt.violation <= MAX_JUDGED_VIOLATION:
            judged = search.judge(attempt)
            if judged.valid:
                return judged
    return None


def first_plans(refiner: Refiner, task: RefinementTask) -> Iterator[Attempt]:
    """Yield motions from rest to rest whose solver made no step: along tree paths, or else from initial guesses."""
    motion = refiner.check.transcription(task)
    for guess in _guesses(refiner, task):
        path, rate = motion.unpack(guess)
        velocity = refiner.robot.velocity_limit
        acceleration = refiner.robot.acceleration_limit
        fast = fast_rate(path, velocity, acceleration, refiner.spec)
        x = motion.pack(path, fast if np.isfinite(fast).all() else rate)
        yield refiner.measured(task, x, Outcome.RESTARTED, unlimited=True)


def _guesses(refiner: Refiner, task: RefinementTask) -> Iterator[Array]:
    """Yield variables of motions whose paths may be valid."""
    if not refiner.measures_hulls:
        yield refiner.line_guess(task)
        yield from refiner.other_guesses(task)
        return
    for states in refiner.tree_search(task).first_paths():
        yield refiner.path_guess(task, states)


@np.errstate(divide="ignore", invalid="ignore")
def fast_rate(
    path: Array, velocity: Array, acceleration: Array, spec: TrajectorySpec
) -> Array:
    """Return a rate within the limits of joints, control points [1/s], shape (R,); not finite for a path without length.

    Path control points [rad] have shape (C, n), limits of velocities [rad/s] and
    accelerations [rad/s^2] shape (n,).
    """
    count = spec.rate_control_points
    degree = spec.degree
    s = np.linspace(0, 1, SAMPLES_PER_CONTROL_POINT * spec.path_control_points)
    slope, curvature = (basis(s, len(path), degree, order) @ path for order in (1, 2))
    # |p' r| <= v and |p'' r^2| <= a give r <= v / |p'| and r <= sqrt(a / |p''|).
    largest = np.minimum(
        (velocity / np.abs(slope)).min(axis=1),
        np.sqrt((acceleration / np.abs(curvature)).min(axis=1)),
    )
    knots = clamped_knots(count, degree)
    # Supports are longer than the distance of two samples.
    control = np.array(
        [
            largest[(s >= low) & (s <= high)].min()
            for low, high in zip(knots[:count], knots[degree + 1 :], strict=True)
        ]
    )
    # Large ratios of control points make r', and with it p' r r', large.
    control = np.minimum(control, MAX_RATE_RATIO * control.min())
    rate, change = (basis(s, count, degree, order) @ control for order in (0, 1))
    speed = slope * rate[:, None]
    bend = curvature * rate[:, None] ** 2
    strength = np.abs(bend + slope * (rate * change)[:, None]) / acceleration
    # r / f has f times smaller velocities and f^2 times smaller accelerations.
    # The largest excess of both kinds, so that all limits hold at the samples.
    factor = max((np.abs(speed) / velocity).max(), np.sqrt(strength.max()))
    return np.asarray(control / factor)
