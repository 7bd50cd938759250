"""A closer look at contacts: where edges pass each other, the depth has a peak that may fall between two moments.

From one moment to the next a body stays within the hull of where it is at both, but for the bow of its points' ways
(``bow``). Intervals in which that is not far enough from the other body are divided, and those among them again, until
none is left.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.bow import bows
from cnpgen.judges.plans.measure import Measured
from cnpgen.judges.plans.survey import Survey
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.self_clearance import SelfClearance
from cnpgen.world.pairs import PairDistances
from cnpgen.world.path import PathWorld

Array = NDArray[np.float64]

FINER = 8  # parts of an interval
MOST = 256  # intervals that are divided at a time
LEVELS = 8  # of divisions: of 1 ms 0.06 ns are left
DEEPER = 2  # of them are made round the deepest moment, whatever it decides


def is_contact(constraint: Constraint) -> bool:
    """Whether a constraint is about distances of bodies, which have kinks where other points become the nearest."""
    return isinstance(constraint, ObjectContact | RobotClearance | SelfClearance)


@dataclass(frozen=True)
class Intervals:
    """I intervals between moments.

    Attributes:
        s: Phases of both ends, shape (I, 2).
        room: Smallest distance less what is called valid at both ends [m], shape (I, 2).
        least: How much of it is left for certain all the way between [m], shape (I,).
    """

    s: Array
    room: Array
    least: Array

    def deepest(self) -> NDArray[np.bool_]:
        """Find those on both sides of the deepest moment, shape (I,)."""
        return np.asarray((self.room <= self.room.min()).any(axis=1))

    def hiding(self) -> NDArray[np.bool_]:
        """Find those in which more than is allowed could hide, where it is not exceeded anyway, shape (I,)."""
        chosen = np.zeros(len(self.s), bool)
        if self.room.min() >= 0:
            chosen[np.argsort(self.least, kind="stable")[:MOST]] = True
        return np.asarray(chosen & (self.least < 0))


def look_closer(survey: Survey, *, brief: bool) -> Iterator[tuple[Measured, Margin]]:
    """Yield contacts, and their margins between samples: around the deepest one, and wherever more may hide.

    Args:
        survey: A motion whose world is at its samples; it is moved.
        brief: Whether to look only where it matters to whether contacts are as deep as is allowed, or to how much more.
    """
    contacts = [each for each in survey.measured if is_contact(each.constraint)]
    if not contacts:
        return
    reach = survey.world.reach(np.abs(survey.motion.path[0]).max(axis=0))
    begun = _intervals(survey, survey.samples.s[None], contacts, reach)  # before the world is moved
    for each, intervals in zip(contacts, begun, strict=True):
        for s, found in _divisions(survey, intervals, each.constraint, reach, brief=brief):
            yield each, survey.margin(found, s)


def _divisions(
    survey: Survey, intervals: Intervals, constraint: Constraint, reach: Array, *, brief: bool
) -> Iterator[tuple[Array, Measured]]:
    """Yield phases in ever shorter intervals, and the contacts there."""
    for level in range(LEVELS):
        chosen = intervals.hiding()
        if level < DEEPER and not (brief and intervals.room.min() >= 0):
            chosen |= intervals.deepest()
        if not chosen.any():
            return
        low, high = intervals.s[chosen].T
        grid = np.linspace(low, high, FINER + 1, axis=1)
        survey.move(grid.ravel())
        (found,) = survey.measure(constraint, grid.ravel())
        yield grid.ravel(), found
        (intervals,) = _intervals(survey, grid, [found], reach)


def _intervals(survey: Survey, s: Array, contacts: Sequence[Measured], reach: Array) -> list[Intervals]:
    """Return, for each of the contacts, the intervals between neighbours in rows of phases s, where the world is.

    ``s`` has shape (rows, K), ``reach`` is what ``PathWorld.reach`` says.
    """
    world, last = survey.world, s.shape[1] - 1
    ways, leave = reach @ np.abs(world.q[:, 1:] - world.q[:, :-1]), bows(survey.motion, s.ravel(), reach)
    ways[last :: last + 1] = -np.inf  # from row to row nobody asks
    found = []
    for contact in contacts:
        least = contact.condition.lower - contact.allowed
        room, certain = (contact.g - least[:, None]).min(axis=0).reshape(s.shape), np.full(s.size, np.nan)
        if room.min() >= 0:
            certain[:-1] = _pairs(world, contact.constraint).between(least, ways, leave)
        phases, rooms = (np.stack([each[:, :-1], each[:, 1:]], axis=-1).reshape(-1, 2) for each in (s, room))
        found.append(Intervals(phases, rooms, certain.reshape(s.shape)[:, :-1].ravel()))
    return found


def _pairs(world: PathWorld, constraint: Constraint) -> PairDistances:
    """Tell the distances that a constraint is about, one for each of its values."""
    if isinstance(constraint, ObjectContact):
        return world.object_pairs()
    if isinstance(constraint, SelfClearance):
        return world.self_pairs()
    return world.segment_pairs() if world.robot.shape is None else world.shape_pairs()
