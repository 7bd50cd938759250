"""Signals while a library runs that asks Python for them and drops what their handlers raise, as CasADi does."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from cnpgen.signals import Handler, signals_noted

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
