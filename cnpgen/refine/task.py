"""One boundary problem for the refiner, and what comes of it."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.verdict import Reason
from cnpgen.refine.solver.deadline import Deadline
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]


class Outcome(IntEnum):
    """How refining a plan ended."""

    SOLVED = 0
    SLOWED = 1
    POLISHED = 2
    RESTARTED = 3
    KEPT = 4
    UNSOLVED = 5
    UNUSABLE = 6
    ADJUSTED = 7
    UNSETTLED = 8
    OUT_OF_TIME = 9

    @property
    def text(self) -> str:
        """The outcome in words."""
        return {
            Outcome.SOLVED: "solved in the first pass",
            Outcome.SLOWED: "valid after a uniform slow-down",
            Outcome.POLISHED: "solved after a polish on a finer grid",
            Outcome.RESTARTED: "solved from another start",
            Outcome.KEPT: "kept as it was given: nothing better was found",
            Outcome.UNSOLVED: "no valid plan was found; this is the best one",
            Outcome.ADJUSTED: "kept as it was given but for its ends, made exact, and its rates, made positive",
            Outcome.UNSETTLED: "valid, but the objective still fell when its steps were used up",
            Outcome.OUT_OF_TIME: "the best until the deadline: with more time there may be a better one",
            Outcome.UNUSABLE: "the boundary conditions are no numbers",
        }[self]


@dataclass(frozen=True)
class Task:
    """A boundary problem, with a plan to begin with or without.

    Attributes:
        boundary: Boundary conditions of one motion, shape (1, n) each.
        tops: Where its obstacles are, as ``obstacle_tops`` says, shape (numbers,).
        start_xyz: Position of the tip at the start [m], shape (3,).
        goal_xyz: Position of the tip at the goal [m], shape (3,).
        path: Path control points of the given plan [rad], shape (C, n), or None.
        rate: Its rate control points [1/s], shape (R,), or None.
        deadline: When steps should be over, if that matters.
    """

    boundary: Boundary
    tops: Array
    start_xyz: Array
    goal_xyz: Array
    path: Array | None = None
    rate: Array | None = None
    deadline: Deadline | None = None

    @property
    def at_rest(self) -> bool:
        """Whether the motion begins and ends at rest, so that it may be slowed down without leaving its ends."""
        ends = (self.boundary.start_dq, self.boundary.start_ddq, self.boundary.goal_dq, self.boundary.goal_ddq)
        return all(values is None or not np.any(values) for values in ends)

    @property
    def is_finite(self) -> bool:
        """Whether the boundary conditions are numbers."""
        values = (self.tops, self.start_xyz, self.goal_xyz, *vars(self.boundary).values())
        return all(each is None or bool(np.isfinite(each).all()) for each in values)


@dataclass(frozen=True)
class Attempt:
    """A plan on the way to the best one.

    Attributes:
        x: Variables of the transcription.
        excess: Worst violation on the fine grid, as a multiple of what is allowed; at most 1 is within the tolerances.
            0 where nobody looked, since the iteration ended within its bounds.
        cost: Objective [s].
        outcome: What it would be called if it were the last.
        iterations: Steps that led to it.
    """

    x: Array
    excess: float
    cost: float
    outcome: Outcome
    iterations: int = 0

    def is_better(self, other: "Attempt") -> bool:
        """Whether it breaks less than another, or breaks as little and costs less."""
        mine, others = max(self.excess, 1.0), max(other.excess, 1.0)
        return self.cost < other.cost if mine == others else mine < others


@dataclass(frozen=True)
class Refined:
    """A refined plan.

    Attributes:
        path: Path control points [rad], shape (C, n).
        rate: Rate control points [1/s], shape (R,).
        outcome: How it ended.
        reason: What the independent verdict says: "ok", or why the plan is not valid.
        iterations: Steps of all passes together.
        cost: The objective [s].
    """

    path: Array
    rate: Array
    outcome: Outcome
    reason: str
    iterations: int
    cost: float

    @property
    def valid(self) -> bool:
        """Whether the independent verdict calls it valid."""
        return self.reason == Reason.OK
