"""Options of a training run beside its data, length and settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cnpgen.documents import JsonMapping
from cnpgen.schema.argument_types import check_fields


@dataclass(frozen=True)
class TrainingOptions:
    """Options of ``train_model``.

    Attributes:
        epochs: Length in epochs, in place of steps or CPU time.
        command: Command recorded in the model.
        robot: Problem of the robot that moves in the scenes, such as "panda".
        begin: Called once before the first step, with the state and the run.
        watch: Called with every line of the log.

    Raises:
        UsageError: A value has another type.
    """

    epochs: float | None = None
    command: str = ""
    robot: str | Path | None = None
    begin: Callable[..., None] | None = None
    watch: Callable[[JsonMapping], None] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
