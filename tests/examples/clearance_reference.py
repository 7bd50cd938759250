"""Losses of clearances by Pinocchio and Coal: the reference of ``clearance_loss.c``."""

from typing import TYPE_CHECKING

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.observation.primitives import KINDS, Primitives
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.convex_part import ConvexPart
from cnpgen.robots.shape.hull import ball_round, coal_hull
from tests.examples.numpy_observations import bodies_of, smallest_signed_distances

if TYPE_CHECKING:
    import coal

    PlacedShape = tuple[coal.CollisionGeometry, coal.Transform3s]


class ClearanceLossReference:
    """Losses of states of one robot with link geometry, as ``ClearanceLoss`` computes them."""

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
