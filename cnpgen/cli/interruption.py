"""Interruption by Ctrl-C or by SIGTERM, as SLURM, Docker and ``timeout`` send it."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cnpgen.machine.signals import signals_handled

# Exit codes: 128 + SIGINT, 128 + SIGTERM, as shells have it.
INTERRUPTED = 130
TERMINATED = 143

_interruptions: list[int] = []  # the signal that came first, if any


class Terminated(KeyboardInterrupt):
    """Somebody asked the process to end."""


def exit_code(interruption: KeyboardInterrupt) -> int:
    """Return the exit code after an interruption."""
    return TERMINATED if isinstance(interruption, Terminated) else INTERRUPTED


def raise_if_interrupted() -> None:
    """Raise the interruption again, because libraries that call back into Python may have dropped it."""
    if _interruptions:
        raise Terminated if _interruptions[0] == signal.SIGTERM else KeyboardInterrupt


@contextmanager
def resumable(place: Path) -> Iterator[None]:
    """Name the file or folder of the finished problems in the message of an interruption."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        kept = (
            f"{place} keeps all finished problems; run the same command again to resume"
        )
        raise type(interruption)(kept) from interruption


def _interrupt(number: int) -> None:
    _interruptions.append(number)
    raise_if_interrupted()


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise ``KeyboardInterrupt`` or ``Terminated`` in this block at the first signal; at a later one, end at once.

    What was begun is tidied up after the first; workers end with their parent in either
    case. Once a signal came, the handlers stay until the process ends, so that none
    interrupts its last steps with a traceback.
    """
    if threading.current_thread() is threading.main_thread():
        _interruptions.clear()
    with signals_handled(_interrupt, lambda number: os._exit(128 + number), stay=True):
        try:
            yield
        except Exception:
            # What the same Ctrl-C did to a compiler is not the news.
            raise_if_interrupted()
            raise
