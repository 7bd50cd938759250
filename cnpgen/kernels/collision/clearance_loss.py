"""Huber's losses of the clearances of a robot's convex parts among the obstacles of samples.

They are computed in compiled code, and where there is none by Pinocchio and Coal, the
reference of that code.
"""

import ctypes
from ctypes import c_double, c_long, c_void_p
from typing import TYPE_CHECKING

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.kernels.collision.body_arrays import primitive_bodies
from cnpgen.kernels.collision.collision_checker import (
    MAX_JOINTS,
    CollisionChecker,
    load_collision_library,
)
from cnpgen.kernels.compiled_kernel import address_of, require_memory
from cnpgen.kernels.library import KernelLibrary
from cnpgen.robots.observation.primitives import (
    KINDS,
    Primitives,
    bodies_of,
    smallest_signed_distances,
)
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.convex_part import ConvexPart
from cnpgen.robots.shape.hull import ball_round, coal_hull

if TYPE_CHECKING:
    import coal

    PlacedShape = tuple[coal.CollisionGeometry, coal.Transform3s]


def load_clearance_loss(
    kernels: KernelLibrary, robot: Robot
) -> "ClearanceLoss | ClearanceLossReference":
    """Load the losses of a robot, by Pinocchio and Coal where kernels are not compiled.

    Raises:
        UsageError: The robot has no link geometry, or too many joints.
    """
    if robot.shape is None or robot.n > MAX_JOINTS:
        text = f"losses of the distances of hulls need link geometry and at most {MAX_JOINTS} joints"
        raise UsageError(text, concerns="problem")
    library = load_collision_library(kernels)
    return (
        ClearanceLossReference(robot)
        if library is None
        else ClearanceLoss(library, robot)
    )


class ClearanceLoss:
    """Losses of states of one robot with link geometry among obstacles that differ from sample to sample."""

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
        self._library, self._checker = library, CollisionChecker(library, robot)

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
        losses, gradients = np.empty((nodes, samples)), np.empty((nodes, n, samples))
        arrays = address_of(states), required, address_of(losses), address_of(gradients)
        self._library.clearance_losses(ctypes.addressof(scene), samples, nodes, *arrays)
        return losses, gradients


class ClearanceLossReference:
    """Losses of states of one robot with link geometry.

    ``ClearanceLoss`` computes the same in less time.
    """

    def __init__(self, robot: Robot) -> None:
        assert robot.shape is not None
        self._robot, self._data = robot, robot.model.createData()
        joints = robot.shape.joints
        self._parts = [
            _Part(each, joints[each.link])
            for each in robot.shape.convex_parts
            if joints[each.link]
        ]

    def __call__(
        self, q: Array, obstacles: Primitives, required: float
    ) -> tuple[Array, Array]:
        """Compute the losses of K states of each of N samples.

        See ``ClearanceLoss``.
        """
        nodes, n, samples = q.shape
        losses, gradients = (
            np.full((nodes, samples), np.nan),
            np.full((nodes, n, samples), np.nan),
        )
        for sample in range(len(obstacles)):
            bodies = bodies_of(obstacles, sample)
            placed = [_placed_shape(bodies, index) for index in range(len(bodies))]
            for node in np.flatnonzero(
                np.isfinite(q[:, :, sample]).all(axis=1)
            ).tolist():
                results = self._loss(q[node, :, sample], bodies, placed, required)
                losses[node, sample], gradients[node, :, sample] = results
        return losses, gradients

    def _loss(
        self, q: Array, bodies: Primitives, placed: "list[PlacedShape]", required: float
    ) -> tuple[float, Array]:
        """Return the loss of one state and its gradient, shape (n,)."""
        import coal
        import pinocchio as pin

        model, data = self._robot.model, self._data
        pin.computeJointJacobians(model, data, q)
        places = [data.oMi[part.joint] for part in self._parts]
        # Balls around the convex parts are a broad phase: d(part) >= d(center) -
        # radius.
        centers = np.array(
            [
                place.act(part.center)
                for part, place in zip(self._parts, places, strict=True)
            ]
        )
        clearance = smallest_signed_distances(bodies, centers) - [
            part.radius for part in self._parts
        ]
        loss, gradient, request = 0.0, np.zeros(len(q)), coal.DistanceRequest()
        for index in np.flatnonzero(clearance < required).tolist():
            part, place = self._parts[index], places[index]
            jacobian = pin.getJointJacobian(
                model, data, part.joint, pin.LOCAL_WORLD_ALIGNED
            )
            here = coal.Transform3s(place.rotation, place.translation)
            for shape, there in placed:
                result = coal.DistanceResult()
                distance = (
                    coal.distance(shape, there, part.hull, here, request, result)
                    - part.thickness
                )
                # Huber's loss of v = required - d: v^2 / 2 for v < 1, else v - 1/2. Its
                # derivative is min(v, 1), and d(d)/dq = n . (velocity of the closest
                # point), with that point fixed in the link (envelope theorem).
                violation = required - distance
                if violation > 0:
                    derivative = min(violation, 1.0)
                    loss += derivative * (violation - 0.5 * derivative)
                    # v(point) = v + omega x arm; the normal of Coal points from the
                    # obstacle to the link.
                    arm = result.getNearestPoint2() - place.translation
                    velocity = jacobian[:3] + np.cross(jacobian[3:], arm, axis=0)
                    gradient -= derivative * result.normal @ velocity
        return loss, gradient


class _Part:
    """A convex part of a link: its joint, hull, thickness, and a ball around it, in the frame of the joint [m]."""

    def __init__(self, part: ConvexPart, joint: int) -> None:
        self.joint, self.hull, self.thickness = (
            joint,
            coal_hull(part.vertices),
            part.radius,
        )
        self.center, self.radius = ball_round(part.vertices, part.radius)


def _placed_shape(bodies: Primitives, index: int) -> "PlacedShape":
    """Return the shape of a body with its pose."""
    import coal

    return _shape(bodies, index), coal.Transform3s(
        bodies.rotations[index], bodies.centers[index]
    )


def _shape(bodies: Primitives, index: int) -> "coal.CollisionGeometry":
    """Return the shape of a body around its center."""
    import coal

    if mesh := bodies.mesh(index):
        return coal_hull(mesh.corners)
    first, second, third = bodies.sizes[index].tolist()
    match KINDS[bodies.kinds[index]]:
        case "box":
            return coal.Box(2 * first, 2 * second, 2 * third)
        case "sphere":
            return coal.Sphere(first)
        case "cylinder":
            return coal.Cylinder(first, 2 * second)
        case _:
            return coal.Capsule(first, 2 * second)
