"""Chunks of a block: consecutive rows, collected from the batches of candidates that contain them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.pipelines.block_statistics import BlockStatistics
from cnpgen.pipelines.stages.stage import CandidateBatch
from cnpgen.store.field import Field
from cnpgen.store.sampling_statistics import SamplingStatistics


@dataclass(frozen=True)
class Block:
    """Accepted rows in sampling order, and the statistics of all candidates up to the last row.

    Attributes:
        columns: Field name -> values, shape (width, rows); (1, rows) for scalars.
        sampling: Counts of candidates and rejections, and density maps.
    """

    columns: dict[str, NDArray[Any]]
    sampling: SamplingStatistics


class BlockChunk:
    """Rows ``first`` to ``stop`` of a block, collected batch by batch.

    Args:
        fields: Fields of a row; the last two are the bookkeeping fields.
        first: First row.
        stop: End of the rows, exclusive.
    """

    def __init__(self, fields: tuple[Field, ...], first: int, stop: int) -> None:
        self.first, self.stop = first, stop
        self._fields = fields
        self._statistics = BlockStatistics(fields)
        self._parts: list[dict[str, NDArray[Any]]] = []

    def take(self, candidates: CandidateBatch, accepted: int) -> bool:
        """Append the rows of a batch that belong to the chunk.

        Args:
            candidates: Batch of candidates.
            accepted: Number of rows of the block that were accepted before the batch.

        Returns:
            Whether the chunk is complete; the batch may contain rows of the next chunk.
        """
        taken = candidates.alive[: self.stop - accepted]
        end = accepted + len(taken)
        if end < self.first:
            return False
        skip = min(max(self.first - accepted, 0), len(taken))
        # No later chunk counts the candidates after the last row.
        final = candidates.last and end == accepted + len(candidates.alive)
        attempts = self._statistics.count(candidates, taken, first=skip, last=end == self.stop and not final)
        if final:
            attempts[-1:] += self._statistics.waiting
        part = {field.name: candidates[field.name][:, skip : len(taken)] for field in self._fields[:-2]}
        self._parts.append({**part, "attempts": attempts[None]})
        return end == self.stop

    def block(self, first_row: int) -> Block:
        """Return the rows of a complete chunk.

        Args:
            first_row: Index, within the split, of the first row of the block.
        """
        columns = {name: np.concatenate([part[name] for part in self._parts], axis=1) for name in self._parts[0]}
        columns["sample_id"] = first_row + np.arange(self.first, self.stop, dtype=np.int64)[None]
        return Block(columns, self._statistics.sampling())
