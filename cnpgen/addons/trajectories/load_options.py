"""Options of reading sampled trajectories, beside the columns of joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from cnpgen.errors import UsageError
from cnpgen.schema.argument_types import check_fields
from cnpgen.schema.arguments import number


@dataclass(frozen=True)
class LoadOptions:
    """Options of ``load_trajectories``.

    Attributes:
        time: Name of the column with the times, and its unit if it has another than s,
            such as "stamp [ms]".
        unit: Unit of revolute joints in columns without a unit in their name; "rad" by
            default.
        rate: Samples per second [Hz] of a file without times.
        separator: Separator of columns in text files; by default it is found.
        separate_by: Column whose value differs from trajectory to trajectory. A value
            that returns after another one begins a new trajectory.
        unwrap: Whether revolute joints that jump by more than half a turn have passed
            the end of the range of angles.
        drop_repeats: Whether to drop rows that repeat the time and the positions of the
            row before.
        topic: Topic of a bag of ROS, if several have trajectories.
        extrapolate: Whether parameters may be outside of their ranges. The problem then
            has wider ranges, and a name that ends with "-extrapolated".
        allow_unused: Keys of messages and scenes that are accepted without effect.

    Raises:
        UsageError: A value has another type, or the rate is not above 0.
    """

    time: str | None = None
    unit: Literal["rad", "deg"] | None = None
    rate: float | None = None
    separator: str | None = None
    separate_by: str | None = None
    unwrap: bool = False
    drop_repeats: bool = False
    topic: str | None = None
    extrapolate: bool = False
    allow_unused: Sequence[str] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        if self.rate is not None and not number("rate", self.rate) > 0:
            raise UsageError(f"must be above 0, got {self.rate}", argument="rate")


DEFAULT_OPTIONS = LoadOptions()
