"""Which rows a step trains on: arithmetic in seed and step, so that nothing needs to be remembered."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader.order import Order


class StepRows:
    """Batches of shuffled rows; every epoch has another order, what does not fill a batch is left out.

    Args:
        rows: Number of rows.
        batch_size: Rows per batch.
        seed: Seed.
    """

    def __init__(self, rows: int, batch_size: int, seed: int) -> None:
        self.batch_size = min(batch_size, rows)
        self.batches = rows // self.batch_size
        self._rows, self._seed, self._epoch = rows, seed, -1
        self._order: NDArray[np.int64] = np.empty(0, np.int64)

    def batch(self, step: int) -> NDArray[np.int64]:
        """Return the rows of the batch of one step, shape (batch_size,)."""
        epoch, index = divmod(step, self.batches)
        if epoch != self._epoch:
            self._epoch, self._order = epoch, Order("train", (self._rows,), self._seed, epoch).rows_of(0)
        return self._order[index * self.batch_size : (index + 1) * self.batch_size]
