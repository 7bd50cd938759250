"""How the rows of an epoch are cut into batches, and who gets which rows of them."""

from dataclasses import dataclass

from cnpgen.errors import UsageError
from cnpgen.schema.arguments import flag, integer


@dataclass(frozen=True, kw_only=True)
class Cut:
    """Batches of a fixed number of rows, each dealt out to the ranks row by row.

    Attributes:
        batch_size: Rows of a batch, of all ranks together.
        rank: Which of the ranks this one is; it gets the rows ``rank::world`` of every batch.
        world: Number of ranks; the batch size is a multiple of it.
        drop_last: Leave out the rows at the end of an epoch that fill no batch.
        worker: Which of the workers of this rank; it gets the batches ``worker::workers``.
        workers: Number of workers.
    """

    batch_size: int
    rank: int = 0
    world: int = 1
    drop_last: bool = True
    worker: int = 0
    workers: int = 1

    def __post_init__(self) -> None:
        for name, least in (("batch_size", 1), ("world", 1), ("rank", 0), ("workers", 1), ("worker", 0)):
            object.__setattr__(self, name, integer(name, getattr(self, name), least=least))
        object.__setattr__(self, "drop_last", flag("drop_last", self.drop_last))
        for name, value, count in (("rank", self.rank, self.world), ("worker", self.worker, self.workers)):
            if value >= count:
                raise UsageError(f"{name} must be one of 0 to {count - 1}, got {value}")
        if self.batch_size % self.world:
            raise UsageError(
                f"batch_size counts the rows of all ranks together and must be a multiple of world ({self.world}),"
                f" got {self.batch_size}"
            )

    def end(self, rows: int, *, first: int = 0) -> int:
        """Return the position at which the batches from position ``first`` on end, of ``rows`` rows."""
        return rows - (rows - first) % self.batch_size if self.drop_last else rows

    def check_ranks(self, rows: int, *, first: int = 0) -> None:
        """Refuse a last batch that has no row for some of the ranks: the mean of nothing is nan, and spreads to all.

        Args:
            rows: Number of rows.
            first: The position from which on batches are cut.

        Raises:
            UsageError: There is such a batch.
        """
        left = (self.end(rows, first=first) - first) % self.batch_size
        if 0 < left < self.world:
            raise UsageError(
                f"the last batch of {rows} rows has {left} for {self.world} ranks: leave it out with drop_last=True,"
                " read all of it on every rank (world=1), or choose another batch_size"
            )

    def count(self, rows: int) -> int:
        """Return the number of batches that this worker gets of ``rows`` rows."""
        batches = -(-self.end(rows) // self.batch_size)
        return -(-(batches - self.worker) // self.workers)
