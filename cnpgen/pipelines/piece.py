"""A piece of a block: some of its consecutive rows, collected from the rounds in which they were drawn."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.pipelines.stages.stage import Round
from cnpgen.pipelines.tally import Tally
from cnpgen.store.fates import Fates
from cnpgen.store.field import Field


@dataclass(frozen=True)
class Block:
    """Accepted rows, in draw order, and what became of every draw up to the last of them.

    Attributes:
        columns: Field name -> values, shape (width, rows); (1, rows) for scalars.
        fates: Draws, rejections and densities.
    """

    columns: dict[str, NDArray[Any]]
    fates: Fates


class Piece:
    """Rows ``first`` to ``stop`` of a block while its rounds go by.

    Args:
        fields: The fields of a row; the last two are the bookkeeping ones.
        first: First row.
        stop: One after the last row.
    """

    def __init__(self, fields: tuple[Field, ...], first: int, stop: int) -> None:
        self.first, self.stop = first, stop
        self._fields = fields
        self._tally = Tally(fields)
        self._parts: list[dict[str, NDArray[Any]]] = []

    def take(self, draws: Round, made: int) -> bool:
        """Take what belongs to the piece from a round.

        Args:
            draws: The round.
            made: Rows of the block that were accepted before it.

        Returns:
            Whether the piece is whole; the round may have rows of the next one.
        """
        taken = draws.alive[: self.stop - made]
        end = made + len(taken)
        if end < self.first:
            return False
        skip = min(max(self.first - made, 0), len(taken))
        final = draws.last and end == made + len(draws.alive)  # no other piece counts the draws after the last row
        attempts = self._tally.count(draws, taken, first=skip, last=end == self.stop and not final)
        if final:
            attempts[-1:] += self._tally.waiting
        part = {field.name: draws[field.name][:, skip : len(taken)] for field in self._fields[:-2]}
        self._parts.append({**part, "attempts": attempts[None]})
        return end == self.stop

    def block(self, first_row: int) -> Block:
        """Return the rows of a whole piece.

        Args:
            first_row: Index, within the split, of the first row of the block.
        """
        columns = {name: np.concatenate([part[name] for part in self._parts], axis=1) for name in self._parts[0]}
        columns["sample_id"] = first_row + np.arange(self.first, self.stop, dtype=np.int64)[None]
        return Block(columns, self._tally.fates())
