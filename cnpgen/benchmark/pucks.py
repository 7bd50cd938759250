"""Pucks on a grid, and the boundary problems of hitting each of them towards the goal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.make.complete import complete
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.boundary_motion import TableAcceleration, TableVelocity
from cnpgen.pipelines.stages.draw import MAX_TASKS, GivenPositions
from cnpgen.pipelines.stages.hit_angle import HitAngleToGoal, behind
from cnpgen.pipelines.stages.hitting_configuration import HittingConfiguration
from cnpgen.pipelines.stages.hitting_velocity import HittingVelocity
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.schema.keys import Range, field

Array = NDArray[np.float64]
State = tuple[Array, Array, Array]
"""Positions [rad], velocities [rad/s] and accelerations [rad/s^2] of N arms, shape (N, n) each."""


@dataclass(frozen=True, kw_only=True)
class Pucks:
    """A grid of pucks, each hit as fast as the arm can."""

    problem: Problem = field("problem with a table", form="name or path of a problem")
    x: Range = field("range of the pucks along world x, both ends included", unit="m")
    y: Range = field("range of the pucks along world y, both ends included", unit="m")
    columns: int = field("number of columns of pucks, evenly spaced along x", low=1)
    rows: int = field("number of rows of pucks, evenly spaced along y", low=1)
    goal: tuple[float, float] = field("target of the pucks: x, y", unit="m")
    behind: float = field("distance of the tip behind the puck's centre at the hit", unit="m", low=0.0, plausible=1.0)

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, mistake) pairs."""
        if (count := self.columns * self.rows) > MAX_TASKS:
            yield "columns", f"a grid of {count:,} pucks is too large, expected at most {MAX_TASKS:,}"

    def positions(self) -> Array:
        """Place the pucks [m], shape (2, columns x rows), y fastest."""
        x, y = np.linspace(self.x.low, self.x.high, self.columns), np.linspace(self.y.low, self.y.high, self.rows)
        return np.stack(np.meshgrid(x, y, indexing="ij")).reshape(2, -1)


def hits_of(pucks: Pucks) -> Plans:
    """Return the boundary problems of hitting every puck of a grid from rest in the base configuration.

    Raises:
        RecipeError: The problem has no table, or a puck cannot be hit.
    """
    puck = pucks.positions()
    start_q = np.tile(load_robot(pucks.problem).base, (puck.shape[1], 1))
    still = np.zeros_like(start_q)
    return hits_from(pucks, puck, (start_q, still, still))


def hits_from(pucks: Pucks, puck: Array, start: State) -> Plans:
    """Return the boundary problems of hitting N pucks, each from its own state.

    The goal configuration maximizes the speed of the tip along the hit, near the configuration of the start. The goal
    velocity has the maximum speed ('cnpgen docs references', 2).

    Args:
        pucks: The problem and the target.
        puck: Positions of the pucks [m], shape (2, N).
        start: States of the arm at the start.

    Raises:
        RecipeError: The problem has no table, or a puck cannot be hit.
    """
    problem = pucks.problem
    table = problem.first(Table)
    if table is None:
        raise RecipeError([f"pucks.problem: {problem.name} has no table to put pucks on"])
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
    columns = dict(zip(("start_q", "start_dq", "start_ddq"), start, strict=True))
    completed = complete(pipeline, goal_xyz=goal_xy, **columns)
    if refused := sum(completed.rejections.values()):
        raise RecipeError([f"pucks: {refused} of {len(completed.reasons)} cannot be hit"])
    return replace(completed.plans, source="pucks on a grid")
