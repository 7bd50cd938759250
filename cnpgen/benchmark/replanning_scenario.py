"""Replanning scenarios: the arm moves towards one puck and then hits another one, from its moving state."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.pucks import Pucks, hits_from, hits_of
from cnpgen.errors import RecipeError
from cnpgen.plans.join import concatenate
from cnpgen.plans.plans import Plans
from cnpgen.refine.refine_plans import solve_plans
from cnpgen.schema.arguments import integer
from cnpgen.schema.keys import field
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]

MAX_SCENARIOS = 10_000  # a first motion is planned for each puck


@dataclass(frozen=True, kw_only=True)
class ReplanningScenario:
    """Switches from every puck of a grid to the opposite one, at given times of the first motion."""

    switch_times: tuple[float, ...] = field("times at which the arm leaves its first motion", unit="s", low=0.0)
    pucks: Pucks = field("grid of pucks of the first and of the second motion")

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, mistake) pairs."""
        if self.pucks.columns * self.pucks.rows % 2:
            yield "pucks", "the grid has a puck in its centre, which has no opposite: expected an even number of pucks"
        if (count := self.pucks.columns * self.pucks.rows * len(self.switch_times)) > MAX_SCENARIOS:
            yield "switch_times", f"{count:,} switches are too many, expected at most {MAX_SCENARIOS:,}"


@dataclass(frozen=True, eq=False)
class ExecutedPrefix:
    """First parts of N motions, up to the switch.

    Attributes:
        motion: The N first motions.
        until: Times of the switches [s], shape (N,).
    """

    motion: Motion
    until: Array

    def __getitem__(self, index: int) -> ExecutedPrefix:
        index = integer("index", index, least=0, most=len(self.until) - 1)
        return ExecutedPrefix(self.motion[index], self.until[index : index + 1])


def scenario_problems(scenario: ReplanningScenario) -> tuple[Plans, ExecutedPrefix]:
    """Return the boundary problems of the second motions, and the prefixes of the first motions.

    ``solve_plans`` plans the first motions, so they are the same for all planners.

    Raises:
        RecipeError: A puck cannot be hit, or a first motion ends before the switch.
    """
    first = solve_plans(hits_of(scenario.pucks), workers=1).plans
    opposite = scenario.pucks.positions()[:, ::-1]
    problems = []
    min_duration = first.duration.min()
    for time in scenario.switch_times:
        if time >= min_duration:
            text = f"a first motion ends after {min_duration:.3f} s, the switch is at {time:g} s"
            raise RecipeError([f"replanning.switch_times: {text}"])
        problems.append(hits_from(scenario.pucks, opposite, first.states_at(time)))
    joined, prefix = concatenate(problems), concatenate([first] * len(problems)).motion
    until = np.repeat(scenario.switch_times, len(first))
    return replace(joined, sample_id=np.arange(len(joined))), ExecutedPrefix(prefix, until)
