"""Clusters of dask and ray through their own interfaces.

Joblib's interface cannot report missing workers.
"""

import importlib
import importlib.metadata
import importlib.util
import logging
import os
import re
import secrets
import socket
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from itertools import islice
from typing import Any, TypeVar

from cnpgen.errors import MachineError, UsageError, requires_extra
from cnpgen.machine.workers import DIED, signals_blocked

POLL_INTERVAL_S = 1.0  # between two checks for finished tasks and workers
CONNECTION_TIMEOUT_S = 10.0
CLOSING_TIMEOUT_S = 3.0
LOOPBACK = "127.0.0.1"
MIN_RAY_VERSION = (2, 52)  # the first one with tokens
_ADDRESSES = {  # name -> pattern of addresses, examples
    "dask": (
        r"((tcp|tls|ws|wss|ucx|inproc)://)?[^\s/:]+:\d{1,5}|inproc://\S+",
        "tcp://host:8786 or tls://host:8786",
    ),
    "ray": (r"auto|(ray://)?[^\s/:]+:\d{1,5}", "host:6379 or auto"),
}
# Time without workers before the first warning; doubled for each further warning.
FIRST_WARNING_S = 10.0
_LOG = logging.getLogger(__name__)

T = TypeVar("T")
R = TypeVar("R")


class Cluster(ABC):
    """Workers of a cluster, which may join and leave.

    Unfinished tasks of a lost worker run again on another.
    """

    is_remote = True

    def __init__(self, name: str, workers: int | None) -> None:
        self._name = name
        self._workers = workers

    @property
    def size(self) -> int:
        """Number of tasks that run at once."""
        return self._workers or max(self.present(), 1)

    def distribute(
        self,
        function: Callable[[T], R],
        tasks: Iterable[T],
        *,
        ordered: bool = False,
        hint: str = "",
    ) -> Generator[R, None, None]:
        """Run a function on every task and yield the results.

        Raises:
            MachineError: A task has crashed several workers, or the connection to the
                cluster is lost.
        """
        submit = self.prepared(function)
        left = enumerate(tasks)
        under_way: dict[Any, int] = {}
        results: dict[int, R] = {}
        following = 0
        try:
            while True:
                for number, task in islice(
                    left, max(2 * self.size - len(under_way), 0)
                ):
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
        idle_since = time.monotonic()
        warn_after = FIRST_WARNING_S
        while not (finished := self.finished(tickets, POLL_INTERVAL_S)):
            if self.present():
                idle_since = time.monotonic()
                warn_after = FIRST_WARNING_S
            elif time.monotonic() - idle_since >= warn_after:
                _LOG.warning(
                    "%s has had no worker for %.0f s; waiting for one",
                    self._name,
                    warn_after,
                )
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
        lost: tuple[type[BaseException], ...] = (OSError, ValueError, *_lost_of_dask())
        try:
            return sum(self._client.nthreads().values())
        except lost as error:
            # Includes time-outs and closed connections.
            raise MachineError(
                f"the connection to {self._name} is lost: {error}"
            ) from error

    def prepared(self, function: Callable[[T], R]) -> Callable[[T], Any]:
        return partial(self._client.submit, function, pure=False)

    def finished(self, tickets: Sequence[Any], seconds: float) -> Sequence[Any]:
        from distributed import wait

        try:
            with self._client.as_current():
                return list(
                    wait(tickets, timeout=seconds, return_when="FIRST_COMPLETED").done
                )
        except TimeoutError:
            return []
        except _lost_of_dask() as error:
            raise MachineError(f"the connection to {self._name} is lost") from error

    def result(self, ticket: Any) -> Any:
        from distributed.scheduler import KilledWorker

        try:
            return ticket.result()
        except KilledWorker as error:
            raise MachineError(DIED) from error
        except _lost_of_dask() as error:
            raise MachineError(f"the connection to {self._name} is lost") from error

    def cancel(self, tickets: Sequence[Any]) -> None:
        # Errors of a cancellation are irrelevant.
        with suppress(Exception):
            self._client.cancel(tickets)


def _lost_of_dask() -> tuple[type[BaseException], ...]:
    from asyncio import CancelledError as AsyncioCancelledError
    from concurrent.futures import CancelledError

    from distributed import client
    from distributed.comm import CommClosedError

    names = ("FutureCancelledError", "FuturesCancelledError")
    cancelled = [getattr(client, name) for name in names if hasattr(client, name)]
    return CancelledError, AsyncioCancelledError, CommClosedError, *cancelled


class _Ray(Cluster):
    _checked_at = 0.0  # time of the last check of the head [s]

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

        # Without its head, ray ends this process after a minute.
        if time.monotonic() - self._checked_at > POLL_INTERVAL_S:
            _check_reachable(ray.get_runtime_context().gcs_address, self._name)
            self._checked_at = time.monotonic()
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
            # Errors of a cancellation are irrelevant.
            with suppress(Exception):
                ray.cancel(ticket)


def _call(function: Callable[[T], R], task: T) -> R:
    """Run a function on a task; ray transfers the function only once."""
    return function(task)


@contextmanager
def joined(name: str, address: str | None, workers: int | None) -> Iterator[Cluster]:
    """Connect to a cluster of dask or ray, or start one on this machine, for the duration of the block.

    The number of tasks that run at once is that of the workers of the cluster by
    default.

    Raises:
        MissingExtraError: The package is not installed.
        MachineError: The cluster cannot be reached.
    """
    module, join = {"dask": ("distributed", _dask), "ray": ("ray", _ray)}[name]
    with requires_extra(name, module):
        if (
            name == "ray"
            and address is None
            and importlib.util.find_spec(module) is not None
        ):
            _prepare_ray()
        importlib.import_module(module)
    what = f"the {name} cluster " + (f"at {address}" if address else "on this machine")
    if address is not None:
        _check_reachable(address, what)
    with join(address, workers, what) as cluster:
        yield cluster


@contextmanager
def _dask(address: str | None, workers: int | None, what: str) -> Iterator[Cluster]:
    from distributed import Client

    with _dask_silenced():
        cluster = None
        try:
            if address is not None:
                client = Client(
                    address, set_as_default=False, timeout=CONNECTION_TIMEOUT_S
                )
            else:
                # Local workers do not receive the Ctrl-C of a terminal.
                with signals_blocked():
                    cluster = _local_dask(workers)
                    client = Client(
                        cluster, set_as_default=False, security=cluster.security
                    )
        except (
            OSError,
            ValueError,
            TypeError,
            RuntimeError,
            MemoryError,
        ) as error:
            # Memory: of a foreign answer.
            raise MachineError(
                f"cannot reach {what}: {str(error) or 'it is no scheduler'}"
            ) from error
        try:
            yield _Dask(client, what, workers)
        finally:
            for part in (client, cluster):
                if part is not None:
                    # The scheduler is gone.
                    with suppress(OSError, RuntimeError):
                        part.close(timeout=CLOSING_TIMEOUT_S)


def _local_dask(workers: int | None) -> Any:
    """Start a scheduler and workers on this machine that accept only processes with their temporary certificate."""
    from distributed import LocalCluster
    from distributed.security import Security

    with requires_extra("dask", "cryptography"):
        security = Security.temporary()
    config = importlib.import_module("dask.config")
    # Its HTTP server has no authentication.
    with config.set({"distributed.scheduler.http.routes": []}):
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            host=LOOPBACK,
            protocol="tls",
            security=security,
            dashboard_address=f"{LOOPBACK}:0",
            scheduler_kwargs={"dashboard": False},
            # Terminated workers log irrelevant errors.
            silence_logs=logging.CRITICAL,
        )


@contextmanager
def _dask_silenced() -> Iterator[None]:
    """Silence the logs of lost connections, which ``_Dask`` reports."""
    known = list(logging.root.manager.loggerDict)
    names = [
        name
        for name in known
        if name.partition(".")[0] in {"distributed", "tornado", "asyncio"}
    ]
    before = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


@contextmanager
def _ray(address: str | None, workers: int | None, what: str) -> Iterator[Cluster]:
    import ray

    ours = not ray.is_initialized()
    if ours:
        here = {
            "num_cpus": workers,
            "include_dashboard": False,
            "_node_ip_address": LOOPBACK,
        }
        try:
            with (
                nullcontext() if address else signals_blocked(),
                nullcontext() if address else _on_loopback(),
            ):
                ray.init(
                    address or "local",
                    log_to_driver=False,
                    logging_level=logging.CRITICAL,
                    **({} if address else here),
                )
        except Exception as error:
            raise MachineError(
                f"cannot reach {what}: {' '.join(str(error).split())}"
            ) from error
    try:
        yield _Ray(what, workers)
    finally:
        if ours:
            ray.shutdown()


@contextmanager
def _on_loopback() -> Iterator[None]:
    """Let ray use the loopback interface, as it does on macOS.

    It replaces ``_node_ip_address`` otherwise.
    """
    from ray._private import ray_constants

    before = getattr(ray_constants, "ENABLE_RAY_CLUSTER", True)
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


def _prepare_ray() -> None:
    """Let local ray clusters of this process accept only processes with its token.

    Ray reads it on import.
    """
    version = importlib.metadata.version("ray")
    if tuple(int(part) for part in version.split(".")[:2]) < MIN_RAY_VERSION:
        least = ".".join(map(str, MIN_RAY_VERSION))
        raise MachineError(
            f"ray {version} starts clusters without authentication: pip install 'ray>={least}'"
        )
    if os.environ.get("RAY_AUTH_MODE") == "token":
        return
    ray = sys.modules.get("ray")
    if ray is None:
        os.environ.update(RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=secrets.token_hex(32))
    elif not ray.is_initialized():
        raise MachineError(
            "ray was imported without a token: set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN before"
        )


def check_address(name: str, address: str) -> None:
    """Check the form of the address of a cluster.

    Raises:
        UsageError: It is no address of a cluster of this kind.
    """
    pattern, examples = _ADDRESSES[name]
    if not re.fullmatch(pattern, address):
        raise UsageError(
            f"must be the address of a {name} cluster, such as {examples}, got {address!r}",
            argument="address",
        )


def _check_reachable(address: str, what: str) -> None:
    """Connect once to the host and port of an address.

    The libraries wait longer, and report less.
    """
    found = re.search(r"(?:^|//)([^/]+):(\d+)$", address)
    if found is None:
        return
    host = found.group(1).strip("[]")
    port = int(found.group(2))
    try:
        socket.create_connection((host, port), timeout=CONNECTION_TIMEOUT_S).close()
    except OSError as error:
        raise MachineError(f"cannot reach {what}: {error.strerror or error}") from error
