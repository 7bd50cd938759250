"""A closer look at contacts: where edges pass each other, the depth has a peak that may fall between two moments."""

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from cnpgen.constraints.clearance import ObjectContact
from cnpgen.recipes import Problem
from cnpgen.trajectory.motion import Motion
from cnpgen.verdict.course import course
from cnpgen.verdict.margins import measure_condition
from cnpgen.verdict.sampling import Samples
from cnpgen.verdict.verdict import Margin
from cnpgen.verify.path import PathWorld

if TYPE_CHECKING:
    from cnpgen.verify.world import World

Array = NDArray[np.float64]

FINER = 32  # moments between the deepest one and its neighbour: at 1 ms peaks hide up to 0.26 mm, so up to 3 um


def look_closer(problem: Problem, world: PathWorld, motion: Motion, samples: Samples, tops: Array) -> list[Margin]:
    """Measure object contacts between the deepest moment in every obstacle and those before and after it.

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
    finer = _between(samples, [int(np.argmin(distances)) for distances in world.object_distances()])
    states = course(motion, finer.s)
    world.set_path(states.q, states.dq, states.ddq, tops)
    return [
        measure_condition(problem, constraint, condition, world, finer)
        for constraint in constraints
        for condition in constraint.measured(cast("World", world))
    ]


def _between(samples: Samples, deepest: list[int]) -> Samples:
    """Choose moments from the one before to the one after each of some."""
    last = len(samples.s) - 1
    ends = [(samples.s[max(k - 1, 0)], samples.s[min(k + 1, last)]) for k in deepest]
    s = np.unique(np.concatenate([np.linspace(low, high, 2 * FINER + 1) for low, high in ends]))
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
