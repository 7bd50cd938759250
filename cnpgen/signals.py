"""SIGINT and SIGTERM noted instead of handled, while something runs that must not be cut off."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
