"""Depth images of a camera by ray casting, and their points: the NumPy reference of ``observe.c``."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.robots.observation.primitives import KINDS, Primitives
from cnpgen.robots.observation.surface_points import unit_offset
from cnpgen.schema.argument_types import check_fields
from cnpgen.schema.arguments import integer
from cnpgen.schema.units import suggested_unit

MAX_PIXELS = 4096  # of one side of an image
MIN_VIEW_DISTANCE_M = 1e-6
MIN_RAY = 1e-9  # of the coordinates of a ray


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Pinhole camera that looks at a point; the image is upright with respect to the world's z axis.

    Attributes:
        position: Position in the world frame [m].
        target: Point at the center of the image [m].
        width: Number of pixels of a row.
        height: Number of rows.
        field_of_view: Angle between the left and the right edge of the image [rad].
    """

    position: tuple[float, float, float] = (1.3, 0.9, 1.1)
    target: tuple[float, float, float] = (0.4, 0.0, 0.2)
    width: int = 160
    height: int = 120
    field_of_view: float = 1.2

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("width", "height"):
            integer(name, getattr(self, name), least=1, most=MAX_PIXELS)
        if not 0 < self.field_of_view < math.pi:
            hint = suggested_unit(self.field_of_view, "rad", 0.0, math.pi)
            raise UsageError(
                f"must be above 0 and below pi, got {self.field_of_view:g}{hint}",
                argument="field_of_view",
            )
        if (
            not np.isfinite([*self.position, *self.target]).all()
            or math.dist(self.position, self.target) < 1e-6
        ):
            raise UsageError(
                f"must be finite and away from the position {self.position}, got {self.target}",
                argument="target",
            )

    @property
    def axes(self) -> Array:
        """Rows: the unit vector forward, and the vectors from the center to the right and the lower edge at 1 m."""
        forward = np.subtract(self.target, self.position, dtype=float)
        forward /= np.linalg.norm(forward)
        # Where the camera looks up or down, y takes the place of the vertical.
        up = (
            (0.0, 0.0, 1.0)
            if math.hypot(*forward[:2]) > MIN_VIEW_DISTANCE_M
            else (0.0, 1.0, 0.0)
        )
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        half = math.tan(self.field_of_view / 2)
        return np.stack(
            [
                forward,
                half * right,
                half * self.height / self.width * np.cross(forward, right),
            ]
        )


def depth_image(primitives: Primitives, camera: Camera) -> Array:
    """Compute distances along the camera's axis at the centers of the pixels [m], shape (height, width).

    Pixels that see no body have inf. Bodies that contain the camera are not seen.
    """
    # Centers of pixels in [-1, 1].
    x, y = (
        (2 * np.arange(count) + 1) / count - 1
        for count in (camera.width, camera.height)
    )
    forward, right, down = camera.axes
    rays = (forward + x[None, :, None] * right + y[:, None, None] * down).reshape(-1, 3)
    depth = np.full(len(rays), np.inf)
    # In the frame of each body, where its faces are coordinate planes.
    for index in range(len(primitives)):
        rotation, size = primitives.rotations[index], primitives.sizes[index]
        origin = (np.array(camera.position) - primitives.centers[index]) @ rotation
        mesh, local = primitives.mesh(index), rays @ rotation
        # Rays along a face.
        local[np.abs(local) < MIN_RAY] = MIN_RAY
        hits = (
            [mesh.entries(origin, local)]
            if mesh
            else _hits(KINDS[primitives.kinds[index]], size, origin, local)
        )
        for hit in hits:
            depth = np.where((hit > 0) & (hit < depth), hit, depth)
    return depth.reshape(camera.height, camera.width)


def depth_points(depth: Array, camera: Camera, count: int, seed: np.uint64) -> Array:
    """Return points of a depth image [m], evenly distributed over the pixels that see a body, shape (count, 3).

    They repeat if there are fewer such pixels, and are nan if there are none. The seed
    is that of the scene.
    """
    seen = np.flatnonzero(np.isfinite(depth))
    if not len(seen):
        return np.full((count, 3), np.nan)
    # The same offset for all points: one in each of ``count`` equal sections of the
    # list.
    places = ((np.arange(count) + unit_offset(seed)) / count * len(seen)).astype(
        np.int64
    )
    pixels = seen[np.minimum(places, len(seen) - 1)]
    row, column = np.divmod(pixels, camera.width)
    forward, right, down = camera.axes
    x, y = (2 * column + 1) / camera.width - 1, (2 * row + 1) / camera.height - 1
    rays = forward + x[:, None] * right + y[:, None] * down
    return np.asarray(camera.position + depth.ravel()[pixels, None] * rays)


def _hits(kind: str, size: Array, origin: Array, ray: Array) -> list[Array]:
    """Return where rays enter the parts of a body, in lengths of the rays, shape (P,) each; nan for none."""
    with np.errstate(all="ignore"):
        if kind == "box":
            # Slabs: center and half width of the time that a ray spends between two
            # faces.
            center, width = -origin / ray, np.abs(size / ray)
            return [_entry((center - width).max(axis=1), (center + width).min(axis=1))]
        radius, half = size[0], size[1]
        a = (ray[:, :2] ** 2).sum(axis=1)
        f = ray[:, :2] @ origin[:2]
        # Quadratic a t^2 + 2 f t + |o|^2 - r^2 = 0 in the plane across the axis.
        # Nan: no intersection.
        root = np.sqrt(f**2 - a * (origin[:2] @ origin[:2] - radius**2))
        enter, leave = (-f - root) / a, (-f + root) / a
        if kind == "cylinder":
            center, width = -origin[2] / ray[:, 2], np.abs(half / ray[:, 2])
            return [
                _entry(
                    np.maximum(enter, center - width), np.minimum(leave, center + width)
                )
            ]
        side = np.where(np.abs(origin[2] + enter * ray[:, 2]) <= half, enter, np.nan)
        return [
            side,
            *(_ball(radius, origin - [0, 0, end * half], ray) for end in (-1, 1)),
        ]


def _entry(enter: Array, leave: Array) -> Array:
    return np.where(enter <= leave, enter, np.nan)


def _ball(radius: float, origin: Array, ray: Array) -> Array:
    a, f = (ray**2).sum(axis=1), ray @ origin
    return np.asarray((-f - np.sqrt(f**2 - a * (origin @ origin - radius**2))) / a)
