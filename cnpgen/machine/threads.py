"""Limit of BLAS to one thread: for small matrices, more threads cost several times the CPU time without speedup."""

import os
import threading
from collections.abc import Callable, Sequence
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


# Functions of a BLAS library that return and set its number of threads.
_Library = tuple[Callable[[], int], Callable[[int], object]]


class _Limit:
    """Reference-counted thread limit of some libraries."""

    def __init__(self) -> None:
        self._inside = 0
        self._before: list[tuple[Callable[[int], object], int]] = []

    def enter(self, libraries: Sequence[_Library]) -> None:
        """Increment the count; set the limit on the first entry."""
        # Blocks may be nested and run in several threads: only the outermost changes
        # the libraries.
        if self._inside == 0:
            self._before = [
                (set_threads, count)
                for get_threads, set_threads in libraries
                if (count := get_threads()) != 1
            ]
            for set_threads, _ in self._before:
                set_threads(1)
        self._inside += 1

    def leave(self) -> None:
        """Decrement the count; restore the thread numbers on the last exit."""
        self._inside -= 1
        if self._inside == 0:
            for set_threads, count in self._before:
                set_threads(count)


class _OwnLimit(threading.local, _Limit):
    """Limit per Python thread."""


class OneThread(ContextDecorator):
    """Context of one BLAS thread for the process while any Python thread is inside.

    It is reentrant.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._limit = _Limit()
        self._own = _OwnLimit()

    def __enter__(self) -> None:
        shared, own = _libraries()
        with self._lock:
            self._limit.enter(shared)
        # Most processes have no such library.
        if own:
            self._own.enter(own)

    def __exit__(self, *_: object) -> None:
        if _libraries()[1]:
            self._own.leave()
        with self._lock:
            self._limit.leave()


_ONE_THREAD = OneThread()


def one_thread() -> OneThread:
    """Compute with one BLAS thread, in a ``with`` block or, as a decorator, in a function.

    It takes 2 microseconds if there is one thread already, otherwise 4.
    """
    return _ONE_THREAD


@cache
def _libraries() -> tuple[list[_Library], list[_Library]]:
    """Find the BLAS libraries: those with one setting for the process, and those with one for every Python thread."""
    import numpy as np  # noqa: F401 - loads its BLAS
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    found = [
        library
        for library in ThreadpoolController().lib_controllers
        if library.user_api == "blas"
    ]
    shared: list[_Library] = []
    own: list[_Library] = []
    for library in found:
        # OpenMP keeps the number of threads per thread of the caller.
        is_own = getattr(library, "threading_layer", "") == "openmp"
        (own if is_own else shared).append(_functions(library))
    return shared, own


def _functions(library: Any) -> _Library:
    """Return the functions of a library; those of OpenBLAS take a tenth of the time of threadpoolctl's methods."""
    if library.internal_api == "openblas" and library.threading_layer != "openmp":
        # This function exists in newer versions of threadpoolctl. Their methods accept
        # only one controlling thread.
        find = getattr(library, "_get_symbol", lambda _: None)
        get_threads, set_threads = map(
            find, (f"openblas_{verb}_num_threads" for verb in ("get", "set"))
        )
        if get_threads is not None and set_threads is not None:
            return get_threads, set_threads
    return library.get_num_threads, library.set_num_threads
