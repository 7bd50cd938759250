"""Handling of SIGINT and SIGTERM: separate handlers for the first signal and for repeated ones."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

NUMBERS = (signal.SIGINT, signal.SIGTERM)
# A terminal and a wrapper such as ``uv run`` forward the same Ctrl-C twice.
MIN_REPEAT_INTERVAL_S = 1.0

SignalHandler = Callable[[int], object]


@dataclass
class Received:
    """State of the received signals.

    Attributes:
        number: Number of the first signal; None before.
        since: Monotonic time of its receipt [s].
    """

    number: int | None = None
    since: float = 0.0

    @property
    def came(self) -> bool:
        """Whether a signal was received."""
        return self.number is not None


@contextmanager
def signals_handled(
    first: SignalHandler, again: SignalHandler, *, stay: bool = False
) -> Iterator[Received]:
    """Call ``first`` for the first signal in the block, and ``again`` after ``MIN_REPEAT_INTERVAL_S`` or more.

    Ignored signals stay ignored. Outside the main thread, which alone may set handlers,
    nothing changes.

    Args:
        first: Called with the number of the first signal.
        again: Called with the number of a later signal.
        stay: Whether the handlers stay after the block once a signal was received;
            otherwise the previous ones are restored.
    """
    received = Received()
    before = _handlers()

    def take(number: int, _frame: FrameType | None) -> None:
        if not received.came:
            received.number = number
            received.since = time.monotonic()
            first(number)
        # Earlier repetitions are the same keystroke.
        elif time.monotonic() - received.since > MIN_REPEAT_INTERVAL_S:
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
def signals_deferred() -> Iterator[Received]:
    """Defer the first signal to the end of the block.

    A repeated signal takes effect at once.
    """
    before = _handlers()
    waiting = Received()

    def effect(number: int) -> None:
        # The second signal has its usual effect at once.
        waiting.number = None
        signal.signal(number, before[number])
        signal.raise_signal(number)

    try:
        with signals_handled(lambda _: None, effect) as waiting:
            yield waiting
    finally:
        if waiting.number is not None:
            signal.raise_signal(waiting.number)


def _handlers() -> dict[int, Any]:
    """Return the replaceable handlers: signal number -> handler."""
    # Python sets handlers in the main thread only.
    if threading.current_thread() is not threading.main_thread():
        return {}
    found = {int(number): signal.getsignal(number) for number in NUMBERS}
    return {
        number: handler
        for number, handler in found.items()
        # Ignored signals stay ignored, as under nohup; None is a handler of C that
        # cannot be restored.
        if handler not in (signal.SIG_IGN, None)
    }
