"""Pucks on a grid, and the boundary problems of hitting each of them towards the goal."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.hitting_configuration import HittingConfiguration
from cnpgen.pipelines.stages.hitting_velocity import HittingVelocity
from cnpgen.pipelines.stages.stage import Round
from cnpgen.plans.boundary_problems import plans_of_rows
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.problems.record import record_problem
from cnpgen.problems.robot import load_robot
from cnpgen.schema.keys import Range, field

Array = NDArray[np.float64]
State = tuple[Array, Array, Array]
"""Positions [rad], velocities [rad/s] and accelerations [rad/s^2] of N arms, shape (N, n) each."""


@dataclass(frozen=True, kw_only=True)
class Pucks:
    """A grid of pucks, each hit as fast as the arm can."""

    problem: Problem = field("the problem", form="name or path of a problem")
    x: Range = field("where the pucks lie along world x, both ends included", unit="m")
    y: Range = field("and along world y", unit="m")
    columns: int = field("how many different x", low=1)
    rows: int = field("how many different y", low=1)
    goal: tuple[float, float] = field("where they are sent", unit="m")
    behind: float = field("where the tip is when it hits: so far behind the puck's centre", unit="m", low=0.0)

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
    """Return the boundary problems of hitting N pucks, each from a state of its own.

    The goal configuration is the one from which the tip can move fastest along the hit, near the configuration of the
    start, and the goal velocity is the fastest one (docs/references.md, 2).

    Args:
        pucks: The problem, and what is asked of hits.
        puck: Where the pucks lie [m], shape (2, N).
        start: Where the arm is at the start, and how it moves.

    Raises:
        RecipeError: The problem has no table, or a puck cannot be hit.
    """
    robot, problem = load_robot(pucks.problem), pucks.problem
    table = next((each for each in problem.constraint if isinstance(each, Table)), None)
    if table is None:
        raise RecipeError([f"pucks.problem: {problem.name} has no table to put pucks on"])
    way = np.array(pucks.goal)[:, None] - puck
    along = way / np.linalg.norm(way, axis=0)
    draws = Round(puck.shape[1])
    draws["goal_xyz"] = np.vstack([puck - pucks.behind * along, np.full(draws.size, table.z)])
    draws["hit_angle"] = np.arctan2(along[1], along[0])[None]
    draws["start_q"] = np.ascontiguousarray(start[0].T)
    context = Context(problem, robot, problem_kernels(problem, robot, *choose_backend(None)), "float64")
    for stage in (HittingConfiguration(near="start"), HittingVelocity(full_speed=1.0)):
        stage.prepare(context)(draws, np.random.default_rng(0))
    if len(draws.alive) < draws.size:
        raise RecipeError([f"pucks: {draws.size - len(draws.alive)} of {draws.size} cannot be hit"])
    record, columns = record_problem(problem), {name: values.T for name, values in draws.columns.items()}
    columns |= {"start_q": start[0], "start_dq": start[1], "start_ddq": start[2]}
    columns |= {name: columns[name][:, 0] for name in ("hit_angle", "hit_speed")}
    return plans_of_rows(record, {**columns, "start_xyz": record.tip_positions(start[0])}, source="pucks on a grid")
