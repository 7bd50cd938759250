"""Observations of scenes: clouds, views, signed distances, basis points and tokens."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import AnyArray, Columns, Vector3
from cnpgen.errors import UsageError, nearest
from cnpgen.robots.observation.camera import Camera
from cnpgen.robots.observation.primitives import KINDS, MESH, Primitives
from cnpgen.robots.observation.surface_points import Seeds
from cnpgen.schema.argument_types import check_fields
from cnpgen.schema.arguments import integer

Values = NDArray[np.float32]

MAX_OBSERVED_POINTS = 10_000_000  # of one observation of one scene
MIN_GRID_EXTENT_M = 1e-6
# Corners of the default grids, around an arm like the Panda [m].
WORKSPACE = (-0.9, -0.9, -0.1), (0.9, 0.9, 1.1)


class ObservationBackend(Protocol):
    """Functions of N scenes, which are primitives with a first axis of length N."""

    def distances(self, scenes: Primitives, points: AnyArray) -> Values:
        """Return the smallest signed distance of points from the bodies of each scene [m], shape (N, P).

        Points in the world frame [m] have shape (P, 3) for all scenes or (N, P, 3).
        Without bodies distances are inf.
        """

    def surface_points(self, scenes: Primitives, count: int, seeds: Seeds) -> Values:
        """Return points on the surfaces of each scene [m], shape (N, count, 3).

        Their density is uniform in area, and they are ordered by body; nan without
        bodies. Points inside of another body are kept. Within a part of a surface they
        form a Kronecker sequence, which is more even than random points.
        """

    def depth_images(self, scenes: Primitives, camera: Camera) -> Values:
        """Return distances along the camera's axis at the centers of the pixels [m], shape (N, height, width).

        Pixels that see no body have inf. Bodies that contain the camera are not seen.
        """

    def depth_points(
        self, depth: Values, camera: Camera, count: int, seeds: Seeds
    ) -> Values:
        """Return points of depth images [m], evenly distributed over the pixels that see a body, shape (N, count, 3).

        They repeat if there are fewer such pixels, and are nan if there are none.
        """


class Observation(ABC):
    """Kind of observation with its parameters; frozen dataclasses."""

    name: ClassVar[str]

    @abstractmethod
    def observe(
        self, bodies: Primitives, seeds: Seeds, backend: ObservationBackend
    ) -> Columns:
        """Observe N scenes from their bodies and seeds, shape (N,): name -> array with a first axis of length N."""


@dataclass(frozen=True, kw_only=True)
class SurfaceCloud(Observation):
    """Points on the full surface of all bodies: ``cloud``, shape (N, points, 3), float32, m; nan without bodies.

    Attributes:
        points: Number of points.
    """

    name = "cloud"
    points: int = 4096

    def __post_init__(self) -> None:
        check_fields(self)
        integer("points", self.points, least=1, most=MAX_OBSERVED_POINTS)

    def observe(
        self, bodies: Primitives, seeds: Seeds, backend: ObservationBackend
    ) -> Columns:
        """See ``Observation``."""
        return {"cloud": backend.surface_points(bodies, self.points, seeds)}


@dataclass(frozen=True, kw_only=True)
class CameraCloud(Observation):
    """Points that a camera sees: ``camera_cloud``, shape (N, points, 3), float32, m; nan if it sees no body.

    Attributes:
        points: Number of points; they repeat where fewer pixels see a body.
        camera: The camera. The robot does not hide bodies from it.
    """

    name = "camera"
    points: int = 4096
    camera: Camera = field(default_factory=Camera)

    def __post_init__(self) -> None:
        check_fields(self)
        integer("points", self.points, least=1, most=MAX_OBSERVED_POINTS)

    def observe(
        self, bodies: Primitives, seeds: Seeds, backend: ObservationBackend
    ) -> Columns:
        """See ``Observation``."""
        depth = backend.depth_images(bodies, self.camera)
        return {
            "camera_cloud": backend.depth_points(depth, self.camera, self.points, seeds)
        }


@dataclass(frozen=True, kw_only=True)
class DistanceGrid(Observation):
    """Signed distances at the points of a grid: ``distances`` [m], shape (N, X, Y, Z), float32; inf without bodies.

    Attributes:
        low: Lower corner of the grid in the world frame [m].
        high: Upper corner [m].
        shape: Numbers of points along x, y and z, both ends included.
    """

    name = "distances"
    low: Vector3 = WORKSPACE[0]
    high: Vector3 = WORKSPACE[1]
    shape: tuple[int, int, int] = (32, 32, 32)

    def __post_init__(self) -> None:
        check_fields(self)
        _check_corners(self.low, self.high)
        if (
            min(self.shape) < 1
            or np.prod(self.shape, dtype=float) > MAX_OBSERVED_POINTS
        ):
            raise UsageError(
                f"must be positive with at most {MAX_OBSERVED_POINTS:,} points, got {self.shape}",
                argument="shape",
            )

    def observe(
        self,
        bodies: Primitives,
        seeds: Seeds,  # noqa: ARG002
        backend: ObservationBackend,
    ) -> Columns:
        """See ``Observation``."""
        axes = [
            np.linspace(*ends)
            for ends in zip(self.low, self.high, self.shape, strict=True)
        ]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return {"distances": backend.distances(bodies, points).reshape(-1, *self.shape)}


@dataclass(frozen=True, kw_only=True)
class BasisPoints(Observation):
    """Signed distances at fixed points that fill a box: ``basis``, shape (N, points), float32, m; inf without bodies.

    Attributes:
        points: Number of points.
        low: Lower corner of the box in the world frame [m].
        high: Upper corner [m].
    """

    name = "basis"
    points: int = 512
    low: Vector3 = WORKSPACE[0]
    high: Vector3 = WORKSPACE[1]

    def __post_init__(self) -> None:
        check_fields(self)
        integer("points", self.points, least=1, most=MAX_OBSERVED_POINTS)
        _check_corners(self.low, self.high)

    @property
    def positions(self) -> AnyArray:
        """The points, a Kronecker sequence [m], shape (points, 3)."""
        # Of x^4 = x + 1.
        root = 1.2207440846057596
        steps = np.arange(1, self.points + 1)[:, None] / root ** np.arange(1, 4)
        return np.asarray(
            np.array(self.low) + (steps + 0.5) % 1.0 * np.subtract(self.high, self.low)
        )

    def observe(
        self,
        bodies: Primitives,
        seeds: Seeds,  # noqa: ARG002
        backend: ObservationBackend,
    ) -> Columns:
        """See ``Observation``."""
        return {"basis": backend.distances(bodies, self.positions)}


@dataclass(frozen=True, kw_only=True)
class ObjectTokens(Observation):
    """A row per body: ``tokens``, shape (N, capacity, 16), float32, and ``mask``, shape (N, capacity).

    The numbers of a row are the kind (one of box, sphere, cylinder and capsule is 1),
    the center [m], the first two columns of the rotation matrix, and the sizes [m] as
    in ``Primitives``. A mesh is its bounding box. Rows without a body are 0.

    Attributes:
        capacity: Number of rows; by default the largest number of bodies.
    """

    name = "tokens"
    capacity: int | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.capacity is not None:
            integer("capacity", self.capacity, least=1)

    def observe(
        self,
        bodies: Primitives,
        seeds: Seeds,  # noqa: ARG002
        backend: ObservationBackend,  # noqa: ARG002
    ) -> Columns:
        """See ``Observation``."""
        real = bodies.kinds >= 0
        order = np.argsort(~real, axis=1, kind="stable")  # bodies first
        most = int(real.sum(axis=1).max(initial=0))
        capacity = most if self.capacity is None else self.capacity
        if most > capacity:
            raise UsageError(
                f"must be at least {most}, the largest number of bodies",
                argument="capacity",
            )
        axes = bodies.rotations[..., :2].swapaxes(2, 3).reshape(*real.shape, 6)
        shapes = np.where(bodies.kinds >= MESH, KINDS.index("box"), bodies.kinds)
        kinds = shapes[..., None] == np.arange(len(KINDS))
        rows: AnyArray = np.concatenate(
            [kinds, bodies.centers, axes, bodies.sizes], axis=2
        ).astype(np.float32)
        rows[~real] = 0
        padding = ((0, 0), (0, max(capacity - real.shape[1], 0)), (0, 0))
        rows, mask = (
            np.pad(np.take_along_axis(values, order[..., None], axis=1), padding)[
                :, :capacity
            ]
            for values in (rows, real[..., None])
        )
        return {"tokens": rows, "mask": mask[..., 0]}


OBSERVATIONS: Mapping[str, type[Observation]] = {
    kind.name: kind
    for kind in (SurfaceCloud, CameraCloud, DistanceGrid, BasisPoints, ObjectTokens)
}


def as_observation(kind: str | Observation) -> Observation:
    """Return an observation by its name, with default parameters.

    Return observations unchanged.
    """
    if isinstance(kind, Observation):
        return kind
    if kind not in OBSERVATIONS:
        known = ", ".join(OBSERVATIONS)
        raise UsageError(
            f"must be one of {known}, or an Observation, got {kind!r:.100}{nearest(str(kind), OBSERVATIONS)}",
            argument="kind",
        )
    return OBSERVATIONS[kind]()


def _check_corners(low: Vector3, high: Vector3) -> None:
    if not (
        np.isfinite([*low, *high]).all()
        and (np.subtract(high, low) >= MIN_GRID_EXTENT_M).all()
    ):
        raise UsageError(
            f"must be finite and above the lower corner {low}, got {high}",
            argument="high",
        )
