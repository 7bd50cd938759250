"""Stage: goal position of the mallet at contact, behind the puck on the line of the hit."""

from dataclasses import dataclass

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.draw import position_field
from cnpgen.pipelines.stages.stage import Array, CandidateBatch, Stage, StageFunction
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.constraints.table import Table
from cnpgen.schema.keys import field
from cnpgen.store.field import Field


@dataclass(frozen=True, kw_only=True)
class BehindPuck(Stage):
    """Stage: move the goal from the puck's centre to the mallet's centre at contact."""

    inputs = ("goal_xyz", "hit_angle")
    distance: float = field(
        "distance of the centres of puck and mallet at contact: sum of the radii", unit="m", low=0.0, plausible=1.0
    )

    def describe(self) -> str:
        return f"take the goal for the puck's centre: the tip meets it {1e3 * self.distance:g} mm behind, along the hit"

    def outputs(self, context: Context) -> tuple[Field, ...]:
        table = context.constraint(Table)
        low, high = (table.x.low, table.y.low, table.z), (table.x.high, table.y.high, table.z)
        return (position_field("goal", low, high),)

    def prepare(self, context: Context) -> StageFunction:
        """Return the stage function.

        Raises:
            RecipeError: The distance differs from that of the problem's constraint ``puck-contact``.
        """
        contact = context.problem.first(PuckContact)
        if contact is not None and contact.contact_distance != self.distance:
            raise RecipeError(
                [f"distance: expected {contact.contact_distance:g} m, as in puck-contact, got {self.distance:g} m"]
            )

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            candidates["goal_xyz"] = behind(candidates["goal_xyz"], candidates["hit_angle"], self.distance)

        return work


def behind(puck: Array, angle: Array, distance: float) -> Array:
    """Return positions at a distance behind pucks along horizontal hit directions.

    Args:
        puck: Positions of the pucks [m], shape (3, N), or (2, N) without height.
        angle: Hit directions about world z [rad], shape (1, N).
        distance: Distance behind the puck [m].
    """
    along = np.concatenate([np.cos(angle), np.sin(angle), np.zeros(angle.shape)])
    moved: Array = puck - distance * along[: len(puck)]
    return moved
