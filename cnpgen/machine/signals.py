"""SIGINT and SIGTERM while something runs: who is told of the first one, and of one that comes again."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

NUMBERS = (signal.SIGINT, signal.SIGTERM)
ECHO_SECONDS = 1.0  # a terminal and a wrapper such as ``uv run`` both pass on the same Ctrl-C

Told = Callable[[int], object]


@dataclass
class Received:
    """What has come so far.

    Attributes:
        number: The first signal; None before.
        since: When it came [s].
    """

    number: int | None = None
    since: float = 0.0

    @property
    def came(self) -> bool:
        """Whether one has come."""
        return self.number is not None


@contextmanager
def signals_taken(first: Told, again: Told, *, stay: bool = False) -> Iterator[Received]:
    """Tell ``first`` of the first signal in this block, and ``again`` of those more than ``ECHO_SECONDS`` after it.

    Signals that are ignored stay so, and so do all of them outside of the main thread, which alone may set handlers.

    Args:
        first: Called with the number of the first signal.
        again: Called with the number of a later one.
        stay: Whether the handlers stay after the block once a signal has come; else those from before are back.
    """
    received, before = Received(), _handlers()

    def take(number: int, _frame: FrameType | None) -> None:
        if not received.came:
            received.number, received.since = number, time.monotonic()
            first(number)
        elif time.monotonic() - received.since > ECHO_SECONDS:
            again(number)

    try:
        for number in before:
            signal.signal(number, take)
        yield received
    finally:
        if not (stay and received.came):
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def signals_wait() -> Iterator[Received]:
    """Let a signal wait until the end of the block, where it takes its effect; one that comes again does not wait."""
    before, waiting = _handlers(), Received()

    def effect(number: int) -> None:
        waiting.number = None
        signal.signal(number, before[number])
        signal.raise_signal(number)

    try:
        with signals_taken(lambda _: None, effect) as waiting:
            yield waiting
    finally:
        if waiting.number is not None:
            signal.raise_signal(waiting.number)


def _handlers() -> dict[int, Any]:
    """Return the handlers that may be replaced, by the number of their signal."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    found = {int(number): signal.getsignal(number) for number in NUMBERS}
    return {number: handler for number, handler in found.items() if handler not in (signal.SIG_IGN, None)}
