"""Stages: draw the direction of the hit in the table plane, and place the mallet behind the puck along it."""

from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import RecipeError
from cnpgen.pipelines.stages.candidate_table import on_table
from cnpgen.pipelines.stages.draw import position_field
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, Stage, StageFunction
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.constraints.table import Table
from cnpgen.schema.keys import field
from cnpgen.store.field import Field, Fields


def wrap(angle: Array) -> Array:
    """Map angles to [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


class _HitAngle(Stage):
    """Base class: hit direction on the table."""

    def outputs(self, context: Context) -> Fields:
        low = (-float(np.pi),)
        high = (float(np.pi),)
        return (
            Field(
                "hit_angle",
                "rad",
                "direction of the hit about world z, from world x",
                role="context",
                frame="world",
                valid_min=low,
                valid_max=high,
            ),
        )


@dataclass(frozen=True, kw_only=True)
class HitAngleToGoal(_HitAngle):
    """Stage: hit direction from the goal position towards a target of the puck, with uniform noise."""

    inputs = ("goal_xyz",)
    target: tuple[float, float] = field("target of the puck: x, y", unit="m")
    noise: float = field(
        "maximum deviation to either side", unit="rad", default=0.0, low=0.0, high=np.pi
    )

    def describe(self) -> str:
        x, y = self.target
        noise = f", plus uniform noise of +-{self.noise:g} rad" if self.noise else ""
        return f"aim from the goal position at ({x:g}, {y:g}) m{noise}"

    def prepare(self, context: Context) -> StageFunction:
        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            # Directions of hits are angles on the table, which may be turned in the
            # world.
            x, y = on_table(context, candidates, candidates["goal_xyz"])[:2]
            # Uniform in [-noise, noise].
            noise = self.noise * (2 * candidates.draw(random, 1) - 1)
            candidates["hit_angle"] = wrap(
                np.arctan2(self.target[1] - y, self.target[0] - x) + noise
            )

        return work


@dataclass(frozen=True, kw_only=True)
class HitAngleInCone(_HitAngle):
    """Stage: hit direction uniform in a cone about the line from start to goal.

    The distribution equals that of uniform directions with rejection outside the cone.
    """

    half_angle: float = field(
        "half the opening angle of the cone", unit="rad", low=0.0, high=np.pi
    )
    origin: str = field(
        'origin of the line to the goal: the "start", or the "home" of an earlier stage',
        choices=("start", "home"),
        default="start",
        since_version=2,
    )

    @property
    def inputs(self) -> tuple[str, ...]:
        return f"{self.origin}_xyz", "goal_xyz"

    def describe(self) -> str:
        line = f"the line from {self.origin} to goal"
        return f"draw the hit direction uniformly within {self.half_angle:.4g} rad of {line}"

    def prepare(self, context: Context) -> StageFunction:

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            # The cone is about the line from the origin to the goal, in the x-y plane.
            x, y = (candidates["goal_xyz"] - candidates[f"{self.origin}_xyz"])[:2]
            noise = self.half_angle * (2 * candidates.draw(random, 1) - 1)
            candidates["hit_angle"] = wrap(np.arctan2(y, x) + noise)

        return work


@dataclass(frozen=True, kw_only=True)
class BehindPuck(Stage):
    """Stage: move the goal from the puck's centre to the mallet's centre at contact."""

    inputs = ("goal_xyz", "hit_angle")
    distance: float = field(
        "distance of the centres of puck and mallet at contact: sum of the radii",
        unit="m",
        low=0.0,
        plausible=1.0,
    )

    def describe(self) -> str:
        return f"take the goal for the puck's centre: the tip meets it {1e3 * self.distance:g} mm behind, along the hit"

    def outputs(self, context: Context) -> Fields:
        table = context.constraint(Table)
        low = (table.x.low, table.y.low, table.z)
        high = (table.x.high, table.y.high, table.z)
        return (position_field("goal", low, high),)

    def prepare(self, context: Context) -> StageFunction:
        contact = context.problem.first(PuckContact)
        # The constraint places the puck from the goal; both distances must agree.
        if contact is not None and contact.contact_distance != self.distance:
            raise RecipeError(
                [
                    f"distance: expected {contact.contact_distance:g} m, as in puck-contact, got {self.distance:g} m"
                ]
            )

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            candidates["goal_xyz"] = behind(
                candidates["goal_xyz"], candidates["hit_angle"], self.distance
            )

        return work


def behind(puck: Array, angle: Array, distance: float) -> Array:
    """Return positions at a distance [m] behind pucks, shape (3, N), or (2, N) without height, along hit directions.

    The directions are angles about world z [rad], shape (1, N).
    """
    along = np.concatenate([np.cos(angle), np.sin(angle), np.zeros(angle.shape)])
    # mallet = puck - distance * (cos(angle), sin(angle), 0)
    moved: Array = puck - distance * along[: len(puck)]
    return moved
