"""Where work is shared out to: processes of this machine, or a cluster of dask or ray."""

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Protocol, TypeVar

from cnpgen.errors import UsageError, nearest
from cnpgen.machine.workers import share_out, worker_count
from cnpgen.schema.arguments import integer

CLUSTERS = ("dask", "ray")
ENGINES = ("loky", *CLUSTERS)

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Engine:
    """What users choose about where work runs.

    Attributes:
        name: "loky": processes of this machine, which end with this one; "dask" or "ray": a cluster. None: loky, or
            whatever backend ``joblib.parallel_config`` names.
        address: Of the cluster: of dask's scheduler ("tcp://host:8786"), of ray's head ("host:6379", "auto"). None: a
            cluster on this machine, for this run.
        workers: Tasks that run at once; None: one per core that there is.

    Raises:
        UsageError: There is no such engine, it has no address, or there are fewer than one worker.
    """

    name: str | None = None
    address: str | None = None
    workers: int | None = None

    def __post_init__(self) -> None:
        if self.workers is not None:
            integer("workers", self.workers, least=1)
        if self.name is not None and self.name not in ENGINES:
            expected = f"expected one of {', '.join(ENGINES)}{nearest(str(self.name), ENGINES)}"
            raise UsageError(f"engine {self.name!r} does not exist: {expected}")
        if self.address is not None and self.name not in CLUSTERS:
            raise UsageError(
                f"the address {self.address!r} is that of a cluster: say of which with engine= (dask, ray)"
            )


class Team(Protocol):
    """Those who share the work."""

    @property
    def size(self) -> int:
        """Tasks that run at once."""

    @property
    def is_far(self) -> bool:
        """Whether they may be on other machines, with another working directory and other caches."""

    def share_out(
        self, function: Callable[[T], R], tasks: Iterable[T], *, ordered: bool = False, advice: str = ""
    ) -> Generator[R, None, None]:
        """Run a function on every task and yield the results; see ``cnpgen.machine.workers.share_out``."""


@dataclass(frozen=True)
class _Near:
    """Processes of this machine, or a backend of joblib."""

    size: int
    is_far: bool = False

    def share_out(
        self, function: Callable[[T], R], tasks: Iterable[T], *, ordered: bool = False, advice: str = ""
    ) -> Generator[R, None, None]:
        return share_out(function, tasks, self.size, ordered=ordered, advice=advice)


@contextmanager
def assembled(engine: Engine, tasks: int, *, quick: bool = False) -> Iterator[Team]:
    """Assemble those who share the work of the block: start processes, or join a cluster, which is left at its end.

    Args:
        engine: Where to.
        tasks: How many tasks there are; more workers are of no use.
        quick: Whether one process is faster than the start of a second one; not asked if somebody said how many, or
            which cluster.

    Raises:
        UsageError: The engine's package is not installed.
        MachineError: The cluster cannot be reached.
    """
    if engine.name in CLUSTERS:
        from cnpgen.machine.clusters import joined

        with joined(engine.name, engine.address, engine.workers) as cluster:
            yield cluster
        return
    with _on_loky() if engine.name == "loky" else nullcontext():
        yield _Near(worker_count(1 if quick and engine.workers is None else engine.workers, tasks))


def _on_loky() -> AbstractContextManager[object]:
    from joblib import parallel_config

    config: AbstractContextManager[object] = parallel_config(backend="loky")
    return config
