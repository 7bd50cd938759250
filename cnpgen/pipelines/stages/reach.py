"""Stage: the paper's ballistic reach rule, straight lines along the tip's velocity that must stay over the table."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.linalg import Scalar, Vec, add, subtract, symbols
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import Array, Round, Stage, Work
from cnpgen.problems.constraints.table import Table
from cnpgen.schema.keys import field
from cnpgen.store.field import Field


@dataclass(frozen=True, kw_only=True)
class BallisticReach(Stage):
    """The tip, going on as it moves, stays over the table: ``p + v t`` after the start, before and after the goal."""

    start_time: float = field("how far ahead of the start", unit="s", default=0.0, low=0.0)
    goal_time: float = field("how far ahead of the goal, and before it", unit="s", default=0.0, low=0.0)

    @property
    def needs(self) -> tuple[str, ...]:
        """The velocities that are looked at."""
        start = ("start_xyz", "start_tip_velocity") if self.start_time else ()
        return start + (("goal_xyz", "hit_angle", "hit_speed") if self.goal_time else ())

    def describe(self) -> str:
        """Say how far."""
        rules = []
        if self.start_time:
            rules.append(f"the start's position + velocity x {1e3 * self.start_time:g} ms")
        if self.goal_time:
            rules.append(f"the goal's position +- hit velocity x {1e3 * self.goal_time:g} ms")
        return "require over the table: " + " and ".join(rules) + " (cheap; braking-reach loses far fewer problems)"

    def provides(self, context: Context) -> tuple[Field, ...]:
        """Nothing."""
        del context
        return ()

    def prepare(self, context: Context) -> Work:
        """Load the kernel."""
        return self._require(context, "leaves the table")

    def complete(self, context: Context, given: Collection[str]) -> Work:
        """Load the kernel; tasks, unlike draws, may begin or end anywhere."""
        del given
        return self._require(context, "is off the table, or leaves it")

    def _require(self, context: Context, reason: str) -> Work:
        table = context.constraint(Table)
        sides = [[side.low, side.high] for side in (table.x, table.y)]
        over = context.kernels.load(over_table, sides=sides)

        def work(draws: Round, _random: np.random.Generator) -> None:
            if self.start_time:
                way = self.start_time * draws["start_tip_velocity"][:2]
                ahead, _ = over(draws["start_xyz"][:2], way)
                draws.reject(ahead[0] > 0, f"the start {reason}")
            if self.goal_time:
                _, both = over(draws["goal_xyz"][:2], self.goal_time * hit_velocity(draws))
                draws.reject(both[0] > 0, f"the hit {reason}")

        return work


def over_table(*, sides: list[list[float]]) -> Any:
    """Build ``(p, way) -> (ahead, both)``: 1 where p + way, and where p + way and p - way, are over the table, else 0.

    Args:
        sides: Where the table's rectangle begins and ends along x and along y [m].
    """
    import casadi as ca

    (p_sx, p), (way_sx, way) = symbols("p", 2), symbols("way", 2)

    def is_over(position: Vec) -> Scalar:
        inside = [ca.logic_and(low <= at, at <= high) for at, (low, high) in zip(position, sides, strict=True)]
        return ca.logic_and(*inside)

    ahead, behind = is_over(add(p, way)), is_over(subtract(p, way))
    return ca.Function("over_table", [p_sx, way_sx], [ahead, ca.logic_and(ahead, behind)])


def hit_velocity(draws: Round) -> Array:
    """Horizontal velocity of the tip at the goal [m/s], shape (2, n)."""
    angle, speed = draws["hit_angle"], draws["hit_speed"]
    return np.concatenate([speed * np.cos(angle), speed * np.sin(angle)])
