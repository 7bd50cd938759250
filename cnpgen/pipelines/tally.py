"""Counting the fates of draws: how many, why rejected, and where on the table."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.pipelines.stages.stage import Array, Round
from cnpgen.store.fates import DensityMap, Fates
from cnpgen.store.field import Field

CELLS = 24  # along each side of a density map


class Tally:
    """The running counts of one block.

    Args:
        fields: The fields of the dataset; positions among them get a density map over their range.

    Attributes:
        tried: Draws counted so far.
        accepted: Rows taken so far.
        waiting: Draws since the last accepted one.
    """

    def __init__(self, fields: tuple[Field, ...]) -> None:
        self.tried = 0
        self.accepted = 0
        self.waiting = 0
        self._rejections: dict[str, int] = {}
        self._stages: dict[str, str] = {}
        self._maps = [field for field in fields if field.name.endswith("_xyz")]
        self._drawn = {field.name: np.zeros(CELLS * CELLS, np.int64) for field in self._maps}
        self._kept = {field.name: np.zeros(CELLS * CELLS, np.int64) for field in self._maps}

    def count(self, draws: Round, taken: NDArray[np.intp], *, first: int, last: bool) -> NDArray[np.int64]:
        """Count the draws of a finished round that belong to the rows asked for.

        Args:
            draws: The round.
            taken: Its draws that became rows, ascending.
            first: How many of these rows come before the first row asked for; they and their draws are not counted.
            last: Whether the last of ``taken`` is the last row asked for: what was drawn after it is not counted.

        Returns:
            For every row counted the number of draws that it took, itself included.
        """
        wanted = taken[first:]
        start = int(taken[first - 1]) + 1 if first else 0
        stop = int(taken[-1]) + 1 if last else draws.size
        if first:
            self.waiting = 0
        fates = np.bincount(draws.fate[start:stop], minlength=1 + len(draws.reasons))
        for reason, number in zip(draws.reasons, fates[1:].tolist(), strict=True):
            self._rejections[reason] = self._rejections.get(reason, 0) + number
        self._stages.update(draws.origins)
        self.tried += stop - start
        self.accepted += len(wanted)
        for field in self._maps:
            cells = _cells(draws.drawn[field.name][:, start:stop], field)
            self._drawn[field.name] += np.bincount(cells, minlength=CELLS * CELLS)
            self._kept[field.name] += np.bincount(cells[wanted - start], minlength=CELLS * CELLS)
        attempts = np.diff(wanted, prepend=start - 1 - self.waiting).astype(np.int64)
        self.waiting = stop - 1 - int(wanted[-1]) if len(wanted) else self.waiting + stop - start
        return attempts

    def fates(self) -> Fates:
        """Return the counts as they stand."""
        maps = {}
        for field in self._maps:
            assert field.valid_min is not None
            assert field.valid_max is not None
            shape = (CELLS, CELLS)
            (x, y), drawn, kept = _extent(field), self._drawn[field.name], self._kept[field.name]
            maps[field.name] = DensityMap(x, y, drawn.reshape(shape), kept.reshape(shape))
        return Fates(
            tried=self.tried,
            accepted=self.accepted,
            rejections=self._rejections,
            stages=self._stages,
            densities=maps,
        )


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
