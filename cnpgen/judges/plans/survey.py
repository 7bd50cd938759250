"""One motion under survey: where it was looked at first, and how to look at it elsewhere."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.course import course
from cnpgen.judges.plans.limits import is_proven
from cnpgen.judges.plans.measure import Measured, measure
from cnpgen.judges.plans.sampling import Samples, times
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.motion import Motion
from cnpgen.world.path import PathWorld

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Survey:
    """One motion and what was looked at.

    Attributes:
        problem: The problem.
        motion: One motion.
        tops: Where the obstacles are, as ``obstacle_tops`` says, shape (numbers,).
        samples: When and at which phases it was looked at first.
        table: Its times, as ``time_table`` returns them.
        start_tip: Where the tip is at the start [m], shape (3,).
        world: The robot; ``move`` moves it.
        measured: Conditions at the samples.
    """

    problem: Problem
    motion: Motion
    tops: Array
    samples: Samples
    table: Array
    start_tip: Array
    world: PathWorld
    measured: Sequence[Measured]

    def move(self, s: Array) -> None:
        """Move the robot to phases s, shape (K,)."""
        states = course(self.motion, s, jerk=self.problem.uses_jerk)
        self.world.set_path(states.q, states.dq, states.ddq, self.tops, states.jerk)

    def measure(self, constraint: Constraint, s: Array) -> list[Measured]:
        """Measure a constraint at phases s, shape (K,), to which the robot was moved."""
        return measure(constraint, self.world, s, self.start_tip)

    def margin(self, found: Measured, s: Array) -> Margin:
        """Say where a condition that was measured at phases s is closest to being broken, or broken most."""
        return found.margin(self.problem, Samples(s, times(s, self.table)))


def survey(  # noqa: PLR0917 - each of them is half of what is surveyed
    problem: Problem, motion: Motion, tops: Array, world: PathWorld, samples: Samples, table: Array
) -> Survey:
    """Measure all that is not proven of one motion, where the robot is.

    Args:
        problem: The problem.
        motion: One motion.
        tops: Where the obstacles are, as ``obstacle_tops`` says, shape (numbers,).
        world: The robot at the samples.
        samples: When and at which phases that is.
        table: Its times, as ``time_table`` returns them.
    """
    start_tip = world.tip_position[:, 0].copy()
    others = [constraint for constraint in problem.constraint if not is_proven(constraint)]
    measured = [each for constraint in others for each in measure(constraint, world, samples.s, start_tip)]
    return Survey(problem, motion, tops, samples, table, start_tip, world, measured)
