"""Clipping of gradients against their own running size: of every sample, and of the whole batch.

A few samples in a hundred break a constraint by far; unclipped, one of them weighs as much as hundreds of others, and
Adam's second moment remembers it for a thousand steps.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

SAMPLE_MEMORY, BATCH_MEMORY = 0.98, 0.99
JUMP = 3.0  # the running norm follows no single batch further than this


@dataclass
class Clipping:
    """Running sizes of gradients; 0 before the first batch.

    Attributes:
        sample: Running median over the samples of a batch of their gradients' norms.
        batch: Running norm of the batch's gradient.
    """

    sample: float = 0.0
    batch: float = 0.0

    def sample_factors(self, norms: Array, *, limit: float) -> Array:
        """Return what the gradient of every sample is to be multiplied by.

        Args:
            norms: Norms of the samples' gradients, finite, shape (N,).
            limit: Largest norm, in running medians; inf for no clipping.

        Returns:
            Shape (N,), in (0, 1]; 1 as long as half of the gradients of every batch are zero: there is no measure yet.
        """
        middle = float(np.median(norms))
        self.sample = SAMPLE_MEMORY * self.sample + (1 - SAMPLE_MEMORY) * middle if self.sample else middle
        if not self.sample or np.isinf(limit):
            return np.ones_like(norms)
        return np.minimum(1.0, limit * self.sample / np.maximum(norms, 1e-30)).astype(norms.dtype)

    def batch_factor(self, norm: float, *, limit: float) -> float:
        """Return what the gradient of the batch is to be multiplied by.

        Args:
            norm: Its norm.
            limit: Largest norm, in running norms; inf for no clipping.
        """
        self.batch = BATCH_MEMORY * self.batch + (1 - BATCH_MEMORY) * min(norm, JUMP * self.batch) or norm
        if not self.batch or np.isinf(limit):
            return 1.0
        return min(1.0, limit * self.batch / max(norm, 1e-30))
