"""Being interrupted: by Ctrl-C, or by SIGTERM, which is what SLURM, Docker and ``timeout`` send."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED, TERMINATED = 130, 143  # exit codes: 128 + SIGINT, 128 + SIGTERM, as shells have it
ECHO_SECONDS = 1.0  # a terminal and a wrapper such as ``uv run`` both pass on the same Ctrl-C

_received: list[tuple[int, float]] = []  # the signal that came first, and when [s]


class Terminated(KeyboardInterrupt):
    """Somebody asked the process to end."""


def exit_code(interruption: KeyboardInterrupt) -> int:
    """Return what the process exits with after an interruption."""
    return TERMINATED if isinstance(interruption, Terminated) else INTERRUPTED


def raise_if_interrupted() -> None:
    """Raise again what was raised when the signal came: libraries that call Python back may have dropped it.

    Raises:
        KeyboardInterrupt: The process was interrupted.
        Terminated: The process was asked to end.
    """
    if _received:
        raise Terminated if _received[0][0] == signal.SIGTERM else KeyboardInterrupt


def _handle(number: int, _frame: FrameType | None) -> None:
    if not _received:
        _received.append((number, time.monotonic()))
        raise_if_interrupted()
    elif time.monotonic() - _received[0][1] > ECHO_SECONDS:
        os._exit(128 + number)


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise ``KeyboardInterrupt`` or ``Terminated`` in this block at the first signal; at a later one, end at once.

    What was begun is tidied up after the first; workers end with their parent in either case. Once a signal came, the
    handlers stay until the process ends, so that none interrupts its last steps with a traceback. Signals that the
    process was started to ignore are ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers
        return
    _received.clear()
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) not in (signal.SIG_IGN, None)]
    before = {number: signal.signal(number, _handle) for number in numbers}
    try:
        yield
    except Exception:
        raise_if_interrupted()  # what the same Ctrl-C did to a compiler is not the news
        raise
    finally:
        if not _received:
            for number, handler in before.items():
                signal.signal(number, handler)
