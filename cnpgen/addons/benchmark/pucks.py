"""Pucks on a grid, and the boundary problems of hitting each of them towards the goal, from rest or while replanning.

In a replanning scenario, the arm moves towards one puck and then hits another one, from
its moving state.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cnpgen.arrays import Array
from cnpgen.documents import NamedErrors
from cnpgen.errors import RecipeError
from cnpgen.make.complete import complete
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.boundary_motion import TableAcceleration, TableVelocity
from cnpgen.pipelines.stages.draw import MAX_TASKS, GivenPositions
from cnpgen.pipelines.stages.hit_angle import HitAngleToGoal, behind
from cnpgen.pipelines.stages.hitting_configuration import HittingConfiguration
from cnpgen.pipelines.stages.hitting_velocity import HittingVelocity
from cnpgen.plans.join import concatenate
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.refine.refine_plans import solve_plans
from cnpgen.schema.arguments import integer
from cnpgen.schema.keys import Range, field
from cnpgen.trajectory.spline_motion import Motion

State = tuple[Array, Array, Array]
"""Positions [rad], velocities [rad/s] and accelerations [rad/s^2] of N arms, shape (N, n) each."""

MAX_SCENARIOS = 10_000  # a first motion is planned for each puck


@dataclass(frozen=True, kw_only=True)
class Pucks:
    """A grid of pucks, each hit as fast as the arm can."""

    problem: Problem = field("problem with a table", form="name or path of a problem")
    x: Range = field("range of the pucks along world x, both ends included", unit="m")
    y: Range = field("range of the pucks along world y, both ends included", unit="m")
    columns: int = field("number of columns of pucks, evenly spaced along x", low=1)
    rows: int = field("number of rows of pucks, evenly spaced along y", low=1)
    goal: tuple[float, float] = field("target of the pucks: x, y", unit="m")
    behind: float = field(
        "distance of the tip behind the puck's centre at the hit",
        unit="m",
        low=0.0,
        plausible=1.0,
    )

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        if (count := self.columns * self.rows) > MAX_TASKS:
            yield (
                "columns",
                f"a grid of {count:,} pucks is too large, expected at most {MAX_TASKS:,}",
            )

    def positions(self) -> Array:
        """Place the pucks [m], shape (2, columns x rows), y fastest."""
        x = np.linspace(self.x.low, self.x.high, self.columns)
        y = np.linspace(self.y.low, self.y.high, self.rows)
        return np.stack(np.meshgrid(x, y, indexing="ij")).reshape(2, -1)


def hits_of(pucks: Pucks) -> Plans:
    """Return the boundary problems of hitting every puck of a grid from rest in the base configuration."""
    puck = pucks.positions()
    start_q = np.tile(load_robot(pucks.problem).home, (puck.shape[1], 1))
    still = np.zeros_like(start_q)
    return hits_from(pucks, puck, (start_q, still, still))


def hits_from(pucks: Pucks, puck: Array, start: State) -> Plans:
    """Return the boundary problems of hitting N pucks at positions [m] of shape (2, N), each from its own state.

    The goal configuration maximizes the speed of the tip along the hit, near the
    configuration of the start. The goal velocity has the maximum speed ('cnpgen docs
    references', 2).

    Raises:
        RecipeError: The problem has no table, or a puck cannot be hit.
    """
    problem = pucks.problem
    table = problem.first(Table)
    if table is None:
        raise RecipeError(
            [f"pucks.problem: {problem.name} has no table to put pucks on"]
        )
    direction = np.array(pucks.goal)[:, None] - puck
    goal_xy = behind(puck, np.arctan2(direction[1:], direction[:1]), pucks.behind).T
    stages = (
        GivenPositions(goal=tuple((x, y, table.z) for x, y in goal_xy.tolist())),
        TableVelocity(),
        TableAcceleration(),
        HitAngleToGoal(target=pucks.goal),
        HittingConfiguration(near="start"),
        HittingVelocity(full_speed=1.0),
    )
    pipeline = Pipeline(name="pucks", problem=problem, stage=stages, path=Path("pucks"))
    start_q, start_dq, start_ddq = start
    completed = complete(
        pipeline,
        goal_xyz=goal_xy,
        start_q=start_q,
        start_dq=start_dq,
        start_ddq=start_ddq,
    )
    if refused := sum(completed.rejections.values()):
        raise RecipeError(
            [f"pucks: {refused} of {len(completed.reasons)} cannot be hit"]
        )
    return replace(completed.plans, source="pucks on a grid")


@dataclass(frozen=True, kw_only=True)
class ReplanningScenario:
    """Switches from every puck of a grid to the opposite one, at given times of the first motion."""

    switch_times: tuple[float, ...] = field(
        "times at which the arm leaves its first motion", unit="s", low=0.0
    )
    pucks: Pucks = field("grid of pucks of the first and of the second motion")

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        if self.pucks.columns * self.pucks.rows % 2:
            yield (
                "pucks",
                "the grid has a puck in its centre, which has no opposite: expected an even number of pucks",
            )
        if (
            count := self.pucks.columns * self.pucks.rows * len(self.switch_times)
        ) > MAX_SCENARIOS:
            yield (
                "switch_times",
                f"{count:,} switches are too many, expected at most {MAX_SCENARIOS:,}",
            )


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
    # The grid is symmetric about its centre: the reversed order is the opposite puck.
    opposite = scenario.pucks.positions()[:, ::-1]
    problems = []
    min_duration = first.duration.min()
    for time in scenario.switch_times:
        if time >= min_duration:
            text = f"a first motion ends after {min_duration:.3f} s, the switch is at {time:g} s"
            raise RecipeError([f"replanning.switch_times: {text}"])
        # The second motion starts from the states of the first ones at the switch.
        problems.append(hits_from(scenario.pucks, opposite, first.states_at(time)))
    joined = concatenate(problems)
    prefix = concatenate([first] * len(problems)).motion
    until = np.repeat(scenario.switch_times, len(first))
    # Every switch of every first motion is a problem of its own.
    return replace(joined, sample_id=np.arange(len(joined))), ExecutedPrefix(
        prefix, until
    )
