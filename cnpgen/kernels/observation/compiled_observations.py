"""Observations of scenes in compiled code, for ``observe.c``."""

import ctypes
from ctypes import c_int, c_long, c_void_p
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.kernels.c_library import ARRAYS, load_library
from cnpgen.kernels.compiled_kernel import address_of, require_memory
from cnpgen.robots.observation.camera import Camera
from cnpgen.robots.observation.observations import ObservationBackend
from cnpgen.robots.observation.primitives import Primitives
from cnpgen.robots.observation.surface_points import Seeds
from cnpgen.store.files.cache_folder import default_cache_folder, usable_cache_folder

Values = NDArray[np.float32]

SOURCE = Path(__file__).with_name("observe.c")


class _SceneArrays(ctypes.Structure):
    """``scene_arrays`` of observe.c, with the arrays that it points to."""

    _fields_ = (
        ("scenes", c_long),
        ("bodies", c_long),
        *((name, c_void_p) for name in ("kind", "center", "rotation", "size")),
        *(
            (name, c_void_p)
            for name in ("first_triangle", "first_plane", "triangles", "planes")
        ),
    )

    def __init__(self, scenes: Primitives) -> None:
        triangles, planes = (
            [getattr(mesh, name) for mesh in scenes.meshes]
            for name in ("triangles", "planes")
        )
        types: tuple[Any, ...] = (
            np.int64,
            *(np.float64,) * 3,
            *(np.int64,) * 2,
            *(np.float32,) * 2,
        )
        parts = (
            *(scenes.kinds, scenes.centers, scenes.rotations, scenes.sizes),
            *(np.cumsum([0, *map(len, rows)]) for rows in (triangles, planes)),
            *(
                np.concatenate([*map(np.ravel, rows), np.empty(0)])
                for rows in (triangles, planes)
            ),
        )
        self._keep = [
            np.ascontiguousarray(part, dtype)
            for part, dtype in zip(parts, types, strict=True)
        ]
        super().__init__(*scenes.kinds.shape, *map(address_of, self._keep))


class CompiledObservations(ObservationBackend):
    """``ObservationBackend`` in compiled code: the library of observe.c."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        pointer = c_void_p
        number = c_long
        flag = c_int
        library.scene_distances.argtypes = (pointer, pointer, number, flag, pointer)
        library.scene_clouds.argtypes = (pointer, pointer, number, pointer)
        library.scene_depths.argtypes = (pointer, pointer, number, number, pointer)
        for function in (library.scene_clouds, library.depth_clouds):
            function.restype = number
            function.errcheck = require_memory
        library.depth_clouds.argtypes = (
            number,
            pointer,
            number,
            number,
            pointer,
            pointer,
            number,
            pointer,
        )

    def distances(self, scenes: Primitives, points: Array) -> Values:
        """See ``ObservationBackend``."""
        coordinates = np.ascontiguousarray(points.swapaxes(-1, -2), np.float32)
        distances = np.empty((len(scenes), points.shape[-2]), np.float32)
        shared = points.ndim == 2
        arrays = ctypes.byref(_SceneArrays(scenes))
        addresses = address_of(coordinates), address_of(distances)
        self._library.scene_distances(
            arrays, addresses[0], points.shape[-2], shared, addresses[1]
        )
        return distances

    def surface_points(self, scenes: Primitives, count: int, seeds: Seeds) -> Values:
        """See ``ObservationBackend``."""
        points = np.empty((len(scenes), count, 3), np.float32)
        seeds = np.ascontiguousarray(seeds)
        arrays = ctypes.byref(_SceneArrays(scenes))
        self._library.scene_clouds(arrays, address_of(seeds), count, address_of(points))
        return points

    def depth_images(self, scenes: Primitives, camera: Camera) -> Values:
        """See ``ObservationBackend``."""
        depth = np.empty((len(scenes), camera.height, camera.width), np.float32)
        view = _view(camera)
        arrays = ctypes.byref(_SceneArrays(scenes))
        self._library.scene_depths(
            arrays, address_of(view), camera.width, camera.height, address_of(depth)
        )
        return depth

    def depth_points(
        self, depth: Values, camera: Camera, count: int, seeds: Seeds
    ) -> Values:
        """See ``ObservationBackend``."""
        points = np.empty((len(depth), count, 3), np.float32)
        view = _view(camera)
        depth = np.ascontiguousarray(depth, np.float32)
        seeds = np.ascontiguousarray(seeds)
        pointers = (address_of(array) for array in (depth, seeds))
        self._library.depth_clouds(
            len(depth),
            address_of(view),
            camera.width,
            camera.height,
            *pointers,
            count,
            address_of(points),
        )
        return points


def _view(camera: Camera) -> Array:
    """Return the ``view`` of observe.c."""
    return np.concatenate([camera.position, camera.axes.ravel()])


def observation_backend() -> ObservationBackend:
    """Return the functions that compute observations.

    Raises:
        MachineError: The compiled code is missing.
    """
    folder = usable_cache_folder(default_cache_folder())
    return CompiledObservations(load_library((ARRAYS, SOURCE), folder))
