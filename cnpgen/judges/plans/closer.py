"""A closer look at contacts: where edges pass each other, the depth has a peak that may fall between two moments."""

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.course import course
from cnpgen.judges.plans.measure import measure_condition
from cnpgen.judges.plans.sampling import Samples
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.motion import Motion
from cnpgen.world.path import PathWorld

if TYPE_CHECKING:
    from cnpgen.world.state import World

Array = NDArray[np.float64]

FINER = 32  # moments between two samples: at 1 ms peaks hide up to 0.26 mm, so up to 10 um
MOST = 256  # intervals between samples that are looked into


def look_closer(problem: Problem, world: PathWorld, motion: Motion, samples: Samples, tops: Array) -> list[Margin]:
    """Measure object contacts between samples: around the deepest one in every obstacle, and wherever more may hide.

    All else that is measured is smooth, so that between two moments it is beyond both by the square of their distance.

    Args:
        problem: The problem.
        world: Its robot at the samples; it is moved.
        motion: One motion.
        samples: When and at which phase the robot was looked at.
        tops: Heights of the obstacles' upper faces [m], shape (obstacles,).

    Returns:
        The margins of the problem's object contacts, in order.
    """
    constraints = [constraint for constraint in problem.constraint if isinstance(constraint, ObjectContact)]
    if not constraints or not problem.obstacle:
        return []
    deepest_valid = -min(constraint.depth + constraint.tolerance for constraint in constraints)
    finer = _inside(samples, intervals(np.array(world.object_distances()), world.object_corners(), deepest_valid))
    start_tip, states = world.tip_position[:, 0].copy(), course(motion, finer.s)
    world.set_path(states.q, states.dq, states.ddq, tops)
    return [
        measure_condition(problem, constraint, condition, finer, start_tip=start_tip)
        for constraint in constraints
        for condition in constraint.measured(cast("World", world))
    ]


def intervals(distances: Array, corners: Array, limit: float) -> NDArray[np.intp]:
    """Choose the intervals between samples that are worth a closer look.

    They are those on both sides of the deepest sample in every obstacle and, unless that decides already, all those in
    which a distance could fall below the limit: no point of the object is further from where it was than it moves, so
    that between two samples the distance stays above half of (their sum less the furthest way of a corner).

    Args:
        distances: Signed distances from every obstacle, or lower bounds of them [m], shape (obstacles, K).
        corners: Corners of the object [m], shape (8, 3, K).
        limit: The smallest distance that is still called valid [m].

    Returns:
        Ascending indices k of intervals from sample k to sample k + 1; of more than ``MOST`` that could hide something,
        those that could hide most.
    """
    count = distances.shape[1] - 1
    deepest = np.argmin(distances, axis=1)
    chosen = np.unique(np.clip([deepest - 1, deepest], 0, count - 1))
    if not distances.min() >= limit:
        return chosen
    ways = np.sqrt(np.square(np.diff(corners, axis=2)).sum(axis=1)).max(axis=0)
    least = (distances[:, :-1] + distances[:, 1:] - ways).min(axis=0) / 2
    hiding = np.flatnonzero(least < limit)
    return np.union1d(chosen, hiding[np.argsort(least[hiding], kind="stable")[:MOST]])


def _inside(samples: Samples, chosen: NDArray[np.intp]) -> Samples:
    """Put moments into intervals between samples, their ends included."""
    ends = zip(samples.s[chosen], samples.s[chosen + 1], strict=True)
    s = np.unique(np.concatenate([np.linspace(low, high, FINER + 1) for low, high in ends]))
    return Samples(s, np.interp(s, samples.s, samples.t))


def keep_worse(margins: list[Margin], closer: list[Margin]) -> list[Margin]:
    """Put margins of a closer look in the place of those of the same conditions that are less severe."""
    left = list(closer)
    kept = []
    for margin in margins:
        same = next((other for other in left if (other.name, other.reason) == (margin.name, margin.reason)), None)
        if same is not None:
            left.remove(same)
        kept.append(margin if same is None or margin.severity >= same.severity else same)
    return kept
