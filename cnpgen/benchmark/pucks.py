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


@dataclass(frozen=True, kw_only=True)
class Pucks:
    """A grid of pucks, each hit from rest in the base configuration, as fast as the arm can."""

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
    """Return the boundary problems of hitting every puck of a grid.

    The goal configuration is the one from which the tip can move fastest along the hit, near the base configuration,
    and the goal velocity is the fastest one (docs/references.md, 2).

    Raises:
        RecipeError: The problem has no table, or a puck cannot be hit.
    """
    robot = load_robot(pucks.problem)
    table = next((each for each in pucks.problem.constraint if isinstance(each, Table)), None)
    if table is None:
        raise RecipeError([f"pucks.problem: {pucks.problem.name} has no table to put pucks on"])
    puck = pucks.positions()
    way = np.array(pucks.goal)[:, None] - puck
    along = way / np.linalg.norm(way, axis=0)
    draws = Round(puck.shape[1])
    draws["goal_xyz"] = np.vstack([puck - pucks.behind * along, np.full(draws.size, table.z)])
    draws["hit_angle"] = np.arctan2(along[1], along[0])[None]
    context = Context(pucks.problem, robot, problem_kernels(pucks.problem, robot, *choose_backend(None)), "float64")
    for stage in (HittingConfiguration(near="base"), HittingVelocity(full_speed=1.0)):
        stage.prepare(context)(draws, np.random.default_rng(0))
    if len(draws.alive) < draws.size:
        raise RecipeError([f"pucks: {draws.size - len(draws.alive)} of {draws.size} cannot be hit"])
    return _plans(pucks.problem, {name: values.T for name, values in draws.columns.items()}, robot.base)


def _plans(problem: Problem, columns: dict[str, Array], base: Array) -> Plans:
    """Add the start at rest to the goals."""
    record, rows = record_problem(problem), len(columns["goal_q"])
    start_q, still = np.tile(base, (rows, 1)), np.zeros((rows, len(base)))
    start = {"start_q": start_q, "start_dq": still, "start_ddq": still, "start_xyz": record.tip_positions(start_q)}
    plain = {name: columns[name][:, 0] for name in ("hit_angle", "hit_speed")}
    return plans_of_rows(record, {**columns, **plain, **start}, source="pucks on a grid")
