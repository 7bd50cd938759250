"""Huber's losses of the clearances of a robot's convex parts among the obstacles of samples, in compiled code."""

import ctypes
from ctypes import c_double, c_long, c_void_p
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.kernels.collision.body_arrays import hull_vertices
from cnpgen.kernels.collision.clearance_loss_reference import ClearanceLossReference
from cnpgen.kernels.collision.collision_checker import MAX_JOINTS, CollisionChecker, load_collision_library
from cnpgen.kernels.compiled_kernel import address_of
from cnpgen.kernels.library import KernelLibrary
from cnpgen.robots.observation.primitives import Primitives
from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

SOURCES = [Path(__file__).with_name(name) for name in ("convex.c", "collision.c", "clearance_loss.c")]


class _SampleObstacles(ctypes.Structure):
    """``sample_obstacles`` of clearance_loss.c."""

    _fields_ = (
        ("bodies", c_long),
        *((name, c_void_p) for name in ("kind", "center", "rotation", "size", "first", "count", "vertices")),
    )


def load_clearance_loss(kernels: KernelLibrary, robot: Robot) -> "ClearanceLoss | ClearanceLossReference":
    """Load the losses of a robot, by Pinocchio and Coal where kernels are not compiled.

    Raises:
        UsageError: The robot has no link geometry, or too many joints.
    """
    if robot.shape is None or robot.n > MAX_JOINTS:
        text = f"losses of the distances of hulls need link geometry and at most {MAX_JOINTS} joints"
        raise UsageError(text, concerns="problem")
    library = load_collision_library(kernels, SOURCES)
    return ClearanceLossReference(robot) if library is None else ClearanceLoss(library, robot)


class ClearanceLoss:
    """Losses of states of one robot among obstacles that differ from sample to sample.

    Args:
        library: Library of ``SOURCES``.
        robot: The robot, with link geometry.
    """

    def __init__(self, library: ctypes.CDLL, robot: Robot) -> None:
        library.clearance_losses.restype = None
        library.clearance_losses.argtypes = (
            c_void_p, c_void_p, c_long, c_long, c_void_p, c_double, c_void_p, c_void_p,
        )  # fmt: skip
        self._library, self._checker = library, CollisionChecker(library, robot)

    def __call__(self, q: Array, obstacles: Primitives, required: float) -> tuple[Array, Array]:
        """Compute the losses of K states of each of N samples: sums over pairs of a convex part and an obstacle.

        Args:
            q: Joint positions [rad], shape (K, n, N).
            obstacles: The obstacles, arrays with a first axis of length N.
            required: Distance below which a pair has a loss [m].

        Returns:
            Losses, shape (K, N), and their gradients, shape (K, n, N); nan for states that are not finite.
        """
        nodes, n, samples = q.shape
        vertices = [self._checker.vertices, *(hull_vertices(mesh.corners) for mesh in obstacles.meshes)]
        lengths = np.array([len(each) for each in vertices])
        parts = [
            *(obstacles.kinds, obstacles.centers, obstacles.rotations, obstacles.sizes),
            *(np.cumsum(lengths)[:-1], lengths[1:] // 3, np.concatenate(vertices)),
        ]
        keep = [np.ascontiguousarray(part) for part in parts]
        structure = _SampleObstacles(obstacles.kinds.shape[1], *map(address_of, keep))
        states = np.ascontiguousarray(q, np.float64)
        losses, gradients = np.empty((nodes, samples)), np.empty((nodes, n, samples))
        self._library.clearance_losses(
            self._checker.address,
            ctypes.addressof(structure),
            samples,
            nodes,
            address_of(states),
            required,
            address_of(losses),
            address_of(gradients),
        )
        return losses, gradients
