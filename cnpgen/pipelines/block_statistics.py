"""Sampling statistics of candidates: counts, rejection reasons and density maps over the table."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.pipelines.stages.stage import Array, CandidateBatch
from cnpgen.store.field import Field
from cnpgen.store.sampling_statistics import DensityMap, SamplingStatistics

CELLS = 24  # cells along each side of a density map


class BlockStatistics:
    """Running counts of one block.

    Args:
        fields: Fields of the dataset; each position field gets a density map over its range.

    Attributes:
        tried: Number of candidates counted so far.
        accepted: Number of rows accepted so far.
        waiting: Number of candidates since the last accepted one.
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

    def count(
        self, candidates: CandidateBatch, taken: NDArray[np.intp], *, first: int, last: bool
    ) -> NDArray[np.int64]:
        """Count the candidates of a finished batch that belong to the requested rows.

        Args:
            candidates: Batch of candidates.
            taken: Indices of its accepted candidates, ascending, shape (k,).
            first: Number of entries of ``taken`` before the first requested row; these candidates are not counted.
            last: Whether ``taken`` ends at the last requested row; later candidates are then not counted.

        Returns:
            Number of candidates per counted row, including the accepted one.
        """
        rows = taken[first:]
        start = int(taken[first - 1]) + 1 if first else 0
        stop = int(taken[-1]) + 1 if last else candidates.size
        if first:
            self.waiting = 0
        sampling = np.bincount(candidates.outcome[start:stop], minlength=1 + len(candidates.reasons))
        for reason, number in zip(candidates.reasons, sampling[1:].tolist(), strict=True):
            self._rejections[reason] = self._rejections.get(reason, 0) + number
        self._stages.update(candidates.origins)
        self.tried += stop - start
        self.accepted += len(rows)
        for field in self._maps:
            cells = _cells(candidates.drawn[field.name][:, start:stop], field)
            self._drawn[field.name] += np.bincount(cells, minlength=CELLS * CELLS)
            self._kept[field.name] += np.bincount(cells[rows - start], minlength=CELLS * CELLS)
        attempts = np.diff(rows, prepend=start - 1 - self.waiting).astype(np.int64)
        self.waiting = stop - 1 - int(rows[-1]) if len(rows) else self.waiting + stop - start
        return attempts

    def sampling(self) -> SamplingStatistics:
        """Return the present counts."""
        maps = {}
        for field in self._maps:
            assert field.valid_min is not None
            assert field.valid_max is not None
            shape = (CELLS, CELLS)
            (x, y), drawn, kept = _extent(field), self._drawn[field.name], self._kept[field.name]
            maps[field.name] = DensityMap(x, y, drawn.reshape(shape), kept.reshape(shape))
        return SamplingStatistics(
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
    """Return the index of the cell of each position, for positions of shape (3, n)."""
    index = np.zeros(position.shape[1], np.intp)
    for axis, (low, high) in enumerate(_extent(field)):
        fraction = (position[axis] - low) / max(high - low, 1e-300)
        index = index * CELLS + np.clip((fraction * CELLS).astype(np.intp), 0, CELLS - 1)
    return index
