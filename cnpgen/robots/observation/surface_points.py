"""Points on the surfaces of primitives: the NumPy reference of ``observe.c``."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.robots.observation.primitives import KINDS, Primitives

Seeds = NDArray[np.uint64]

# 2^32 / g and 2^32 / g^2 with g^3 = g + 1: low discrepancy
STEPS = np.array([3242174889, 2447445414], np.uint32)
_GOLDEN, _FIRST, _SECOND = (
    np.uint64(x) for x in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)


def mixed(values: Seeds) -> Seeds:
    """Hash 64-bit integers by the finalizer of splitmix64 (Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        x = np.asarray(values, np.uint64) + _GOLDEN
        x = (x ^ x >> np.uint64(30)) * _FIRST
        x = (x ^ x >> np.uint64(27)) * _SECOND
    return np.asarray(x ^ x >> np.uint64(31))


def scene_seeds(seed: int, count: int) -> Seeds:
    """Return the seeds of scenes, shape (count,)."""
    # The seed of a scene depends on its index, not on the number of scenes.
    return mixed(
        mixed(np.full(count, seed, np.uint64)) ^ np.arange(count, dtype=np.uint64)
    )


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
