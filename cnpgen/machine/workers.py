"""Sharing work out: to processes that end with this one, or to whatever backend ``joblib.parallel_config`` names."""

import os
import pickle
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
import uuid
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from cnpgen.errors import MachineError
from cnpgen.machine.signals import NUMBERS, signals_wait
from cnpgen.schema.arguments import integer
from cnpgen.store.files.atomic import machine_error

_TIDIED = "ignore:resource_tracker:UserWarning"  # as the option -W takes it: the beginning of the message
DIED = "a worker died (killed, or out of memory)"
SHORT = 2048  # bytes of a message through the pipe, to which joblib adds some: up to 4096 are written as a whole
WAVE = 4  # tasks for each worker of those that are given at a time to what knows only lists
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
    """
    if workers == 1:
        yield from map(function, tasks)
        return
    from joblib.parallel import get_active_backend

    backend, _ = get_active_backend()
    name = type(backend).__name__
    try:
        if name == "LokyBackend":
            yield from _on_processes(function, tasks, workers, ordered=ordered)
        elif backend.supports_return_generator or name == "SequentialBackend":
            yield from _generated(function, tasks, workers, ordered=ordered)
        else:
            yield from _in_waves(function, tasks, workers)
    except BrokenExecutor as error:
        raise MachineError(f"{DIED}{advice}") from error


def _generated(
    function: Callable[[T], R], tasks: Iterable[T], workers: int, *, ordered: bool, **options: Any
) -> Iterator[R]:
    """Let joblib yield the results, on the backend that ``parallel_config`` names."""
    from joblib import Parallel, delayed

    order, results = "generator" if ordered else "generator_unordered", None
    run = Parallel(n_jobs=workers, return_as=order, pre_dispatch="2*n_jobs", batch_size=1, **options)
    try:
        with signals_held():
            results = run(delayed(function)(task) for task in tasks)
        for result in results:  # noqa: UP028 - closing this generator must not close that one noisily
            yield result
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that tasks under way are cancelled is the point
            if results is not None:
                results.close()


def _in_waves(function: Callable[[T], R], tasks: Iterable[T], workers: int) -> Iterator[R]:
    """Yield the results of a few tasks at a time: backends such as ray and multiprocessing know only lists of them."""
    from joblib import Parallel, delayed

    left = iter(tasks)
    with Parallel(n_jobs=workers, batch_size=1) as run:
        while wave := list(islice(left, WAVE * workers)):
            yield from run(delayed(function)(task) for task in wave)


def _on_processes(function: Callable[[T], R], tasks: Iterable[T], workers: int, *, ordered: bool) -> Iterator[R]:
    """Yield the results of processes of ours, which end with this one.

    All of them write to one pipe. A message of more than 4096 bytes is written in steps: a process that is killed
    between two of them would leave this one waiting for the rest for ever, as the others hold the pipe open. So what
    is longer goes through a file, and only its name through the pipe.
    """
    _start_helpers()
    ours: dict[str, Any] = {"initializer": _end_with, "initargs": (os.getpid(),)}
    with _shared_folder() as folder:
        packed = _generated(partial(_packed, function, folder), tasks, workers, ordered=ordered, **ours)
        yield from map(_unpacked, packed)


def _packed(function: Callable[[T], R], folder: str, task: T) -> bytes | str:
    """Run a function and return its result, or what it raised, as a short message or as the name of a file."""
    from joblib.externals.loky.backend.reduction import dumps

    outcome: tuple[bool, R | Exception]
    try:
        outcome = True, function(task)
    except Exception as error:  # noqa: BLE001 - the boundary of the worker: it is raised again in the parent
        error.add_note(traceback.format_exc())
        outcome = False, error
    message = bytes(dumps(outcome))
    if len(message) <= SHORT:
        return message
    path = Path(folder) / uuid.uuid4().hex
    try:
        path.write_bytes(message)
    except OSError as error:
        raise machine_error("write", path, error) from error
    return str(path)


def _unpacked(message: bytes | str) -> Any:
    """Return the result that a worker has packed, or raise what it raised."""
    if isinstance(message, str):
        path = Path(message)
        message = path.read_bytes()
        path.unlink()
    done, outcome = pickle.loads(message)  # noqa: S301 - of a process of ours
    if not done:
        raise outcome
    return outcome


@contextmanager
def _shared_folder() -> Iterator[str]:
    """Make a folder for results that is gone after the block, or, where this process is killed, soon after it."""
    from joblib.externals.loky.backend import resource_tracker

    folder = tempfile.mkdtemp(prefix="cnpgen-results-")
    resource_tracker.register(folder, "folder")
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        resource_tracker.unregister(folder, "folder")


@contextmanager
def signals_held() -> Iterator[None]:
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
