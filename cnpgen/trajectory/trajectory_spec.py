"""Parametrization of motions: degree and numbers of control points."""

from collections.abc import Iterator
from dataclasses import dataclass

from cnpgen.schema.keys import field

# Tables of splines grow with degree x points^2: these take 0.15 GB.
MAX_DEGREE = 20
MAX_CONTROL_POINTS = 500


@dataclass(frozen=True, kw_only=True)
class TrajectorySpec:
    """Parametrization of motions by two B-splines (paper, section on trajectory parameterisation)."""

    degree: int = field("degree of both B-splines", default=7, low=3, high=MAX_DEGREE)
    path_control_points: int = field(
        "control points of p(s), the path in joint space",
        default=15,
        low=6,
        high=MAX_CONTROL_POINTS,
    )
    rate_control_points: int = field(
        "control points of r(s) = ds/dt, the rate along it",
        default=20,
        low=4,
        high=MAX_CONTROL_POINTS,
    )

    def validate(self) -> Iterator[tuple[str, str]]:
        """Yield pairs of a key and its error message."""
        for key in ("path_control_points", "rate_control_points"):
            if getattr(self, key) <= self.degree:
                yield (
                    key,
                    f"a spline of degree {self.degree} needs at least {self.degree + 1}, got {getattr(self, key)}",
                )
