"""Huber's losses of the clearances of a robot's convex parts among the obstacles of samples.

Of the violation v = required - d of a signed distance d, the loss is v^2 / 2 for v < 1,
else v - 1/2. Its derivative is min(v, 1), and dd/dq = n . (velocity of the closest
point), with that point fixed in the link (envelope theorem).
"""

import ctypes
from ctypes import c_double, c_long, c_void_p

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.collision.body_arrays import primitive_bodies
from cnpgen.kernels.collision.collision_checker import CollisionChecker
from cnpgen.kernels.compiled_kernel import address_of, require_memory
from cnpgen.robots.observation.primitives import Primitives
from cnpgen.robots.robot import Robot


class ClearanceLoss:
    """Losses of states of one robot with link geometry among obstacles that differ from sample to sample.

    The library is that of ``load_collision_library``.
    """

    def __init__(self, library: ctypes.CDLL, robot: Robot) -> None:
        library.clearance_losses.restype = c_long
        library.clearance_losses.errcheck = require_memory
        library.clearance_losses.argtypes = (
            c_void_p,
            c_long,
            c_long,
            c_void_p,
            c_double,
            c_void_p,
            c_void_p,
        )
        self._library = library
        self._checker = CollisionChecker(library, robot)

    def __call__(
        self, q: Array, obstacles: Primitives, required: float
    ) -> tuple[Array, Array]:
        """Compute the losses of K states of each of N samples: sums over pairs of a convex part and an obstacle.

        Args:
            q: Joint positions [rad], shape (K, n, N).
            obstacles: The obstacles, arrays with a first axis of length N.
            required: Distance below which a pair has a loss [m].

        Returns:
            Losses, shape (K, N), and their gradients, shape (K, n, N); nan for states
            that are not finite.
        """
        nodes, n, samples = q.shape
        checker = self._checker
        bodies, vertices, boxes = primitive_bodies(obstacles, len(checker.vertices))
        vertices = np.concatenate([checker.vertices, vertices])
        scene = checker.scene_of(bodies, boxes, vertices)
        states = np.ascontiguousarray(q, np.float64)
        losses = np.empty((nodes, samples))
        gradients = np.empty((nodes, n, samples))
        arrays = address_of(states), required, address_of(losses), address_of(gradients)
        self._library.clearance_losses(ctypes.addressof(scene), samples, nodes, *arrays)
        return losses, gradients
