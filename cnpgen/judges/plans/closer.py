"""A closer look at contacts: where edges pass each other, the depth has a peak that may fall between two moments.

No point of a body is further from where it was than the body has moved: between two moments the distance stays above
half of their distances' sum less the way of the point that moves furthest. Intervals in which more than is allowed
could hide are divided, and those among them again, until none is left.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.measure import Measured
from cnpgen.judges.plans.survey import Survey
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.world.path import PathWorld

Array = NDArray[np.float64]

FINER = 32  # parts of an interval: at 1 ms peaks hide up to 0.26 mm, so up to 10 um in a part
MOST = 256  # intervals that are divided at a time
LEVELS = 5  # of divisions: of 1 ms 0.03 ns are left
BOWED = 1.01  # times the straight line between two moments: no way is longer


def is_contact(constraint: Constraint) -> bool:
    """Whether a constraint is about distances of bodies, which have kinks where other points become the nearest."""
    return isinstance(constraint, ObjectContact | RobotClearance)


@dataclass(frozen=True)
class Intervals:
    """I intervals between moments, and how much room M pairs of bodies have at both of their ends.

    Attributes:
        s: Phases of both ends, shape (I, 2).
        room: Distances less the smallest that is called valid [m], shape (M, I, 2).
        ways: How far a point of the bodies moves at most from end to end [m], shape (I,).
    """

    s: Array
    room: Array
    ways: Array

    def deepest(self) -> NDArray[np.bool_]:
        """Find those on both sides of the deepest moment, shape (I,)."""
        return np.asarray((self.room <= self.room.min()).any(axis=(0, 2)))

    def hiding(self) -> NDArray[np.bool_]:
        """Find those in which more than is allowed could hide, where it is not exceeded anyway, shape (I,)."""
        if not self.room.min() >= 0:
            return np.zeros(len(self.s), bool)
        least = (self.room.sum(axis=2) - BOWED * self.ways).min(axis=0) / 2
        chosen = np.zeros(len(self.s), bool)
        chosen[np.argsort(least, kind="stable")[:MOST]] = True
        return np.asarray(chosen & (least < 0))


def look_closer(survey: Survey) -> Iterator[tuple[Measured, Margin]]:
    """Yield contacts, and their margins between samples: around the deepest one, and wherever more may hide.

    Args:
        survey: A motion whose world is at its samples; it is moved.
    """
    contacts = [each for each in survey.measured if is_contact(each.constraint)]
    begun = [_intervals(survey.world, survey.samples.s[None], each) for each in contacts]  # before the world is moved
    for each, intervals in zip(contacts, begun, strict=True):
        for s, found in _divisions(survey, intervals, each.constraint):
            yield each, survey.margin(found, s)


def _divisions(survey: Survey, intervals: Intervals, constraint: Constraint) -> Iterator[tuple[Array, Measured]]:
    """Yield phases in ever shorter intervals, and the contacts there."""
    chosen = intervals.deepest() | intervals.hiding()
    for _ in range(LEVELS):
        if not chosen.any():
            return
        low, high = intervals.s[chosen].T
        grid = np.linspace(low, high, FINER + 1, axis=1)
        survey.move(grid.ravel())
        (found,) = survey.measure(constraint, grid.ravel())
        yield grid.ravel(), found
        intervals = _intervals(survey.world, grid, found)
        chosen = intervals.hiding()


def _intervals(world: PathWorld, s: Array, contacts: Measured) -> Intervals:
    """Return the intervals between neighbours in rows of phases s, shape (rows, K), at all of which the world is."""
    room = contacts.g - (contacts.condition.lower - contacts.allowed)[:, None]
    points = world.object_corners() if isinstance(contacts.constraint, ObjectContact) else _ends(world)
    room, points = room.reshape(-1, *s.shape), points.reshape(-1, 3, *s.shape)
    ways = np.sqrt(np.square(np.diff(points, axis=3)).sum(axis=1)).max(axis=0)
    ends = [np.stack([values[..., :-1], values[..., 1:]], axis=-1) for values in (s, room)]
    return Intervals(ends[0].reshape(-1, 2), ends[1].reshape(len(room), -1, 2), ways.ravel())


def _ends(world: PathWorld) -> Array:
    """Return both ends of every segment of the arm [m], shape (P, 3, K)."""
    segments = world.segments()
    return segments.reshape(-1, *segments.shape[2:])
