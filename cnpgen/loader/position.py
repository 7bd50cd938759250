"""Where in which order a loader is: all that is needed to go on exactly there."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.shards import SplitShards
from cnpgen.schema.arguments import flag, integer

FORMAT = "cnpgen-loader-state"
FORMAT_VERSION = 1  # raised also when the arithmetic of the order changes


@dataclass(frozen=True)
class Position:
    """A position in the order of an epoch.

    Attributes:
        seed: Seed of the order.
        shuffle: Whether rows are shuffled.
        epoch: Number of the epoch.
        row: Rows of the epoch that were delivered, to all ranks together.
    """

    seed: int
    shuffle: bool
    epoch: int
    row: int = 0


def checked_position(*, seed: Any, shuffle: Any, epoch: Any, row: Any = 0) -> Position:
    """Make a position of what somebody gave.

    Raises:
        UsageError: Seed, epoch or row is no integer from 0 on, or shuffle neither True nor False.
    """
    numbers = {"seed": seed, "epoch": epoch, "row": row}
    return Position(
        shuffle=flag("shuffle", shuffle), **{name: integer(name, value, least=0) for name, value in numbers.items()}
    )


def position_to_json(position: Position, source: SplitShards) -> dict[str, Any]:
    """Return a position and what it is a position in as a small JSON-able dict."""
    head = {"format": FORMAT, "format_version": FORMAT_VERSION}
    return head | {"fingerprint": source.fingerprint, "split": source.split, **asdict(position)}


def position_from_json(state: Mapping[str, Any], source: SplitShards) -> Position:
    """Rebuild a position.

    Raises:
        UsageError: This is not the state of a loader.
        DatasetError: It is of other rows: another dataset or split, or a newer cnpgen.
    """
    if not isinstance(state, Mapping) or state.get("format") != FORMAT:
        raise UsageError(f"a loader's state must be what state() returned, got {state!r:.100}")
    if state.get("format_version") != FORMAT_VERSION:
        found = state.get("format_version")
        raise DatasetError(f"the loader's state has format version {found!r}, this cnpgen reads {FORMAT_VERSION}")
    for name, has in (("fingerprint", source.fingerprint), ("split", source.split)):
        if state.get(name) != has:
            raise DatasetError(f"the loader's state is of another dataset: {name} {state.get(name)!r}, here {has!r}")
    try:
        position = checked_position(**{name: state[name] for name in Position.__dataclass_fields__})
    except KeyError as error:
        raise UsageError(f"the loader's state lacks {error}") from error
    if position.row > source.rows:
        raise DatasetError(f"the loader's state is at row {position.row}; split {source.split!r} has {source.rows}")
    return position
