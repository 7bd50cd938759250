"""The position of a loader in the order of its rows, which allows to continue exactly there."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.shard_reader import SplitShards
from cnpgen.schema.arguments import flag, integer

LOADER_STATE_FORMAT = "cnpgen-loader-state"
LOADER_STATE_VERSION = 1  # also raised if the computation of the order changes


@dataclass(frozen=True)
class Position:
    """A position in the order of an epoch: the number of rows that all ranks together have read."""

    seed: int
    shuffle: bool
    epoch: int
    row: int = 0


def checked_position(*, seed: Any, shuffle: Any, epoch: Any, row: Any = 0) -> Position:
    """Make a position of unchecked arguments.

    Raises:
        UsageError: Seed, epoch or row is not a non-negative integer, or shuffle is not a bool.
    """
    numbers = {"seed": seed, "epoch": epoch, "row": row}
    return Position(
        shuffle=flag("shuffle", shuffle), **{name: integer(name, value, least=0) for name, value in numbers.items()}
    )


def position_to_json(position: Position, source: SplitShards) -> dict[str, Any]:
    """Return a position with the fingerprint and split of its rows as a small JSON-able dict."""
    head = {"format": LOADER_STATE_FORMAT, "format_version": LOADER_STATE_VERSION}
    return head | {"fingerprint": source.fingerprint, "split": source.split, **asdict(position)}


def position_from_json(state: Mapping[str, Any], source: SplitShards) -> Position:
    """Rebuild a position.

    Raises:
        UsageError: The argument is not the state of a loader.
        DatasetError: The state is of another dataset, split or format version.
    """
    if not isinstance(state, Mapping) or state.get("format") != LOADER_STATE_FORMAT:
        raise UsageError(f"a loader's state must be what state() returned, got {state!r:.100}")
    if state.get("format_version") != LOADER_STATE_VERSION:
        version = state.get("format_version")
        text = f"the loader's state has format version {version!r}, this cnpgen reads {LOADER_STATE_VERSION}"
        raise DatasetError(text)
    for name, value in (("fingerprint", source.fingerprint), ("split", source.split)):
        if state.get(name) != value:
            raise DatasetError(f"the loader's state is of another dataset: {name} {state.get(name)!r}, here {value!r}")
    try:
        position = checked_position(**{name: state[name] for name in Position.__dataclass_fields__})
    except KeyError as error:
        raise UsageError(f"the loader's state lacks {error}") from error
    if position.row > source.rows:
        raise DatasetError(f"the loader's state is at row {position.row}; split {source.split!r} has {source.rows}")
    return position
