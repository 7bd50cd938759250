"""Counting the fates of draws: how many, why rejected, and where on the table."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.fields import Field
from cnpgen.pipelines.stage import Array, Batch
from cnpgen.store.outcome import DensityMap, Outcome

CELLS = 24  # along each side of a density map


class Tally:
    """The running counts of one block.

    Args:
        fields: The fields of the dataset; positions among them get a density map over their range.

    Attributes:
        tried: Draws counted so far.
        accepted: Rows taken so far.
    """

    def __init__(self, fields: tuple[Field, ...]) -> None:
        self.tried = 0
        self.accepted = 0
        self._waiting = 0  # draws since the last accepted one
        self._rejections: dict[str, int] = {}
        self._maps = [field for field in fields if field.name.endswith("_xyz")]
        self._drawn = {field.name: np.zeros(CELLS * CELLS, np.int64) for field in self._maps}
        self._kept = {field.name: np.zeros(CELLS * CELLS, np.int64) for field in self._maps}

    def count(self, batch: Batch, draws: int, taken: NDArray[np.intp]) -> NDArray[np.int64]:
        """Count the first ``draws`` draws of a finished round, of which ``taken`` (ascending) became rows.

        Returns:
            For every row the number of draws that it took, itself included, shape (len(taken),).
        """
        fates = np.bincount(batch.fate[:draws], minlength=1 + len(batch.reasons))
        for reason, number in zip(batch.reasons, fates[1:].tolist(), strict=True):
            self._rejections[reason] = self._rejections.get(reason, 0) + number
        self.tried += draws
        self.accepted += len(taken)
        for field in self._maps:
            cells = _cells(batch.drawn[field.name], field)
            self._drawn[field.name] += np.bincount(cells[:draws], minlength=CELLS * CELLS)
            self._kept[field.name] += np.bincount(cells[taken], minlength=CELLS * CELLS)
        attempts = np.diff(taken, prepend=-1 - self._waiting).astype(np.int64)
        self._waiting = draws - 1 - int(taken[-1]) if len(taken) else self._waiting + draws
        return attempts

    def outcome(self) -> Outcome:
        """Return the counts as they stand."""
        maps = {}
        for field in self._maps:
            assert field.valid_min is not None
            assert field.valid_max is not None
            shape = (CELLS, CELLS)
            (x, y), drawn, kept = _extent(field), self._drawn[field.name], self._kept[field.name]
            maps[field.name] = DensityMap(x, y, drawn.reshape(shape), kept.reshape(shape))
        return Outcome(tried=self.tried, accepted=self.accepted, rejections=self._rejections, densities=maps)


def _extent(field: Field) -> tuple[tuple[float, float], tuple[float, float]]:
    assert field.valid_min is not None
    assert field.valid_max is not None
    return (field.valid_min[0], field.valid_max[0]), (field.valid_min[1], field.valid_max[1])


def _cells(position: Array, field: Field) -> NDArray[np.intp]:
    """Index of the cell that each position of shape (3, n) falls into."""
    index = np.zeros(position.shape[1], np.intp)
    for axis, (low, high) in enumerate(_extent(field)):
        fraction = (position[axis] - low) / max(high - low, 1e-300)
        index = index * CELLS + np.clip((fraction * CELLS).astype(np.intp), 0, CELLS - 1)
    return index
