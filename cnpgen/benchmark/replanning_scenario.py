"""Turns: an arm that is on its way to one puck is to hit another one, from where it is and as fast as it moves.

A replan is a turn late on the way, after the puck was moved; a first motion is one early on the way, meant from the start.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.pucks import Pucks, hits_from, hits_of
from cnpgen.errors import RecipeError
from cnpgen.plans.concatenate import concatenate
from cnpgen.plans.plans import Plans
from cnpgen.refine.refine_plans import solve_plans
from cnpgen.schema.keys import field
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]

MAX_SCENARIOS = 10_000  # a first motion is planned for each puck


@dataclass(frozen=True, kw_only=True)
class Turns:
    """Turns from every puck of a grid to the opposite one, at some times of the first motion."""

    when: tuple[float, ...] = field("time at which the arm leaves its first motion", unit="s", low=0.0)
    pucks: Pucks = field("grid of pucks of the first and of the second motion")

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        if self.pucks.columns * self.pucks.rows % 2:
            yield "pucks", "the grid has a puck in its centre, which has no opposite: expected an even number of pucks"
        if (count := self.pucks.columns * self.pucks.rows * len(self.when)) > MAX_SCENARIOS:
            yield "when", f"{count:,} turns are too many, expected at most {MAX_SCENARIOS:,}"


@dataclass(frozen=True, eq=False)
class Lead:
    """The first parts of N motions, up to the times at which they are left.

    Attributes:
        motion: The N motions that are left.
        until: When [s], shape (N,).
    """

    motion: Motion
    until: Array

    def __getitem__(self, index: int) -> "Lead":
        return Lead(self.motion[index], self.until[index : index + 1])


def turns_of(turns: Turns) -> tuple[Plans, Lead]:
    """Return the boundary problems of the second motions, and the first ones.

    The first motion of each is planned from nothing by ``solve_plans``: it is the same for all planners.

    Raises:
        RecipeError: A puck cannot be hit, or a first motion is over before the turn.
    """
    first = solve_plans(hits_of(turns.pucks), workers=1).plans
    opposite = turns.pucks.positions()[:, ::-1]
    problems = []
    for when in turns.when:
        if when >= first.duration.min():
            min_duration = first.duration.min()
            raise RecipeError(
                [f"turns.when: a first motion is over after {min_duration:.3f} s, the turn is at {when:g} s"]
            )
        problems.append(hits_from(turns.pucks, opposite, first.states_at(when)))
    joined, lead = concatenate(problems), concatenate([first] * len(problems)).motion
    until = np.repeat(turns.when, len(first))
    return replace(joined, sample_id=np.arange(len(joined))), Lead(lead, until)
