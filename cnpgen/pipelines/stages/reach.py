"""Stage: the paper's ballistic reach rule, straight lines along the tip's velocity that must stay over the table."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
        """Look up the table."""
        table = context.constraint(Table)

        def work(draws: Round, _random: np.random.Generator) -> None:
            if self.start_time:
                ahead = draws["start_xyz"] + self.start_time * draws["start_tip_velocity"]
                draws.reject(over(table, ahead), "the start leaves the table")
            if self.goal_time:
                way = self.goal_time * hit_velocity(draws)
                position = draws["goal_xyz"][:2]
                draws.reject(over(table, position + way) & over(table, position - way), "the hit leaves the table")

        return work


def over(table: Table, position: Array) -> NDArray[np.bool_]:
    """Whether positions of shape (2 or 3, n) [m] are over the table's rectangle."""
    x, y = position[:2]
    inside: NDArray[np.bool_] = (table.x.low <= x) & (x <= table.x.high) & (table.y.low <= y) & (y <= table.y.high)
    return inside


def hit_velocity(draws: Round) -> Array:
    """Horizontal velocity of the tip at the goal [m/s], shape (2, n)."""
    angle, speed = draws["hit_angle"], draws["hit_speed"]
    return np.concatenate([speed * np.cos(angle), speed * np.sin(angle)])
