"""Stage: from where the puck is to where the mallet meets it, behind it on the line of the hit."""

from dataclasses import dataclass

import numpy as np

from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.draw import position_field
from cnpgen.pipelines.stages.stage import Array, Round, Stage, Work
from cnpgen.problems.constraints.table import Table
from cnpgen.schema.keys import field
from cnpgen.store.field import Field


@dataclass(frozen=True, kw_only=True)
class BehindPuck(Stage):
    """Moves the goal from the centre of the puck back to that of the mallet."""

    needs = ("goal_xyz", "hit_angle")
    distance: float = field("from the puck's centre to the mallet's when they meet: both radii", unit="m", low=0.0)

    def describe(self) -> str:
        """Say how far."""
        return f"take the goal for the puck's centre: the tip meets it {1e3 * self.distance:g} mm behind, along the hit"

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The goal position, anywhere on the table."""
        table = context.constraint(Table)
        low, high = (table.x.low, table.y.low, table.z), (table.x.high, table.y.high, table.z)
        return (position_field("goal", low, high),)

    def prepare(self, context: Context) -> Work:
        """Nothing to load."""
        del context

        def work(draws: Round, _random: np.random.Generator) -> None:
            draws["goal_xyz"] = behind(draws["goal_xyz"], draws["hit_angle"], self.distance)

        return work


def behind(puck: Array, angle: Array, distance: float) -> Array:
    """Return positions that are a distance [m] behind those of pucks, along hits in a horizontal direction.

    Args:
        puck: Positions [m], shape (3, N), or (2, N) without their height.
        angle: Directions of the hits about world z [rad], shape (1, N).
        distance: How far [m].
    """
    along = np.concatenate([np.cos(angle), np.sin(angle), np.zeros(angle.shape)])
    moved: Array = puck - distance * along[: len(puck)]
    return moved
