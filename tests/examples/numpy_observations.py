"""Observations of scenes in NumPy: the reference of ``observe.c``."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.robots.observation.camera import Camera
from cnpgen.robots.observation.primitives import KINDS, ConvexMesh, Primitives
from cnpgen.robots.observation.surface_points import Seeds, mixed

Values = NDArray[np.float32]
# 2^32 / g and 2^32 / g^2 with g^3 = g + 1: low discrepancy
STEPS = np.array([3242174889, 2447445414], np.uint32)
MIN_RAY = 1e-9  # of the coordinates of a ray
POINTS_PER_CHUNK = 65_536  # keeps the temporary arrays of one primitive in the cache


def bodies_of(scenes: Primitives, index: int) -> Primitives:
    """Return the bodies of one of N scenes, without padding."""
    scene = scenes[index]
    return scene[scene.kinds >= 0]


class NumpyObservations:
    """Functions of N scenes, which are primitives with a first axis of length N: see ``ObservationBackend``."""

    def distances(self, scenes: Primitives, points: Array) -> Values:
        """Return the smallest signed distance of points from the bodies of each scene [m], shape (N, P).

        Points in the world frame [m] have shape (P, 3) for all scenes or (N, P, 3).
        Without bodies distances are inf.
        """
        points = np.broadcast_to(points, (len(scenes), *points.shape[-2:]))
        parts = [
            smallest_signed_distances(bodies_of(scenes, i), points[i])
            for i in range(len(scenes))
        ]
        return _stacked(parts, points.shape[1:2])

    def surface_points(self, scenes: Primitives, count: int, seeds: Seeds) -> Values:
        """Return points on the surfaces of each scene [m], shape (N, count, 3).

        See ``surface_points``.
        """
        parts = [
            surface_points(bodies_of(scenes, i), count, seeds[i])
            for i in range(len(scenes))
        ]
        return _stacked(parts, (count, 3))

    def depth_images(self, scenes: Primitives, camera: Camera) -> Values:
        """Return depth images [m], shape (N, height, width); see ``depth_image``."""
        parts = [depth_image(bodies_of(scenes, i), camera) for i in range(len(scenes))]
        return _stacked(parts, (camera.height, camera.width))

    def depth_points(
        self, depth: Values, camera: Camera, count: int, seeds: Seeds
    ) -> Values:
        """Return points of depth images [m], shape (N, count, 3).

        See ``depth_points``.
        """
        parts = [
            depth_points(image, camera, count, seed)
            for image, seed in zip(depth, seeds, strict=True)
        ]
        return _stacked(parts, (count, 3))


def _stacked(parts: list[Array], shape: tuple[int, ...]) -> Values:
    return np.array(parts, np.float32).reshape(len(parts), *shape)


def smallest_signed_distances(primitives: Primitives, points: Array) -> Array:
    """Compute the smallest signed distance of points from any primitive [m], shape (P,); inf without primitives."""
    smallest = np.full(len(points), np.inf)
    for index in range(len(primitives)):
        np.minimum(
            smallest,
            signed_distances(primitives[np.array([index])], points)[0],
            out=smallest,
        )
    return smallest


def signed_distances(primitives: Primitives, points: Array) -> Array:
    """Compute the signed distances of P world points from M primitives [m], negative inside, shape (M, P)."""
    distances = np.empty((len(primitives), len(points)))
    for index in range(len(primitives)):
        mesh = primitives.mesh(index)
        kind = int(primitives.kinds[index])
        size = primitives.sizes[index]
        # Chunks of points whose temporary arrays fit the cache.
        for first in range(0, len(points), POINTS_PER_CHUNK):
            part = slice(first, first + POINTS_PER_CHUNK)
            local = (points[part] - primitives.centers[index]) @ primitives.rotations[
                index
            ]
            distances[index, part] = (
                _mesh_distances(mesh, local) if mesh else _distance(kind, size, local)
            )
    return distances


def _distance(kind: int, size: Array, local: Array) -> Array:
    """Return the signed distances of points in the frame of a primitive, shape (P,)."""
    if kind == 0:
        return _outside_or_inside(np.abs(local) - size)
    radius = size[0]
    half = size[1]
    if kind == 2:
        radial = np.hypot(local[:, 0], local[:, 1]) - radius
        return _outside_or_inside(
            np.stack([radial, np.abs(local[:, 2]) - half], axis=1)
        )
    # half is 0 for a sphere
    along = np.clip(local[:, 2], -half, half)
    return np.asarray(
        np.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2 + (local[:, 2] - along) ** 2)
        - radius
    )


def _outside_or_inside(gaps: Array) -> Array:
    """Return the distance from a product of intervals, or of a disc and an interval, from the gap along each."""
    # Outside: length of the vector of positive gaps; inside: the largest, negative gap.
    outside = np.linalg.norm(np.maximum(gaps, 0), axis=1)
    return np.asarray(np.where(outside > 0, outside, gaps.max(axis=1)))


def _mesh_distances(mesh: ConvexMesh, points: Array) -> Array:
    """Return the signed distances of points [m], shape (P, 3), negative inside, shape (P,)."""
    # Inside a hull the largest plane distance is the depth; outside it is a lower
    # bound.
    distances: Array = (points @ mesh.planes[:, :3].T + mesh.planes[:, 3]).max(axis=1)
    outside = distances > 0
    distances[outside] = np.sqrt(_squared_distances(mesh, points[outside]))
    return distances


def _squared_distances(mesh: ConvexMesh, points: Array) -> Array:
    """Return squared distances from the nearest triangle."""
    smallest = np.full(len(points), np.inf)
    for corner, first, second in mesh.triangles:
        normal = np.cross(first, second)
        # Edges in order around the triangle, so that ``normal x edge`` points
        # inwards.
        ends = (
            (corner, first),
            (corner + first, second - first),
            (corner + second, -second),
        )
        offsets = [points - start for start, _ in ends]
        above = [
            offset @ np.cross(normal, edge) >= 0
            for offset, (_, edge) in zip(offsets, ends, strict=True)
        ]
        # Over the triangle: distance from its plane; else from the nearest edge.
        to_plane = (offsets[0] @ normal) ** 2 / (normal @ normal)
        to_edges = [
            _squared_from_segment(offset, edge)
            for offset, (_, edge) in zip(offsets, ends, strict=True)
        ]
        squared = np.where(np.all(above, axis=0), to_plane, np.min(to_edges, axis=0))
        np.minimum(smallest, squared, out=smallest)
    return smallest


def _squared_from_segment(offsets: Array, edge: Array) -> Array:
    """Return squared distances from a segment of points relative to its start, shape (P,)."""
    along = np.clip(offsets @ edge / (edge @ edge), 0, 1)
    return np.asarray(((offsets - along[:, None] * edge) ** 2).sum(axis=1))


def entries(planes: Array, origin: Array, rays: Array) -> Array:
    """Return where rays from an origin [m], shape (P, 3), enter, in ray lengths, shape (P,); nan for none."""
    enter, leave = np.full(len(rays), -np.inf), np.full(len(rays), np.inf)
    for plane in planes:
        # A ray enters through planes that it approaches, and leaves through the
        # others.
        speed = rays @ plane[:3]
        with np.errstate(all="ignore"):
            crossing = -(plane[:3] @ origin + plane[3]) / speed
        enter = np.where(speed < 0, np.fmax(enter, crossing), enter)
        # -inf for rays along a face, outside of it
        leave = np.where(speed < 0, leave, np.fmin(leave, crossing))
    return np.where(enter <= leave, enter, np.nan)


def unit_offset(seed: np.uint64) -> float:
    """Return a number in [0, 1) that depends on a seed."""
    return float(mixed(np.array([seed]))[0] >> np.uint64(11)) / 2.0**53


@dataclass(frozen=True)
class _Patch:
    """Part of a surface: a rectangle, a triangle, or a surface of revolution.

    Attributes:
        form: "flat", "triangle", "side", "disc" or "ball".
        area: Its area [m^2].
        base: Corner, or center of the lower end [m], shape (3,).
        axes: Rows: edges of a rectangle or triangle [m], or unit axes, the last one
            that of revolution.
        radius: Radius [m].
        height: Height along the axis at its end [m].
    """

    form: str
    area: float
    base: Array
    axes: Array
    radius: float = 0.0
    height: float = 0.0

    def points(self, u: Array, v: Array) -> Array:
        """Return points from coordinates in [0, 1), shape (P, 3)."""
        if self.form == "triangle":
            # In the other half of the parallelogram.
            far = u > 1 - v
            # The other half of the parallelogram is reflected, which keeps the density
            # uniform.
            u, v = np.where(far, 1 - u, u), np.where(far, 1 - v, v)
        if self.form in ("flat", "triangle"):
            return np.asarray(
                self.base + u[:, None] * self.axes[0] + v[:, None] * self.axes[1]
            )
        angle = 2 * np.pi * (u - 0.5)
        # Uniform in area: sqrt on a disc, and height on a sphere (Archimedes).
        scale = {
            "side": np.ones_like(v),
            "disc": np.sqrt(v),
            "ball": np.sqrt(1 - v * v),
        }[self.form]
        height = np.zeros_like(v) if self.form == "disc" else v * self.height
        across = self.radius * scale
        local = np.stack(
            [across * np.cos(angle), across * np.sin(angle), height], axis=1
        )
        return np.asarray(self.base + local @ self.axes)


def surface_points(primitives: Primitives, count: int, seed: np.uint64) -> Array:
    """Return points on all surfaces [m], by area, ordered by body, shape (count, 3); nan without bodies.

    Points that are inside of another body are kept. Within a part of a surface they
    form a Kronecker sequence, which is more even than random points. The seed is that
    of the scene.
    """
    patches = [
        patch
        for index in range(len(primitives))
        for patch in _patches(primitives, index)
    ]
    if not patches:
        return np.full((count, 3), np.nan)
    total = np.cumsum([patch.area for patch in patches])
    # Systematic rounding: cumulative areas plus one random offset give numbers of
    # points that add up to ``count``.
    ends = np.minimum(
        (total / total[-1] * count + unit_offset(seed)).astype(np.int64), count
    )
    ends[-1] = count
    with np.errstate(over="ignore"):
        starts = mixed(seed + np.arange(1, len(patches) + 1, dtype=np.uint64))
    numbers = np.diff(ends, prepend=0).tolist()
    parts = []
    for patch, start, number in zip(patches, starts, numbers, strict=True):
        first = np.array(
            [start >> np.uint64(32), start & np.uint64(0xFFFFFFFF)], np.uint32
        )
        with np.errstate(over="ignore"):
            # Wrapping 32-bit integers are fractional parts of the Kronecker sequence.
            steps = np.asarray(
                first + np.arange(number, dtype=np.uint32)[:, None] * STEPS, np.uint32
            )
        u, v = (steps >> np.uint32(8)).T * 2.0**-24
        parts.append(patch.points(u, v))
    return np.concatenate(parts)


def _patches(primitives: Primitives, index: int) -> list[_Patch]:
    """Return the parts of the surface of one body."""
    center, axes = primitives.centers[index], primitives.rotations[index].T
    if mesh := primitives.mesh(index):
        corners, edges = (
            center + mesh.triangles[:, 0] @ axes,
            mesh.triangles[:, 1:] @ axes,
        )
        areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
        return [
            _Patch("triangle", *patch)
            for patch in zip(areas.tolist(), corners, edges, strict=True)
        ]
    size, kind = primitives.sizes[index], KINDS[primitives.kinds[index]]
    if kind == "box":
        edges, patches = axes * size[:, None], []
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            for sign in (-1, 1):
                base = center + sign * edges[k] - edges[i] - edges[j]
                area = 4.0 * float(size[i] * size[j])
                patches.append(_Patch("flat", area, base, 2 * edges[[i, j]]))
        return patches
    radius, half = float(size[0]), float(size[1])
    side = _Patch(
        "side",
        4 * np.pi * radius * half,
        center - half * axes[2],
        axes,
        radius,
        2 * half,
    )
    form, area = (
        ("disc", np.pi * radius**2)
        if kind == "cylinder"
        else ("ball", 2 * np.pi * radius**2)
    )
    ends = [
        _Patch(form, area, center + sign * half * axes[2], axes, radius, sign * radius)
        for sign in (-1, 1)
    ]
    return [side, *ends]


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
            [entries(mesh.planes, origin, local)]
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
