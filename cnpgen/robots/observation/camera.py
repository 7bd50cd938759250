"""Pinhole camera of observations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array, Vector3
from cnpgen.errors import UsageError
from cnpgen.schema.argument_types import check_fields
from cnpgen.schema.arguments import integer
from cnpgen.schema.units import suggested_unit

MAX_PIXELS = 4096  # of one side of an image
MIN_VIEW_DISTANCE_M = 1e-6


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Pinhole camera that looks at a point; the image is upright with respect to the world's z axis.

    Attributes:
        position: Position in the world frame [m].
        target: Point at the center of the image [m].
        width: Number of pixels of a row.
        height: Number of rows.
        field_of_view: Angle between the left and the right edge of the image [rad].
    """

    position: Vector3 = (1.3, 0.9, 1.1)
    target: Vector3 = (0.4, 0.0, 0.2)
    width: int = 160
    height: int = 120
    field_of_view: float = 1.2

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("width", "height"):
            integer(name, getattr(self, name), least=1, most=MAX_PIXELS)
        if not 0 < self.field_of_view < math.pi:
            hint = suggested_unit(self.field_of_view, "rad", 0.0, math.pi)
            raise UsageError(
                f"must be above 0 and below pi, got {self.field_of_view:g}{hint}",
                argument="field_of_view",
            )
        if (
            not np.isfinite([*self.position, *self.target]).all()
            or math.dist(self.position, self.target) < 1e-6
        ):
            raise UsageError(
                f"must be finite and away from the position {self.position}, got {self.target}",
                argument="target",
            )

    @property
    def axes(self) -> Array:
        """Rows: the unit vector forward, and the vectors from the center to the right and the lower edge at 1 m."""
        forward = np.subtract(self.target, self.position, dtype=float)
        forward /= np.linalg.norm(forward)
        # Where the camera looks up or down, y takes the place of the vertical.
        up = (
            (0.0, 0.0, 1.0)
            if math.hypot(*forward[:2]) > MIN_VIEW_DISTANCE_M
            else (0.0, 1.0, 0.0)
        )
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        half = math.tan(self.field_of_view / 2)
        return np.stack(
            [
                forward,
                half * right,
                half * self.height / self.width * np.cross(forward, right),
            ]
        )
