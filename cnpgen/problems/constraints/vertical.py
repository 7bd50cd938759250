"""The vertical-orientation manifold: the tip's z axis is the world's (paper, Appendix B, heavy object)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.axis import TipAxis
from cnpgen.schema.keys import field


@dataclass(frozen=True, kw_only=True)
class Vertical(TipAxis):
    """``R_02 = R_12 = 0`` and ``R_22 > 0``: an ``axis`` of the tip, z, held along the world's."""

    reason = "not vertical"
    tolerance: float = field("how far a motion may tilt and still be called valid", unit="rad", low=1e-9)

    @property
    def directions(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Both z axes."""
        return np.eye(3)[2], np.eye(3)[2]
