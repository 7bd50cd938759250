"""The vertical-orientation manifold: the tip's z axis is the world's (paper, Appendix B, heavy object)."""

from dataclasses import dataclass
from functools import cached_property

from cnpgen.problems.constraints.axis import TipAxis
from cnpgen.schema.keys import field


@dataclass(frozen=True, kw_only=True)
class Vertical(TipAxis):
    """Constraint: the tip's z axis points up, a special case of ``axis``: ``R_02 = R_12 = 0`` and ``R_22 > 0``."""

    reason = "not vertical"
    tolerance: float = field("tilt that a valid motion may have", unit="rad", low=1e-9, plausible=1.0)

    @cached_property
    def directions(self) -> tuple[list[float], list[float]]:
        """Return both z axes."""
        return [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]
