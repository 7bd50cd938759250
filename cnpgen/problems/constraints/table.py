"""The table manifold: the tip stays over a rectangle at one height (paper, Appendix B, loss of the hitting task)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.problems.constraints.constraint import Condition, Conditions
from cnpgen.problems.constraints.tip_manifold import BOUND_KINKS, TipManifold, TipRegion
from cnpgen.robots.parameter_ranges import TABLE_BOUNDS
from cnpgen.schema.keys import Range, field

if TYPE_CHECKING:
    from cnpgen.world.world import World


@dataclass(frozen=True, kw_only=True)
class Table(TipManifold):
    """Constraint: the tip stays in a rectangle at the table's height, with ``dz/dt = d2z/dt2 = 0`` at the ends.

    It equals a ``plane`` normal to z with a rectangle along x and y. Parameters of the
    problem may raise the table and turn it about the center of its rectangle; then all
    coordinates are those of the table. They may also change the rectangle; the table
    still turns about the center of that in the problem file.
    """

    reason = "off the table"
    training_inset = 1e-3  # m
    kinks = BOUND_KINKS
    moves_with_table = True
    inside_name = "table rectangle"
    held_name = "table height"
    velocity_name = "vertical velocity"
    acceleration_name = "vertical acceleration"
    parts = (("x", "y"), ())
    x: Range = field("range of the tip along world x", unit="m")
    y: Range = field("range of the tip along world y", unit="m")
    z: float = field("height of the tip with the mallet on the table", unit="m")
    start_band: float = field(
        "height error that the start of a motion may have",
        unit="m",
        default=0.0,
        low=0.0,
        plausible=0.5,
    )
    tolerance: float = field(
        "violation that a valid motion may have", unit="m", low=1e-9, plausible=0.5
    )

    @cached_property
    def place(self) -> TipRegion:
        """Region of the tip: the rectangle."""
        axes = np.eye(3).tolist()
        return TipRegion(
            np.array([0.0, 0.0, self.z]),
            held=axes[2:],
            bounded=axes[:2],
            ranges=(self.x, self.y),
        )

    @property
    def bounds(self) -> dict[str, float]:
        """Bounds of the rectangle [m], by the names of parameters."""
        return dict(
            zip(
                TABLE_BOUNDS,
                (self.x.low, self.x.high, self.y.low, self.y.high),
                strict=True,
            )
        )

    def bounds_of(self, parameters: Mapping[str, Any]) -> tuple[Any, Any]:
        """Return the lower and the upper corner of the rectangle of a sample: x and y [m] each."""
        x_low, x_high, y_low, y_high = (
            parameters.get(name, value) for name, value in self.bounds.items()
        )
        return [x_low, y_low], [x_high, y_high]

    def judged(self, world: "World") -> Conditions:
        """Evaluate the tip position with the rectangle of the sample."""
        conditions = self.measured(world)
        values = world.parameters.values
        # The rectangle is that of the problem file.
        if values.keys().isdisjoint(TABLE_BOUNDS):
            return conditions
        # The verdict compares the tip itself with the rectangle of the sample, so that
        # messages have coordinates.
        inside, height = conditions
        low, high = (np.array(corner, float) for corner in self.bounds_of(values))
        tip = self._measured_tip(world)[:2]
        return replace(
            inside, g=list(tip), lower=low, upper=high, parts=self.parts[0]
        ), height

    def _inside(self, tip: Sequence[Any], parameters: Mapping[str, Any]) -> Condition:
        """State the distance from every side separately if sides move: bounds are the same for all samples."""
        condition = super()._inside(tip, parameters)
        if parameters.keys().isdisjoint(TABLE_BOUNDS):
            return condition
        # One value per side: a side of the sample is shifted to that of the problem
        # file.
        sides = [tip[0], tip[0], tip[1], tip[1]]
        shifts = [
            parameters.get(name, bound) - bound for name, bound in self.bounds.items()
        ]
        g = [value - shift for value, shift in zip(sides, shifts, strict=True)]
        # Each value has one finite bound, that of its side.
        lower = np.array([self.x.low, -np.inf, self.y.low, -np.inf])
        upper = np.array([np.inf, self.x.high, np.inf, self.y.high])
        return replace(
            condition,
            g=g,
            lower=lower,
            upper=upper,
            parts=("x low", "x high", "y low", "y high"),
        )
