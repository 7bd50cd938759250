"""The vertical-orientation manifold: the tip's z axis is the world's (paper, Appendix B, heavy object)."""

from dataclasses import dataclass
from functools import cached_property

from cnpgen.problems.constraints.axis import TipAxis
from cnpgen.schema.keys import field


@dataclass(frozen=True, kw_only=True)
class Vertical(TipAxis):
    """The tip's z axis points up, as ``axis`` would hold it: ``R_02 = R_12 = 0`` and ``R_22 > 0``."""

    reason = "not vertical"
    tolerance: float = field("how far a motion may tilt and still be called valid", unit="rad", low=1e-9)

    @cached_property
    def directions(self) -> tuple[list[float], list[float]]:
        """Both z axes."""
        return [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]
