"""How motions are parameterised."""

from collections.abc import Iterator
from dataclasses import dataclass

from cnpgen.schema.keys import field

MOST_DEGREE, MOST_POINTS = 20, 500  # tables of splines grow with degree x points^2: these take 0.15 GB


@dataclass(frozen=True, kw_only=True)
class TrajectorySpec:
    """How motions are parameterised (paper, section on trajectory parameterisation)."""

    degree: int = field("degree of both B-splines", default=7, low=3, high=MOST_DEGREE)
    path_control_points: int = field(
        "control points of p(s), the path in joint space", default=15, low=6, high=MOST_POINTS
    )
    rate_control_points: int = field(
        "control points of r(s) = ds/dt, the rate along it", default=20, low=4, high=MOST_POINTS
    )

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        for key in ("path_control_points", "rate_control_points"):
            if getattr(self, key) <= self.degree:
                yield (
                    key,
                    f"a spline of degree {self.degree} needs at least {self.degree + 1}, got {getattr(self, key)}",
                )
