"""Backends of observations: the contract, and the NumPy reference."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.observation.camera import Camera, depth_image, depth_points
from cnpgen.robots.observation.primitives import Primitives, bodies_of, smallest_signed_distances
from cnpgen.robots.observation.surface_points import Seeds, surface_points
from cnpgen.robots.shape.hull import Array

Values = NDArray[np.float32]


class ObservationBackend(Protocol):
    """Functions of N scenes, which are primitives with a first axis of length N."""

    def distances(self, scenes: Primitives, points: Array) -> Values:
        """Return the smallest signed distance of points from the bodies of each scene [m], shape (N, P).

        Points in the world frame [m] have shape (P, 3) for all scenes or (N, P, 3). Without bodies distances are inf.
        """

    def surface_points(self, scenes: Primitives, count: int, seeds: Seeds) -> Values:
        """Return points on the surfaces of each scene [m], shape (N, count, 3); see ``surface_points``."""

    def depth_images(self, scenes: Primitives, camera: Camera) -> Values:
        """Return depth images [m], shape (N, height, width); see ``depth_image``."""

    def depth_points(self, depth: Values, camera: Camera, count: int, seeds: Seeds) -> Values:
        """Return points of depth images [m], shape (N, count, 3); see ``depth_points``."""


class NumpyObservations:
    """The NumPy reference of ``ObservationBackend``, one scene after the other."""

    def distances(self, scenes: Primitives, points: Array) -> Values:
        """See ``ObservationBackend``."""
        points = np.broadcast_to(points, (len(scenes), *points.shape[-2:]))
        parts = [smallest_signed_distances(bodies_of(scenes, i), points[i]) for i in range(len(scenes))]
        return _stacked(parts, points.shape[1:2])

    def surface_points(self, scenes: Primitives, count: int, seeds: Seeds) -> Values:
        """See ``ObservationBackend``."""
        parts = [surface_points(bodies_of(scenes, i), count, seeds[i]) for i in range(len(scenes))]
        return _stacked(parts, (count, 3))

    def depth_images(self, scenes: Primitives, camera: Camera) -> Values:
        """See ``ObservationBackend``."""
        parts = [depth_image(bodies_of(scenes, i), camera) for i in range(len(scenes))]
        return _stacked(parts, (camera.height, camera.width))

    def depth_points(self, depth: Values, camera: Camera, count: int, seeds: Seeds) -> Values:
        """See ``ObservationBackend``."""
        parts = [depth_points(image, camera, count, seed) for image, seed in zip(depth, seeds, strict=True)]
        return _stacked(parts, (count, 3))


def _stacked(parts: list[Array], shape: tuple[int, ...]) -> Values:
    return np.array(parts, np.float32).reshape(len(parts), *shape)
