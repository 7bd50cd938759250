"""Work done ahead in a thread of its own."""

from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import TypeVar

T = TypeVar("T")


def start(task: Callable[[], T]) -> "Future[T]":
    """Run a task in a new thread, which ends with it: no pool is left for a fork or an exit to stumble over.

    Returns:
        Its future; what the task raises, ``result()`` raises.
    """
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(task())
        except BaseException as error:  # noqa: BLE001 - not swallowed: handed over to whoever asks for the result
            future.set_exception(error)

    Thread(target=run, name="cnpgen-loader").start()
    return future
