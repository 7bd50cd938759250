"""Limit of BLAS to one thread: for small matrices, more threads cost several times the CPU time without speedup."""

import os
import threading
from collections.abc import Sequence
from contextlib import ContextDecorator
from functools import cache
from typing import Any

VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


# Variables that this process has added to its environment.
_preferred: dict[str, str] = {}


def prefer_one_thread() -> None:
    """Let BLAS libraries loaded from now on start with one thread, unless the environment sets another number."""
    for variable in VARIABLES:
        if variable not in os.environ:
            os.environ[variable] = _preferred[variable] = "1"


def users_environment() -> dict[str, str]:
    """Return the environment without the variables that ``prefer_one_thread`` has added."""
    return {
        name: value
        for name, value in os.environ.items()
        if _preferred.get(name) != value
    }


class _Limit:
    """Reference-counted thread limit of some libraries."""

    def __init__(self) -> None:
        self._inside = 0
        self._before: list[tuple[Any, int]] = []

    def enter(self, libraries: Sequence[Any]) -> None:
        """Increment the count; set the limit on the first entry."""
        if self._inside == 0:
            found = ((library, library.get_num_threads()) for library in libraries)
            self._before = [(library, count) for library, count in found if count != 1]
            for library, _ in self._before:
                _set_threads(library, 1)
        self._inside += 1

    def leave(self) -> None:
        """Decrement the count; restore the thread numbers on the last exit."""
        self._inside -= 1
        if self._inside == 0:
            for library, count in self._before:
                _set_threads(library, count)


class _OwnLimit(threading.local, _Limit):
    """Limit per Python thread."""


class OneThread(ContextDecorator):
    """Context of one BLAS thread for the process while any Python thread is inside.

    It is reentrant.
    """

    def __init__(self) -> None:
        self._lock, self._limit, self._own = threading.Lock(), _Limit(), _OwnLimit()

    def __enter__(self) -> None:
        shared, own = _libraries()
        with self._lock:
            self._limit.enter(shared)
        self._own.enter(own)

    def __exit__(self, *_: object) -> None:
        self._own.leave()
        with self._lock:
            self._limit.leave()


_ONE_THREAD = OneThread()


def one_thread() -> OneThread:
    """Compute with one BLAS thread, in a ``with`` block or, as a decorator, in a function.

    It takes 2 microseconds if there is one thread already, otherwise 20 to 30.
    """
    return _ONE_THREAD


@cache
def _libraries() -> tuple[list[Any], list[Any]]:
    """Find the BLAS libraries: those with one setting for the process, and those with one for every Python thread."""
    import numpy as np  # noqa: F401 - loads its BLAS
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    found = [
        library
        for library in ThreadpoolController().lib_controllers
        if library.user_api == "blas"
    ]
    own = [
        library
        for library in found
        if getattr(library, "threading_layer", "") == "openmp"
    ]
    return [library for library in found if library not in own], own


def _set_threads(library: Any, count: int) -> None:
    """Set the threads of a library from any Python thread.

    Newer threadpoolctl accepts only one controlling thread.
    """
    release = getattr(library, "clear_controlling_thread", None)
    if release is not None:
        release(force=True)
    library.set_num_threads(count)
    if release is not None:
        release(force=True)
