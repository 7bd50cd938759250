"""SIGINT and SIGTERM noted instead of handled, while something runs that must not be cut off."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

Handler = Callable[[int, FrameType | None], object]


@contextmanager
def signals_noted(note: Handler) -> Iterator[dict[int, Handler]]:
    """Let ``note`` take SIGINT and SIGTERM in this block; the handlers are back at its end.

    Signals that are ignored or end the process without Python stay as they are, and so do all of them outside of the
    main thread, which alone may set handlers.

    Yields:
        The handlers that are replaced, by the signal's number.
    """
    before: dict[int, Handler] = {}
    if threading.current_thread() is threading.main_thread():
        handlers = {int(number): signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        before = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in before:
        signal.signal(number, note)
    try:
        yield before
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


Received = list[tuple[int, FrameType | None]]


@contextmanager
def signals_held_back() -> Iterator[Received]:
    """Note SIGINT and SIGTERM in this block instead of handling them; handle the first one at its end.

    Yields:
        What has come so far: whoever is called back in the block looks whether it is to end.
    """
    received: Received = []
    before: dict[int, Handler] = {}
    try:
        with signals_noted(lambda number, frame: received.append((number, frame))) as before:
            yield received
    finally:
        for first, frame in received[:1]:
            before[first](first, frame)


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
