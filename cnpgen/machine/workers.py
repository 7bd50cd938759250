"""Sharing work out: to processes that end with this one, or to whatever backend ``joblib.parallel_config`` names."""

import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from cnpgen.errors import MachineError, UsageError
from cnpgen.machine.signals import NUMBERS, signals_wait
from cnpgen.schema.arguments import integer

_TIDIED = "ignore:resource_tracker:UserWarning"  # as the option -W takes it: the beginning of the message
WATCH_SECONDS = 0.5  # how often a worker looks whether the process that started it is still there

T = TypeVar("T")
R = TypeVar("R")


def worker_count(workers: int | None, tasks: int) -> int:
    """Decide how many processes share the tasks: what was asked for, else one per available core.

    Raises:
        UsageError: Fewer than one was asked for, or no whole number.
    """
    if workers is None:
        from joblib import effective_n_jobs

        return max(1, min(int(effective_n_jobs(-1)), tasks))  # of the backend that parallel_config names, if any
    return max(1, min(integer("workers", workers, least=1), tasks))


def share_out(
    function: Callable[[T], R], tasks: Iterable[T], workers: int, *, ordered: bool = False, advice: str = ""
) -> Generator[R, None, None]:
    """Run a function on every task in other processes and yield the results.

    Args:
        function: What to run; it and the tasks can be pickled.
        tasks: What to run it on.
        workers: Processes; with one, everything runs here.
        ordered: Whether results come in the order of the tasks instead of as they are ready.
        advice: What to do after a worker has died; part of the message.

    Raises:
        MachineError: A worker died.
        UsageError: The backend that ``joblib.parallel_config`` names cannot yield results.
    """
    if workers == 1:
        yield from map(function, tasks)
        return
    from joblib import delayed

    run, results = _pool(workers, ordered=ordered), None
    try:
        with _signals_held():
            results = run(delayed(function)(task) for task in tasks)
        for result in results:  # noqa: UP028 - closing this generator must not close that one noisily
            yield result
    except BrokenExecutor as error:
        raise MachineError(f"a worker died (killed, or out of memory){advice}") from error
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that tasks under way are cancelled is the point
            if results is not None:
                results.close()


def _pool(workers: int, *, ordered: bool) -> Any:
    """Return joblib's way to run tasks on the backend that ``parallel_config`` names, or on processes of ours."""
    from joblib import Parallel
    from joblib.parallel import get_active_backend

    backend, _ = get_active_backend()
    name = type(backend).__name__
    if not backend.supports_return_generator and name != "SequentialBackend":
        raise UsageError(
            f"joblib's {name} cannot yield results one by one: choose loky (the default), threading or dask"
        )
    ours: dict[str, Any] = {"initializer": _end_with, "initargs": (os.getpid(),)} if name == "LokyBackend" else {}
    order = "generator" if ordered else "generator_unordered"
    return Parallel(n_jobs=workers, return_as=order, pre_dispatch="2*n_jobs", batch_size=1, **ours)


@contextmanager
def _signals_held() -> Iterator[None]:
    """Let processes be started that never see Ctrl-C, which a terminal sends to all of them.

    A process inherits the signals that are blocked when it is started. Only this process acts on them, at the end of
    the block, and ends the others. A thread of this process that blocks nothing may get a signal: it waits, too.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    _start_helpers()
    with signals_wait():
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, NUMBERS)
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _start_helpers() -> None:
    """Start the helper processes that joblib would start otherwise later, unblocking the signals.

    They tidy up after processes that were killed; they say so on stderr unless their interpreter, which inherits this
    one's options, ignores it.
    """
    sys.warnoptions.append(_TIDIED)
    try:
        with suppress(ImportError):
            from multiprocessing import resource_tracker

            from joblib.externals.loky.backend import resource_tracker as loky_tracker

            loky_tracker.ensure_running()
            resource_tracker.ensure_running()
    finally:
        sys.warnoptions.remove(_TIDIED)


def _end_with(parent: int) -> None:
    """Let this process, a worker, end soon after its parent: joblib's own would wait for minutes for more work.

    It may end at any moment: files get their names when they are whole.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, name="cnpgen-watch", daemon=True).start()
