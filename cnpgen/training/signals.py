"""Signals that wait: a step is finished and the run saved before Ctrl-C or SIGTERM does what it does."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

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
    if threading.current_thread() is not threading.main_thread():
        yield waiting
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in before.items() if callable(handler)}

    def note(number: int, frame: FrameType | None) -> None:
        if waiting.number is None:
            waiting.number, waiting.since = number, time.monotonic()
        elif time.monotonic() - waiting.since > ECHO_SECONDS:
            handlers[signal.Signals(number)](number, frame)

    for number in handlers:
        signal.signal(number, note)
    try:
        yield waiting
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if waiting.number is not None:
        signal.raise_signal(waiting.number)
