"""The engines "dask" and "ray" by their names."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import ClassVar

from cnpgen.addons.clusters.clusters import Cluster, check_address, joined
from cnpgen.machine.engine import ClusterEngine


@dataclass(frozen=True)
class _NamedEngine(ClusterEngine):
    name: ClassVar[str]

    def check_address(self, address: str) -> None:
        check_address(self.name, address)

    def joined(
        self, address: str | None, workers: int | None
    ) -> AbstractContextManager[Cluster]:
        return joined(self.name, address, workers)


@dataclass(frozen=True)
class DaskEngine(_NamedEngine):
    """Engine: a scheduler of dask with its workers."""

    name = "dask"


@dataclass(frozen=True)
class RayEngine(_NamedEngine):
    """Engine: a cluster of ray."""

    name = "ray"
