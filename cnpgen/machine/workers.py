"""Distribution of tasks over processes that end with this one, or over the backend of ``joblib.parallel_config``."""

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
from contextlib import closing, contextmanager, suppress
from functools import partial, wraps
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from cnpgen.errors import MachineError
from cnpgen.machine.signals import NUMBERS, signals_deferred
from cnpgen.schema.arguments import integer
from cnpgen.store.files.atomic import machine_errors

# In the format of the option -W.

_IGNORED_WARNING = "ignore:resource_tracker:UserWarning"
DIED = "a worker died (killed, or out of memory)"
# Plus the overhead of joblib; writes of up to 4096 bytes to a pipe are atomic.
MAX_PIPE_BYTES = 2048
TASKS_PER_WORKER = 4  # per batch, for backends that accept only lists of tasks
PARENT_POLL_INTERVAL_S = 0.5  # of the check of a worker for its parent process

T = TypeVar("T")
R = TypeVar("R")


def worker_count(workers: int | None, tasks: int) -> int:
    """Return the number of processes for the tasks: the requested number, by default one per available core.

    Raises:
        UsageError: The requested number is not a positive integer.
    """
    if workers is None:
        from joblib import effective_n_jobs

        # Of the backend of parallel_config, if any.
        return max(1, min(int(effective_n_jobs(-1)), tasks))
    return max(1, min(integer("workers", workers, least=1), tasks))


def distribute(
    function: Callable[[T], R],
    tasks: Iterable[T],
    workers: int,
    *,
    ordered: bool = False,
    hint: str = "",
) -> Generator[R, None, None]:
    """Run a function on every task in other processes, or in this one for one worker, and yield the results.

    Function and tasks must be picklable. Results are yielded in the order of the tasks,
    or when they are ready. A hint is appended to the error message.

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
        # Order: processes that end with this one, backends that yield results, and
        # those that take lists.
        if name == "LokyBackend":
            yield from _on_processes(function, tasks, workers, ordered=ordered)
        elif backend.supports_return_generator or name == "SequentialBackend":
            yield from _generated(function, tasks, workers, ordered=ordered)
        else:
            yield from _in_batches(function, tasks, workers)
    except BrokenExecutor as error:
        raise MachineError(f"{DIED}{hint}") from error


def _generated(
    function: Callable[[T], R],
    tasks: Iterable[T],
    workers: int,
    *,
    ordered: bool,
    **options: Any,
) -> Generator[R, None, None]:
    """Yield the results of joblib with the backend of ``parallel_config``."""
    from joblib import Parallel, delayed

    order = "generator" if ordered else "generator_unordered"
    results = None
    run = Parallel(
        n_jobs=workers,
        return_as=order,
        pre_dispatch="2*n_jobs",
        batch_size=1,
        **options,
    )
    try:
        with signals_blocked():
            results = run(delayed(function)(task) for task in tasks)
        for result in results:  # noqa: UP028 - closing this generator must not close that one noisily
            yield result
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about cancelled tasks
            if results is not None:
                results.close()


def _in_batches(
    function: Callable[[T], R], tasks: Iterable[T], workers: int
) -> Iterator[R]:
    """Yield the results in batches, for backends such as ray and multiprocessing that accept only lists of tasks."""
    from joblib import Parallel, delayed

    left = iter(tasks)
    with Parallel(n_jobs=workers, batch_size=1) as run:
        while batch := list(islice(left, TASKS_PER_WORKER * workers)):
            yield from run(delayed(function)(task) for task in batch)


def _on_processes(
    function: Callable[[T], R], tasks: Iterable[T], workers: int, *, ordered: bool
) -> Iterator[R]:
    """Yield the results of loky processes that end with this one.

    All processes write to one pipe, and messages of more than 4096 bytes are not
    atomic. If a process is killed during such a write, this process waits forever for
    the rest, since the others keep the pipe open. Longer messages are therefore written
    to a file, and only the file name goes through the pipe.
    """
    _start_helpers()
    _tolerate_aborts()
    ours: dict[str, Any] = {"initializer": _end_with, "initargs": (os.getpid(),)}
    with _shared_folder() as folder:
        pack = partial(_packed, function, folder)
        with closing(
            _generated(pack, tasks, workers, ordered=ordered, **ours)
        ) as packed:
            yield from map(_unpacked, packed)


def _packed(function: Callable[[T], R], folder: str, task: T) -> bytes | str:
    """Run a function and return its result or exception, as a short message or as a file name."""
    from joblib.externals.loky.backend.reduction import dumps

    outcome: tuple[bool, R | Exception]
    try:
        outcome = True, function(task)
    except Exception as error:  # noqa: BLE001 - raised again in the parent process
        # The trace of the worker would be lost by pickling.
        error.add_note(traceback.format_exc())
        outcome = False, error
    message = bytes(dumps(outcome))
    # Such messages are written at once: a worker that is killed leaves no part of one
    # in the pipe.
    if len(message) <= MAX_PIPE_BYTES:
        return message
    path = Path(folder) / uuid.uuid4().hex
    with machine_errors("write", path):
        path.write_bytes(message)
    return str(path)


def _unpacked(message: bytes | str) -> Any:
    """Return a packed result of a worker, or raise its exception."""
    if isinstance(message, str):
        path = Path(message)
        message = path.read_bytes()
        path.unlink()
    done, outcome = pickle.loads(message)  # noqa: S301 - from our own process
    if not done:
        raise outcome
    return outcome


@contextmanager
def _shared_folder() -> Iterator[str]:
    """Create a folder for results that is deleted after the block, or soon after this process is killed."""
    from joblib.externals.loky.backend import resource_tracker

    folder = tempfile.mkdtemp(prefix="cnpgen-results-")
    resource_tracker.register(folder, "folder")
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        resource_tracker.unregister(folder, "folder")


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Block signals, so that processes started in the block ignore the Ctrl-C that a terminal sends to all.

    A process inherits the blocked signals of its parent. Only this process handles
    them, at the end of the block, and ends the others. Signals that reach another
    thread of this process are deferred, too.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    _start_helpers()
    with signals_deferred():
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, NUMBERS)
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _start_helpers() -> None:
    """Start joblib's helper processes, which would otherwise start later and unblock the signals.

    They clean up after killed processes. Their warnings on stderr are suppressed by the
    inherited interpreter options.
    """
    sys.warnoptions.append(_IGNORED_WARNING)
    try:
        with suppress(ImportError):
            from multiprocessing import resource_tracker

            from joblib.externals.loky.backend import resource_tracker as loky_tracker

            loky_tracker.ensure_running()
            resource_tracker.ensure_running()
    finally:
        sys.warnoptions.remove(_IGNORED_WARNING)


def _tolerate_aborts() -> None:
    """Let loky's manager thread survive an abort that removes a task between its submission and its dispatch.

    The thread of joblib 1.6 looks up such a task and ends with a KeyError. This process
    would then hang at its exit.
    """
    from joblib.externals.loky import process_executor

    manager = getattr(process_executor, "_ExecutorManagerThread", None)
    dispatch = getattr(manager, "add_call_item_to_queue", None)
    if manager is None or dispatch is None or hasattr(dispatch, "__wrapped__"):
        return

    @wraps(dispatch)
    def dispatch_remaining(thread: Any) -> None:
        # The task was removed by the abort and needs no dispatch.
        with suppress(KeyError):
            dispatch(thread)

    manager.add_call_item_to_queue = dispatch_remaining


def _end_with(parent: int) -> None:
    """Let this worker end soon after its parent; by default, joblib's workers wait minutes for more tasks.

    It may end at any time: files are renamed to their final names when complete.
    """

    def watch() -> None:
        # An orphan gets another parent.
        while os.getppid() == parent:
            time.sleep(PARENT_POLL_INTERVAL_S)
        os._exit(1)

    threading.Thread(target=watch, name="cnpgen-watch", daemon=True).start()
