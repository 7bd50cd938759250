"""Options of batches beside their size, split, order and fields."""

from dataclasses import dataclass

from cnpgen.schema.argument_types import check_fields


@dataclass(frozen=True)
class BatchOptions:
    """Options of ``Dataset.batches``.

    Attributes:
        rank: Index of the rank of this process; it reads the rows ``rank::world`` of
            every batch.
        world: Number of ranks.
        drop_last: Whether to omit an incomplete last batch of an epoch.
        shuffle: Whether to shuffle the rows; otherwise they are in their stored order.

    Raises:
        UsageError: A value has another type.
    """

    rank: int = 0
    world: int = 1
    drop_last: bool = True
    shuffle: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
