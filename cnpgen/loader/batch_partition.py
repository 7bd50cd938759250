"""Partition of the rows of an epoch into batches, ranks and workers."""

from dataclasses import dataclass

from cnpgen.errors import UsageError
from cnpgen.schema.arguments import flag, integer


@dataclass(frozen=True, kw_only=True)
class BatchPartition:
    """Batches of a fixed number of rows over all ranks; the rows of a batch are distributed over the ranks.

    A rank reads the rows ``rank::world`` of every batch, one of its workers the batches ``worker::workers``. An
    incomplete last batch of an epoch is omitted by default.
    """

    batch_size: int
    rank: int = 0
    world: int = 1
    drop_last: bool = True
    worker: int = 0
    workers: int = 1

    def __post_init__(self) -> None:
        for name, minimum in (("batch_size", 1), ("world", 1), ("rank", 0), ("workers", 1), ("worker", 0)):
            object.__setattr__(self, name, integer(name, getattr(self, name), least=minimum))
        object.__setattr__(self, "drop_last", flag("drop_last", self.drop_last))
        for name, value, count in (("rank", self.rank, self.world), ("worker", self.worker, self.workers)):
            if value >= count:
                raise UsageError(f"must be one of 0 to {count - 1}, got {value}", argument=name)
        if self.batch_size % self.world:
            raise UsageError(
                f"batch_size counts the rows of all ranks together and must be a multiple of world ({self.world}),"
                f" got {self.batch_size}",
                concerns="batch_size",
            )

    def end(self, rows: int, *, first: int = 0) -> int:
        """Return the end of the batches that start at position ``first``, of ``rows`` rows."""
        return rows - (rows - first) % self.batch_size if self.drop_last else rows

    def check_ranks(self, rows: int, *, first: int = 0) -> None:
        """Raise an error if the last batch has no row for some ranks, since their mean loss would be nan.

        The batches begin at position ``first``.

        Raises:
            UsageError: The last batch has fewer rows than there are ranks.
        """
        remainder = (self.end(rows, first=first) - first) % self.batch_size
        if 0 < remainder < self.world:
            raise UsageError(
                f"the last batch of {rows} rows has {remainder} for {self.world} ranks: omit it with drop_last=True,"
                " read all of it on every rank (world=1), or choose another batch_size",
                concerns="batch_size",
            )

    def count(self, rows: int) -> int:
        """Return the number of batches of this worker for ``rows`` rows."""
        batches = -(-self.end(rows) // self.batch_size)
        return -(-(batches - self.worker) // self.workers)
