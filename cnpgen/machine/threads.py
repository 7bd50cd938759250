"""One BLAS thread: for matrices as small as ours more only wait for each other, and take several times the CPU."""

import os
import threading
from collections.abc import Sequence
from contextlib import ContextDecorator
from functools import cache
from typing import Any

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


_preferred: dict[str, str] = {}  # what this process has added to its environment


def prefer_one_thread() -> None:
    """Let BLAS libraries that are loaded from now on start with one thread, unless the environment says otherwise."""
    for variable in VARIABLES:
        if variable not in os.environ:
            os.environ[variable] = _preferred[variable] = "1"


def users_environment() -> dict[str, str]:
    """Return the environment without what ``prefer_one_thread`` has added to it."""
    return {name: value for name, value in os.environ.items() if _preferred.get(name) != value}


class _Limit:
    """The limit of some libraries: whoever enters first sets it, whoever leaves last takes it back."""

    def __init__(self) -> None:
        self._inside = 0
        self._before: list[tuple[Any, int]] = []

    def enter(self, libraries: Sequence[Any]) -> None:
        """Set the limit, or only count that somebody is inside."""
        if self._inside == 0:
            found = ((library, library.get_num_threads()) for library in libraries)
            self._before = [(library, count) for library, count in found if count != 1]
            for library, _ in self._before:
                _set_threads(library, 1)
        self._inside += 1

    def leave(self) -> None:
        """Take the limit back, unless somebody is still inside."""
        self._inside -= 1
        if self._inside == 0:
            for library, count in self._before:
                _set_threads(library, count)


class _OwnLimit(threading.local):
    """A limit that every Python thread has for itself."""

    def __init__(self) -> None:
        self.limit = _Limit()


class OneThread(ContextDecorator):
    """One BLAS thread for the process as long as any Python thread is inside; entering again only counts."""

    def __init__(self) -> None:
        self._lock, self._limit, self._own = threading.Lock(), _Limit(), _OwnLimit()

    def __enter__(self) -> None:
        shared, own = _libraries()
        with self._lock:
            self._limit.enter(shared)
        self._own.limit.enter(own)

    def __exit__(self, *_: object) -> None:
        self._own.limit.leave()
        with self._lock:
            self._limit.leave()


_ONE_THREAD = OneThread()


def one_thread() -> OneThread:
    """Compute with one BLAS thread, in a ``with`` block or, as a decorator, in a function.

    It takes 2 microseconds where there is one thread already, and 20 to 30 where there are more.
    """
    return _ONE_THREAD


@cache
def _libraries() -> tuple[list[Any], list[Any]]:
    """Find the BLAS libraries: those with one setting for the process, and those with one for every Python thread."""
    import numpy as np  # noqa: F401 - its BLAS must be there to be found
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    found = [library for library in ThreadpoolController().lib_controllers if library.user_api == "blas"]
    own = [library for library in found if getattr(library, "threading_layer", "") == "openmp"]
    return [library for library in found if library not in own], own


def _set_threads(library: Any, count: int) -> None:
    """Set the threads of a library from any Python thread: newer threadpoolctl listens to only one of them."""
    release = getattr(library, "clear_controlling_thread", None)
    if release is not None:
        release(force=True)
    library.set_num_threads(count)
    if release is not None:
        release(force=True)
