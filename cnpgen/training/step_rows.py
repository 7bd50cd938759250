"""Which rows a step trains on: arithmetic in seed and step, so that nothing needs to be remembered."""

import numpy as np
from numpy.typing import NDArray


class Order:
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
        self._order = np.empty(0, np.intp)

    def batch(self, step: int) -> NDArray[np.intp]:
        """Return the rows of the batch of one step, shape (batch_size,)."""
        epoch, index = divmod(step, self.batches)
        if epoch != self._epoch:
            random = np.random.Generator(np.random.Philox(key=[self._seed, epoch]))
            self._epoch, self._order = epoch, random.permutation(self._rows)
        return self._order[index * self.batch_size : (index + 1) * self.batch_size]
