"""Engines that run distributed work: processes of this machine, or a cluster of dask or ray."""

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from cnpgen.errors import UsageError, nearest
from cnpgen.machine.workers import distribute, worker_count
from cnpgen.schema.arguments import integer

if TYPE_CHECKING:
    from cnpgen.machine.clusters import Cluster

CLUSTERS = ("dask", "ray")
ENGINES = ("loky", *CLUSTERS)

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Engine:
    """User's choice of the engine.

    Attributes:
        name: "loky" for processes of this machine, which end with this one; "dask" or "ray" for a cluster. None for
            loky, or the backend of ``joblib.parallel_config``.
        address: Address of dask's scheduler ("tcp://host:8786") or ray's head ("host:6379", "auto"). None for a
            temporary cluster on this machine.
        workers: Number of tasks that run at once; None for one per available core.

    Raises:
        UsageError: The engine does not exist or has no address, or there is less than one worker.
    """

    name: str | None = None
    address: str | None = None
    workers: int | None = None

    def __post_init__(self) -> None:
        if self.workers is not None:
            integer("workers", self.workers, least=1)
        if self.name is not None and self.name not in ENGINES:
            expected = f"expected one of {', '.join(ENGINES)}{nearest(str(self.name), ENGINES)}"
            raise UsageError(f"engine {self.name!r} does not exist: {expected}", concerns="engine")
        if self.address is not None and self.name not in CLUSTERS:
            raise UsageError(
                f"the address {self.address!r} is that of a cluster: choose {{engine}} dask or ray",
                remedies={"engine": None},
            )
        if self.address is not None and self.name is not None:
            from cnpgen.machine.clusters import check_address

            check_address(self.name, self.address)


@dataclass(frozen=True)
class LocalPool:
    """Processes of this machine, or a backend of joblib.

    Attributes:
        size: Number of tasks that run at once.
        is_remote: Whether workers may be on other machines, with other working directories and caches.
    """

    size: int
    is_remote: bool = False

    def distribute(
        self, function: Callable[[T], R], tasks: Iterable[T], *, ordered: bool = False, hint: str = ""
    ) -> Generator[R, None, None]:
        """Run a function on every task and yield the results; see ``cnpgen.machine.workers.distribute``."""
        return distribute(function, tasks, self.size, ordered=ordered, hint=hint)


WorkerPool: TypeAlias = "LocalPool | Cluster"


@contextmanager
def assembled(engine: Engine, tasks: int, *, quick: bool = False) -> Iterator[WorkerPool]:
    """Provide a worker pool for the block: start processes or connect to a cluster.

    Args:
        engine: Choice of the engine.
        tasks: Number of tasks, the maximum number of local workers.
        quick: Whether one process finishes before a second one has started; ignored if the user chose a number of
            workers or a cluster.

    Raises:
        UsageError: The engine's package is not installed.
        MachineError: The cluster cannot be reached.
    """
    if engine.name in CLUSTERS:
        from cnpgen.machine.clusters import joined

        with joined(engine.name, engine.address, engine.workers) as cluster:
            yield cluster
        return
    backend: AbstractContextManager[object] = nullcontext()
    if engine.name == "loky":
        from joblib import parallel_config

        backend = parallel_config(backend="loky")
    with backend:
        yield LocalPool(worker_count(1 if quick and engine.workers is None else engine.workers, tasks))
