"""Stages: draw the direction of the hit in the table plane."""

from dataclasses import dataclass

import numpy as np

from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import Array, Round, Stage, Work
from cnpgen.schema.keys import field
from cnpgen.store.field import Field


def _angle_field() -> Field:
    low, high = (-float(np.pi),), (float(np.pi),)
    return Field("hit_angle", "rad", "direction of the hit about world z, from world x", role="context", frame="world",
                 valid_min=low, valid_max=high)  # fmt: skip


def wrap(angle: Array) -> Array:
    """Map angles to [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True, kw_only=True)
class HitAngleToGoal(Stage):
    """The puck is hit towards a point behind the goal position, with uniform noise."""

    needs = ("goal_xyz",)
    target: tuple[float, float] = field("where the puck is sent: x, y", unit="m")
    noise: float = field("largest deviation to either side", unit="rad", default=0.0, low=0.0, high=np.pi)

    def describe(self) -> str:
        """Say where to."""
        x, y = self.target
        noise = f", plus uniform noise of +-{self.noise:g} rad" if self.noise else ""
        return f"aim from the goal position at ({x:g}, {y:g}) m{noise}"

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The angle."""
        del context
        return (_angle_field(),)

    def prepare(self, context: Context) -> Work:
        """Nothing to load."""
        del context

        def work(draws: Round, random: np.random.Generator) -> None:
            x, y = draws["goal_xyz"][:2]
            noise = self.noise * (2 * draws.draw(random, 1) - 1)
            draws["hit_angle"] = wrap(np.arctan2(self.target[1] - y, self.target[0] - x) + noise)

        return work


@dataclass(frozen=True, kw_only=True)
class HitAngleInCone(Stage):
    """The puck is hit in a direction uniform in a cone about the line from start to goal.

    The same law as drawing all directions and rejecting those outside the cone, without the rejections.
    """

    half_angle: float = field("half the opening of the cone", unit="rad", low=0.0, high=np.pi)
    origin: str = field(
        'where the line to the goal begins: at the "start", or at the "home" that a stage before chose',
        choices=("start", "home"),
        default="start",
        late=True,
    )

    @property
    def needs(self) -> tuple[str, ...]:
        """Both ends of the line."""
        return f"{self.origin}_xyz", "goal_xyz"

    def describe(self) -> str:
        """Say how wide."""
        line = f"the line from {self.origin} to goal"
        return f"draw the hit direction uniformly within {self.half_angle:.4g} rad of {line}"

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The angle."""
        del context
        return (_angle_field(),)

    def prepare(self, context: Context) -> Work:
        """Nothing to load."""
        del context

        def work(draws: Round, random: np.random.Generator) -> None:
            x, y = (draws["goal_xyz"] - draws[f"{self.origin}_xyz"])[:2]
            noise = self.half_angle * (2 * draws.draw(random, 1) - 1)
            draws["hit_angle"] = wrap(np.arctan2(y, x) + noise)

        return work
