"""Stage: the paper's ballistic reach rule: straight lines along the tip velocity must stay over the table."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.linalg import Scalar, Vec, add, subtract, symbols
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.candidate_table import on_table, table_corners
from cnpgen.pipelines.stages.stage import Array, CandidateBatch, Stage, StageFunction
from cnpgen.problems.constraints.table import Table
from cnpgen.schema.keys import field


@dataclass(frozen=True, kw_only=True)
class BallisticReach(Stage):
    """Stage: the tip at constant velocity, ``p + v t``, stays over the table after the start and around the goal."""

    start_time: float = field("time ahead of the start", unit="s", default=0.0, low=0.0, plausible=5.0)
    goal_time: float = field("time ahead of the goal and before it", unit="s", default=0.0, low=0.0, plausible=5.0)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Positions and velocities of the checked ends."""
        start = ("start_xyz", "start_tip_velocity") if self.start_time else ()
        return start + (("goal_xyz", "hit_angle", "hit_speed") if self.goal_time else ())

    def describe(self) -> str:
        rules = []
        if self.start_time:
            rules.append(f"the start's position + velocity x {1e3 * self.start_time:g} ms")
        if self.goal_time:
            rules.append(f"the goal's position +- hit velocity x {1e3 * self.goal_time:g} ms")
        return "require over the table: " + " and ".join(rules) + " (fast; braking-reach rejects far fewer problems)"

    def prepare(self, context: Context) -> StageFunction:
        return self._require(context, "leaves the table")

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Load the kernel; unlike candidates, tasks may also start or end off the table."""
        return self._require(context, "is off the table, or leaves it")

    def _require(self, context: Context, reason: str) -> StageFunction:
        table, varies = context.constraint(Table), context.problem.parameters.changes_rectangle
        sides = [[side.low, side.high] for side in (table.x, table.y)]
        over = context.kernels.load(over_table, sides=None if varies else sides)

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            corners = [np.concatenate(table_corners(context, candidates))] if varies else []
            if self.start_time:
                displacement = self.start_time * candidates["start_tip_velocity"][:2]
                ahead, _ = over(candidates["start_xyz"][:2], displacement, *corners)
                candidates.reject(ahead[0] > 0, f"the start {reason}")
            if self.goal_time:
                goal = on_table(context, candidates, candidates["goal_xyz"])[:2]
                _, both = over(goal, self.goal_time * hit_velocity(candidates), *corners)
                candidates.reject(both[0] > 0, f"the hit {reason}")

        return work


def over_table(*, sides: list[list[float]] | None) -> Any:
    """Build ``(p, d) -> (ahead, both)``: whether p + d is over the table, and whether p + d and p - d both are.

    The sides are the bounds of the table along x and y [m]; without them, both corners are a third argument.
    """
    import casadi as ca

    (p_sx, p), (d_sx, d), (corners_sx, corners) = symbols("p", 2), symbols("d", 2), symbols("corners", 4)
    given = [p_sx, d_sx] if sides else [p_sx, d_sx, corners_sx]
    spans: Any = sides or list(zip(corners[:2], corners[2:], strict=True))

    def is_over(position: Vec) -> Scalar:
        inside = [ca.logic_and(low <= at, at <= high) for at, (low, high) in zip(position, spans, strict=True)]
        return ca.logic_and(*inside)

    ahead, behind = is_over(add(p, d)), is_over(subtract(p, d))
    return ca.Function("over_table", given, [ahead, ca.logic_and(ahead, behind)])


def hit_velocity(candidates: CandidateBatch) -> Array:
    """Return the velocity of the tip on the table at the goal [m/s], shape (2, n)."""
    angle, speed = candidates["hit_angle"], candidates["hit_speed"]
    return np.concatenate([speed * np.cos(angle), speed * np.sin(angle)])
