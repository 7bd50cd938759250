"""Engines that run distributed work: processes of this machine, or a cluster of an installed engine."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Protocol, TypeVar

from cnpgen.errors import UsageError, either, nearest
from cnpgen.machine.workers import distribute, worker_count
from cnpgen.schema import addons, registry
from cnpgen.schema.arguments import integer

LOKY = "loky"  # joblib's processes on this machine

T = TypeVar("T")
R = TypeVar("R")


class WorkerPool(Protocol):
    """Workers that run tasks."""

    @property
    def size(self) -> int:
        """Number of tasks that run at once."""

    @property
    def is_remote(self) -> bool:
        """Whether workers may be on other machines, with other working directories and caches."""

    def distribute(
        self,
        function: Callable[[T], R],
        tasks: Iterable[T],
        *,
        ordered: bool = False,
        hint: str = "",
    ) -> Generator[R, None, None]:
        """Run a function on every task and yield the results.

        See ``cnpgen.machine.workers.distribute``.
        """


class ClusterEngine(ABC):
    """Contract of an engine that runs tasks on a cluster.

    Packages register them in the group ``cnpgen.engines``.
    """

    @abstractmethod
    def check_address(self, address: str) -> None:
        """Raise UsageError if a text cannot be the address of a cluster of this engine."""

    @abstractmethod
    def joined(
        self, address: str | None, workers: int | None
    ) -> AbstractContextManager[WorkerPool]:
        """Connect to a cluster for a block; without an address, start one on this machine.

        Raises:
            MissingExtraError: The package of the engine is not installed.
            MachineError: The cluster cannot be reached.
        """


def cluster_engine(name: str) -> ClusterEngine:
    """Load an installed engine by its name.

    Raise MissingAddonError if its add-on is missing.
    """
    engine: ClusterEngine = registry.load(registry.ENGINES, name)()
    return engine


@dataclass(frozen=True)
class Engine:
    """User's choice of the engine.

    Attributes:
        name: "loky" for processes of this machine, which end with this one, or a
            cluster engine, such as "dask" or "ray". None for loky, or the backend of
            ``joblib.parallel_config``.
        address: Address of dask's scheduler ("tcp://host:8786") or ray's head
            ("host:6379", "auto"). None for a temporary cluster on this machine.
        workers: Number of tasks that run at once; None for one per available core.

    Raises:
        UsageError: The engine does not exist or has no address, or there is less than
            one worker.
    """

    name: str | None = None
    address: str | None = None
    workers: int | None = None

    def __post_init__(self) -> None:
        if self.workers is not None:
            integer("workers", self.workers, least=1)
        if self.name is not None and not is_engine(self.name):
            known = engine_names()
            hint = nearest(str(self.name), known)
            raise UsageError(
                f"engine {self.name!r} does not exist: "
                f"expected one of {', '.join(known)}{hint}",
                concerns="engine",
            )
        # The address is checked before any work, since connecting may take long.
        if self.name is not None and self.is_cluster:
            engine = cluster_engine(self.name)
            if self.address is not None:
                engine.check_address(self.address)
        elif self.address is not None:
            clusters = either(registry.names(registry.ENGINES))
            raise UsageError(
                f"the address {self.address!r} is that of a cluster: choose {{engine}} {clusters}",
                remedies={"engine": None},
            )

    @property
    def is_cluster(self) -> bool:
        """Whether the workers are those of a cluster."""
        return self.name not in {None, LOKY}


def is_engine(name: object) -> bool:
    """Return whether a package registers an engine of this name; engines of missing add-ons have names, too."""
    if name == LOKY:
        return True
    return isinstance(name, str) and addons.find(registry.ENGINES, name) is not None


def engine_names() -> tuple[str, ...]:
    """List the names of the installed engines."""
    return (LOKY, *registry.names(registry.ENGINES))


@dataclass(frozen=True)
class LocalPool:
    """Processes of this machine, or a backend of joblib.

    Attributes:
        size: Number of tasks that run at once.
        is_remote: Whether workers may be on other machines, with other working
            directories and caches.
    """

    size: int
    is_remote: bool = False

    def distribute(
        self,
        function: Callable[[T], R],
        tasks: Iterable[T],
        *,
        ordered: bool = False,
        hint: str = "",
    ) -> Generator[R, None, None]:
        """Run a function on every task and yield the results.

        See ``cnpgen.machine.workers.distribute``.
        """
        return distribute(function, tasks, self.size, ordered=ordered, hint=hint)


@contextmanager
def assembled(
    engine: Engine, tasks: int, *, quick: bool = False
) -> Iterator[WorkerPool]:
    """Provide a worker pool for the block: start processes or connect to a cluster.

    Args:
        engine: Choice of the engine.
        tasks: Number of tasks, the maximum number of local workers.
        quick: Whether one process finishes before a second one has started; ignored if
            the user chose a number of workers or a cluster.

    Raises:
        UsageError: The engine's package is not installed.
        MachineError: The cluster cannot be reached.
    """
    if engine.name is not None and engine.is_cluster:
        with cluster_engine(engine.name).joined(
            engine.address, engine.workers
        ) as cluster:
            yield cluster
        return
    backend: AbstractContextManager[object] = nullcontext()
    if engine.name == LOKY:
        from joblib import parallel_config

        backend = parallel_config(backend="loky")
    with backend:
        yield LocalPool(
            worker_count(
                1 if quick and engine.workers is None else engine.workers, tasks
            )
        )
