"""A baseline on the manifold: the straight line between the boundary control points, bent onto the equalities.

The paper's network corrects a straight line in joint space, which leaves the manifold by far: a heavy object tilts by
some 10 degrees on the way. A Gauss-Newton step removes nearly all of that before the network runs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.curves import line_bend
from cnpgen.planner.lanes import ends_of, lanes, rows
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Baseline:
    """What bends the line of one problem; made by ``make_baseline``.

    Attributes:
        bend: Kernel of ``curves.line_bend``.
    """

    bend: Kernel

    def correction(self, boundary: Boundary, rate: Array, tops: Array) -> Array:
        """Return what the bent line deviates from the straight one by, at a constant rate.

        Args:
            boundary: Boundary conditions of N motions.
            rate: One over the motions' times [1/s], shape (N,).
            tops: Heights of the obstacles' upper faces [m], shape (N, obstacles).

        Returns:
            Shape (N, interior points, n) [rad].
        """
        (change,) = self.bend(ends_of(boundary), rate[None], lanes(tops))
        return rows(change, boundary.start_q.shape[1])


def make_baseline(kernels: KernelLibrary, *, steps: int) -> Baseline:
    """Load the baseline of a problem that has equalities.

    Args:
        kernels: Where kernels are loaded from.
        steps: Number of Gauss-Newton steps, at least 1.
    """
    return Baseline(kernels.load(line_bend, steps=steps))
