"""Clusters of dask and ray through their own interfaces; joblib's interface cannot report missing workers."""

import importlib
import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from itertools import islice
from typing import Any, TypeVar

from cnpgen.errors import MachineError, requires_extra
from cnpgen.machine.workers import DIED, signals_blocked

POLL_INTERVAL_S = 1.0  # between two checks for finished tasks and workers
FIRST_WARNING_S = 10.0  # time without workers before the first warning; doubled for each further warning
_LOG = logging.getLogger(__name__)

T = TypeVar("T")
R = TypeVar("R")


class Cluster(ABC):
    """Workers of a cluster, which may join and leave; unfinished tasks of a lost worker run again on another."""

    is_remote = True

    def __init__(self, name: str, workers: int | None) -> None:
        self._name, self._workers = name, workers

    @property
    def size(self) -> int:
        """Number of tasks that run at once."""
        return self._workers or max(self.present(), 1)

    def distribute(
        self, function: Callable[[T], R], tasks: Iterable[T], *, ordered: bool = False, hint: str = ""
    ) -> Generator[R, None, None]:
        """Run a function on every task and yield the results.

        Raises:
            MachineError: A task has crashed several workers, or the connection to the cluster is lost.
        """
        submit, left = self.prepared(function), enumerate(tasks)
        under_way: dict[Any, int] = {}
        results: dict[int, R] = {}
        following = 0
        try:
            while True:
                for number, task in islice(left, max(2 * self.size - len(under_way), 0)):
                    under_way[submit(task)] = number
                if not under_way:
                    return
                for ticket in self._wait(list(under_way)):
                    results[under_way.pop(ticket)] = self.result(ticket)
                while results and (following in results or not ordered):
                    yield results.pop(following if ordered else next(iter(results)))
                    following += 1
        except MachineError as error:
            raise MachineError(f"{error}{hint}") from error
        finally:
            self.cancel(list(under_way))

    def _wait(self, tickets: Sequence[Any]) -> Sequence[Any]:
        """Wait until some tasks are finished; log a warning if there is no worker."""
        idle_since, warn_after = time.monotonic(), FIRST_WARNING_S
        while not (finished := self.finished(tickets, POLL_INTERVAL_S)):
            if self.present():
                idle_since, warn_after = time.monotonic(), FIRST_WARNING_S
            elif time.monotonic() - idle_since >= warn_after:
                _LOG.warning("%s has had no worker for %.0f s; waiting for one", self._name, warn_after)
                warn_after *= 2
        return finished

    @abstractmethod
    def present(self) -> int:
        """Return the number of tasks that the present workers can run at once."""

    @abstractmethod
    def prepared(self, function: Callable[[T], R]) -> Callable[[T], Any]:
        """Return a callable that submits a task of a function and returns a ticket for its result."""

    @abstractmethod
    def finished(self, tickets: Sequence[Any], seconds: float) -> Sequence[Any]:
        """Return the finished tickets; wait at most ``seconds`` for the first one."""

    @abstractmethod
    def result(self, ticket: Any) -> Any:
        """Return the result of a finished task, or raise its exception."""

    @abstractmethod
    def cancel(self, tickets: Sequence[Any]) -> None:
        """Cancel unfinished tasks."""


class _Dask(Cluster):
    def __init__(self, client: Any, name: str, workers: int | None) -> None:
        super().__init__(name, workers)
        self._client = client

    def present(self) -> int:
        with _connection_errors(self._name):
            return sum(self._client.nthreads().values())

    def prepared(self, function: Callable[[T], R]) -> Callable[[T], Any]:
        return partial(self._client.submit, function, pure=False)

    def finished(self, tickets: Sequence[Any], seconds: float) -> Sequence[Any]:
        from distributed import wait

        with suppress(TimeoutError), self._client.as_current():
            return list(wait(tickets, timeout=seconds, return_when="FIRST_COMPLETED").done)
        return []

    def result(self, ticket: Any) -> Any:
        from distributed.scheduler import KilledWorker

        try:
            return ticket.result()
        except KilledWorker as error:
            raise MachineError(DIED) from error
        except _lost_of_dask() as error:
            raise MachineError(f"the connection to {self._name} is lost") from error

    def cancel(self, tickets: Sequence[Any]) -> None:
        with suppress(Exception):  # errors of a cancellation are irrelevant
            self._client.cancel(tickets)


def _lost_of_dask() -> tuple[type[BaseException], ...]:
    from concurrent.futures import CancelledError

    from distributed.client import FutureCancelledError

    return CancelledError, FutureCancelledError


@contextmanager
def _connection_errors(name: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:  # includes time-outs and closed connections
        raise MachineError(f"the connection to {name} is lost: {error}") from error


class _Ray(Cluster):
    def present(self) -> int:
        import ray

        return int(ray.cluster_resources().get("CPU", 0))

    def prepared(self, function: Callable[[T], R]) -> Callable[[T], Any]:
        import ray

        there = ray.put(function)
        call = ray.remote(num_cpus=1, max_retries=3)(_call)
        return partial(call.remote, there)

    def finished(self, tickets: Sequence[Any], seconds: float) -> Sequence[Any]:
        import ray

        done, _ = ray.wait(list(tickets), num_returns=1, timeout=seconds)
        return list(done)

    def result(self, ticket: Any) -> Any:
        import ray

        try:
            return ray.get(ticket)
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except ray.exceptions.RayError as error:
            raise MachineError(f"{DIED}: {str(error).splitlines()[0]}") from error

    def cancel(self, tickets: Sequence[Any]) -> None:
        import ray

        for ticket in tickets:
            with suppress(Exception):  # errors of a cancellation are irrelevant
                ray.cancel(ticket)


def _call(function: Callable[[T], R], task: T) -> R:
    """Run a function on a task; ray transfers the function only once."""
    return function(task)


@contextmanager
def joined(name: str, address: str | None, workers: int | None) -> Iterator[Cluster]:
    """Connect to a cluster, or start one on this machine, for the duration of the block.

    Args:
        name: "dask" or "ray".
        address: Address of the scheduler or head; None for a temporary cluster on this machine.
        workers: Number of tasks that run at once; None for all workers of the cluster.

    Raises:
        MissingExtraError: The package is not installed.
        MachineError: The cluster cannot be reached.
    """
    module, join = {"dask": ("distributed", _dask), "ray": ("ray", _ray)}[name]
    with requires_extra(name, module):
        importlib.import_module(module)
    what = f"the {name} cluster " + (f"at {address}" if address else "on this machine")
    with join(address, workers, what) as cluster:
        yield cluster


@contextmanager
def _dask(address: str | None, workers: int | None, what: str) -> Iterator[Cluster]:
    from distributed import Client

    quiet = logging.CRITICAL  # terminated workers log irrelevant errors
    here: dict[str, Any] = {"n_workers": workers, "threads_per_worker": 1, "silence_logs": quiet}
    here["dashboard_address"] = None
    try:
        with nullcontext() if address else signals_blocked():  # local workers do not receive the Ctrl-C of a terminal
            client = Client(address, set_as_default=False, **({} if address else here))
    except (OSError, ValueError, TypeError) as error:
        raise MachineError(f"cannot reach {what}: {error}") from error
    with client:
        yield _Dask(client, what, workers)


@contextmanager
def _ray(address: str | None, workers: int | None, what: str) -> Iterator[Cluster]:
    import ray

    ours = not ray.is_initialized()
    if ours:
        here: dict[str, Any] = {} if address else {"num_cpus": workers, "include_dashboard": False}
        try:
            ray.init(address or "local", log_to_driver=False, logging_level=logging.ERROR, **here)
        except Exception as error:
            raise MachineError(f"cannot reach {what}: {' '.join(str(error).split())}") from error
    try:
        yield _Ray(what, workers)
    finally:
        if ours:
            ray.shutdown()
