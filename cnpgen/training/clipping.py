"""Clip the gradients of samples and of the batch relative to their running norms.

A few percent of the samples violate a constraint by far. Without clipping one of them weighs as much as hundreds of
others, and Adam's average of squared gradients contains it for a thousand steps.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

SAMPLE_MEMORY, BATCH_MEMORY = 0.98, 0.99
MAX_NORM_RATIO = 3.0  # of a batch's norm to the running norm, in the update of the latter


@dataclass
class Clipping:
    """Running norms of gradients; 0 before the first batch.

    Attributes:
        sample: Running median of the norms of the samples' gradients.
        batch: Running norm of the batch's gradient.
    """

    sample: float = 0.0
    batch: float = 0.0

    def sample_factors(self, norms: Array, *, limit: float) -> Array:
        """Return the factors of the samples' gradients.

        Args:
            norms: Norms of the samples' gradients, finite, shape (N,).
            limit: Largest norm, in running medians; inf for no clipping.

        Returns:
            Shape (N,), in (0, 1]; 1 while half of the gradients of every batch are zero.
        """
        median = float(np.median(norms))
        self.sample = SAMPLE_MEMORY * self.sample + (1 - SAMPLE_MEMORY) * median if self.sample else median
        if not self.sample or np.isinf(limit):
            return np.ones_like(norms)
        return np.minimum(1.0, limit * self.sample / np.maximum(norms, 1e-30)).astype(norms.dtype)

    def batch_factor(self, norm: float, *, limit: float) -> float:
        """Return the factor of the batch's gradient.

        Args:
            norm: Norm of the gradient.
            limit: Largest norm, in running norms; inf for no clipping.
        """
        self.batch = BATCH_MEMORY * self.batch + (1 - BATCH_MEMORY) * min(norm, MAX_NORM_RATIO * self.batch) or norm
        if not self.batch or np.isinf(limit):
            return 1.0
        return min(1.0, limit * self.batch / max(norm, 1e-30))
