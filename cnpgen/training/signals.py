"""Signals that wait: a step is finished and the run saved before Ctrl-C or SIGTERM does what it does."""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from cnpgen.signals import signals_noted

ECHO_SECONDS = 1.0  # a terminal and a wrapper such as ``uv run`` both pass on the same Ctrl-C


@dataclass
class Waiting:
    """Which signal waits.

    Attributes:
        number: The first signal that came; None before.
        since: When it came [s].
    """

    number: int | None = None
    since: float = 0.0


@contextmanager
def signals_wait() -> Iterator[Waiting]:
    """Let SIGINT and SIGTERM wait until the end of the block, where they take their effect.

    A second one, more than a second later, does not wait. Signals that are ignored or end the process without Python
    stay as they are, and so do all of them outside of the main thread.
    """
    waiting = Waiting()

    def note(number: int, frame: FrameType | None) -> None:
        if waiting.number is None:
            waiting.number, waiting.since = number, time.monotonic()
        elif time.monotonic() - waiting.since > ECHO_SECONDS:
            handlers[number](number, frame)

    with signals_noted(note) as handlers:
        yield waiting
    if waiting.number is not None:
        signal.raise_signal(waiting.number)
