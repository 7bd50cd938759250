"""Signals while a library runs that asks Python for them and drops what their handlers raise, as CasADi does."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

Received = list[tuple[int, FrameType | None]]


@contextmanager
def signals_held_back() -> Iterator[Received]:
    """Note SIGINT and SIGTERM in this block instead of handling them; handle the first one at its end.

    Yields:
        What has come so far: whoever is called back in the block looks whether it is to end.
    """
    received: Received = []
    before = {}
    if threading.current_thread() is threading.main_thread():  # no other may set handlers
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        before = {number: handler for number, handler in handlers.items() if callable(handler)}

    def note(number: int, frame: FrameType | None) -> None:
        received.append((number, frame))

    for number in before:
        signal.signal(number, note)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for first, frame in received[:1]:
            before[signal.Signals(first)](first, frame)
