"""Where the rows of a split come from."""

from dataclasses import dataclass

from cnpgen.loader.shards import Shard, ShardReader


@dataclass(frozen=True, eq=False)
class Source:
    """The shards of a split.

    Attributes:
        split: Name of the split.
        shards: Its shards that are there, in order.
        reader: Reads them.
        fingerprint: Fingerprint of the whole dataset's rows.
        stored: Type that fields of numbers are stored in, "float64" or "float32".
    """

    split: str
    shards: tuple[Shard, ...]
    reader: ShardReader
    fingerprint: str
    stored: str

    @property
    def rows(self) -> int:
        """Number of rows."""
        return sum(shard.rows for shard in self.shards)
