"""Constraints of motion plan requests on every state: the orientation and the position of a link.

Solvers use polynomials of the link's pose, and verdicts angles and distances that
Pinocchio's poses have. Bounds of solvers have a margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from cnpgen.arrays import Array, Vector3
from cnpgen.errors import RecipeError
from cnpgen.problems.constraints.constraint import Condition, LinkConstraint
from cnpgen.problems.scenes.placement import moved_obstacle
from cnpgen.problems.scenes.quaternions import roll_pitch_yaw
from cnpgen.robots.chain import frame_of
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.convex_part import turned
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.robots.robot import Robot
    from cnpgen.world.world import World

EULER = "xyz-euler"
ROTATION_VECTOR = "rotation-vector"
REGIONS = ("box", "sphere", "cylinder")
MIN_LIMIT_RAD = 1e-4
MIN_REGION_M = 1e-4
TOLERANCE = 1e-6  # rad or m that a valid motion may be outside, for rounding
# Of the half widths, and at most, by which solvers stay inside.
MARGIN_FRACTION = 0.05
MAX_MARGIN_RAD = 0.01
MAX_MARGIN_M = 2e-3
SMOOTHING = 1e-12  # of squares below a root, which has a derivative at 0 then


@dataclass(frozen=True, kw_only=True)
class _LinkPoseConstraint(LinkConstraint):
    """Base class: conditions on the pose of a link that do not depend on obstacles."""

    reads = ()
    uses_obstacles = False
    has_solver_margin = True
    link: str = field("link of the robot")

    def solved(self, world: World) -> tuple[Condition, ...]:  # noqa: ARG002
        """Return the bounds of the symbolic form."""
        margins = self.margins
        return (self._inside([0.0] * len(margins), margins),)

    @property
    def margins(self) -> Array:
        """Margins of the values of the symbolic form, shape (m,)."""
        raise NotImplementedError

    def allowed(self, condition: Condition) -> Array:
        """Return the margin of conditions for solvers, which may use it up, or the tolerance."""
        margin = condition.accepted
        return super().allowed(condition) if margin is None else margin

    def _inside(self, g: list[Any], margins: Array) -> Condition:
        """Return the condition for solvers that values are above their margins."""
        return Condition(
            f"{self.reason}, {self.link}",
            "1",
            g,
            margins,
            np.full(len(g), np.inf),
            "position",
            accepted=margins,
            projected=True,
        )


@dataclass(frozen=True, kw_only=True)
class LinkOrientation(_LinkPoseConstraint):
    """Constraint: the rotation ``D = R_wanted^T R`` of a link is within limits about three axes.

    As ``moveit_msgs/OrientationConstraint``: with "xyz-euler" the angles of ``D = Rx(a)
    Ry(b) Rz(c)``, where b is in [-pi/2, pi/2]; with "rotation-vector" the components of
    the logarithm of D. A limit of pi or more is none.
    """

    reason = "link turned"
    rpy: Vector3 = field(
        "wanted orientation in the world: roll, pitch, yaw, as in a URDF",
        unit="rad",
        plausible=2 * np.pi,
    )
    limits: Vector3 = field(
        "maximum angles about x, y and z; free from pi on",
        unit="rad",
        low=MIN_LIMIT_RAD,
    )
    parametrization: str = field(
        "angles that are limited", choices=(EULER, ROTATION_VECTOR), default=EULER
    )
    tolerance: float = field(
        "additional angle that a valid motion may have",
        unit="rad",
        low=1e-9,
        default=TOLERANCE,
        plausible=1.0,
    )

    @cached_property
    def bounded(self) -> tuple[int, ...]:
        """Axes with a limit."""
        is_euler = self.parametrization == EULER
        # The second Euler angle is at most a quarter turn, so that is no limit.
        free = np.pi, (np.pi / 2 if is_euler else np.pi), np.pi
        return tuple(axis for axis in range(3) if self.limits[axis] < free[axis])

    @property
    def margins(self) -> Array:
        """Margins of the rows of every bounded axis."""
        rows = [
            min(MARGIN_FRACTION * self.limits[axis], MAX_MARGIN_RAD)
            for axis in self.bounded
            for _ in range(self._rows(axis))
        ]
        return np.array(rows, float)

    def moved(self, position: Array, rotation: Array) -> Self:  # noqa: ARG002
        """Return the constraint after a rotation of its frame."""
        return replace(self, rpy=roll_pitch_yaw(rotation @ turned(*self.rpy)))

    def symbolic(self, state: SymbolicState) -> tuple[Condition, ...]:
        """State the distances from the limits [rad], to first order."""
        from cnpgen.kernels.symbolic.linalg import product, rows_of

        rotation, _ = _symbolic_pose(state, self.link, np.zeros(3))
        # D = R_wanted^T R is the rotation away from the wanted orientation.
        D = product(rows_of(turned(*self.rpy).T), rotation)
        euler = self.parametrization == EULER
        g = self._euler_rows(D) if euler else self._vector_rows(D)
        return (self._inside(g, self.margins),)

    def measured(self, world: World) -> tuple[Condition, ...]:
        """Evaluate the angles of Pinocchio's pose of the link [rad]."""
        rotation, _ = _measured_pose(world, self.link, np.zeros(3))
        D = np.einsum("ki,kj...->ij...", turned(*self.rpy), rotation)
        euler = self.parametrization == EULER
        angles = _euler_angles(D) if euler else _rotation_vector(D)
        limits = np.array([self.limits[axis] for axis in self.bounded])
        parts = tuple("xyz"[axis] for axis in self.bounded)
        values = [angles[axis] for axis in self.bounded]
        name = f"orientation of {self.link}"
        return (Condition(name, "rad", values, -limits, limits, "angle", parts),)

    def _rows(self, axis: int) -> int:
        """Return the number of rows of an axis in the symbolic form."""
        # Up to a quarter turn, both sides are smooth rows of their own.
        two_sided = self.parametrization == EULER and self.limits[axis] <= np.pi / 2
        return 2 if two_sided else 1

    def _euler_rows(self, D: Sequence[Sequence[Any]]) -> list[Any]:
        """Return ``r sin(limit -+ angle)`` of each bounded Euler angle.

        With (y, x) = r (sin a, cos a), |a| <= t is ``x sin t - |y| cos t >= 0`` for all
        t below pi.
        """
        import casadi as ca

        # D = Rx(a) Ry(b) Rz(c) has D_12 = -cos b sin a, D_22 = cos b cos a,
        # D_01 = -cos b sin c and D_00 = cos b cos c.
        pairs = {0: (-D[1][2], D[2][2]), 2: (-D[0][1], D[0][0])}
        rows = list[Any]()
        for axis in self.bounded:
            sine = np.sin(self.limits[axis])
            cosine = np.cos(self.limits[axis])
            if axis == 1:
                # D_02 = sin b
                rows += [sine - D[0][2], sine + D[0][2]]
                continue
            y, x = pairs[axis]
            # For t up to pi / 2, both sides must hold. Beyond, cos t is negative, and
            # -|y| cos t is the larger side.
            sides = [x * sine - y * cosine, x * sine + y * cosine]
            rows += sides if self._rows(axis) == 2 else [ca.fmax(*sides)]
        return rows

    def _vector_rows(self, D: Sequence[Sequence[Any]]) -> list[Any]:
        """Return ``limit - |w_i|`` of each bounded component of the rotation vector.

        With u = theta / 2 and the unit axis k, w_i = 2 k_i sin u (u / sin u), and (2
        k_i sin u)^2 = 1 + D_ii - D_jj - D_kk, which is regular at half a turn, too.
        """
        import casadi as ca

        # trace D = 1 + 2 cos theta, so cos^2 (theta / 2) = (1 + trace) / 4.
        trace = D[0][0] + D[1][1] + D[2][2]
        stretch = _angle_over_sine(ca.sqrt(ca.fmax((1 + trace) / 4, SMOOTHING)))
        # 1 + D_ii - D_jj - D_kk, with D_jj + D_kk = trace - D_ii.
        squares = [1 + 2 * D[axis][axis] - trace for axis in self.bounded]
        return [
            self.limits[axis] - stretch * ca.sqrt(ca.fmax(square, 0.0) + SMOOTHING)
            for axis, square in zip(self.bounded, squares, strict=True)
        ]


@dataclass(frozen=True, kw_only=True)
class LinkPosition(_LinkPoseConstraint):
    """Constraint: a point of a link is in one of several regions, as ``moveit_msgs/PositionConstraint``."""

    reason = "link outside its region"
    offset: Vector3 = field(
        "point in the frame of the link", unit="m", default=(0.0, 0.0, 0.0)
    )
    region: tuple[Obstacle, ...] = field(
        "boxes, spheres and cylinders, one of which contains the point",
        form="[[constraint.region]] tables",
    )
    tolerance: float = field(
        "additional distance that a valid motion may have",
        unit="m",
        low=1e-9,
        default=TOLERANCE,
        plausible=0.5,
    )

    def __post_init__(self) -> None:
        """Check the kinds of the regions; ValueError for others."""
        kinds = {each.kind for each in self.region}
        if not kinds or not kinds.issubset(REGIONS):
            raise ValueError(f"must have regions of the kinds {', '.join(REGIONS)}")

    @property
    def margins(self) -> Array:
        """Margins of the rows of the region, or of the largest of several."""
        rows = [
            [min(MARGIN_FRACTION * width, MAX_MARGIN_M) for width in _half_widths(each)]
            for each in self.region
        ]
        # Several regions have one row, whose margin must fit in the narrowest of them.
        smallest = [min(min(row) for row in rows)]
        return np.array(rows[0] if len(rows) == 1 else smallest, float)

    def moved(self, position: Array, rotation: Array) -> Self:
        """Return the constraint with moved regions."""
        pose = position, rotation
        moved = tuple(moved_obstacle(each, pose) for each in self.region)
        return replace(self, region=moved)

    def symbolic(self, state: SymbolicState) -> tuple[Condition, ...]:
        """State the distances from the faces of the region [m], or those of the region with the largest minimum."""
        import casadi as ca

        _, point = _symbolic_pose(state, self.link, np.array(self.offset))
        rows = [_symbolic_depths(each, point) for each in self.region]
        # A point is in the union if its least depth in one region is positive.
        if len(rows) > 1:
            rows = [[reduce(ca.fmax, [reduce(ca.fmin, row) for row in rows])]]
        return (self._inside(rows[0], self.margins),)

    def measured(self, world: World) -> tuple[Condition, ...]:
        """Evaluate the depth of the point in the regions by Pinocchio's pose of the link [m]."""
        _, point = _measured_pose(world, self.link, np.array(self.offset))
        depth = reduce(np.maximum, [_depth(each, point) for each in self.region])
        bounds = (np.zeros(1), np.full(1, np.inf))
        name = f"region of {self.link}"
        return (Condition(name, "m", [depth], *bounds, "position"),)


def _half_widths(region: Obstacle) -> list[float]:
    """Return the half widths that belong to the rows of ``_symbolic_depths`` [m]."""
    if region.kind == "box":
        # Both faces of an axis have the same half width.
        return [size / 2 for size in region.size or () for _ in range(2)]
    radius = region.radius or 0.0
    half = (region.length or 0.0) / 2
    return [radius] if region.kind == "sphere" else [radius, half, half]


def _symbolic_depths(region: Obstacle, point: Sequence[Any]) -> list[Any]:
    """Return the signed distances of a point from the faces of a region, positive inside [m].

    That of a round face is ``(r^2 - |p|^2) / (2 r)``, exact to first order.
    """
    from cnpgen.kernels.symbolic.linalg import constants, dot, rows_of, subtract, times

    shift = subtract(list(point), constants(np.array(region.position)))
    # The shift in the frame of the region: p = R^T (x - c).
    p = times(rows_of(turned(*region.rotation).T), shift)
    widths = _half_widths(region)
    if region.kind == "box":
        return [
            half + side * p[axis]
            for axis, half in enumerate(widths[::2])
            for side in (-1, 1)
        ]
    flat = p if region.kind == "sphere" else p[:2]
    radius = widths[0]
    faces = [
        half + side * p[2] for half, side in zip(widths[1:], (-1, 1), strict=False)
    ]
    return [(radius**2 - dot(flat, flat)) / (2 * radius), *faces]


def _depth(region: Obstacle, point: Array) -> Array:
    """Return the depth of points in a region [m], shape () or (K,): the smallest distance from a face."""
    # Trailing axes let one formula serve one point and K points.
    position = np.array(region.position).reshape(3, *[1] * (point.ndim - 1))
    p = np.einsum("ji,j...->i...", turned(*region.rotation), point - position)
    if region.kind == "box":
        sides = zip(region.size or (), p, strict=True)
        return np.asarray(np.min([size / 2 - np.abs(x) for size, x in sides], axis=0))
    radius = region.radius or 0.0
    if region.kind == "sphere":
        return np.asarray(radius - np.sqrt((p**2).sum(axis=0)))
    length = region.length or 0.0
    around = radius - np.hypot(p[0], p[1])
    return np.asarray(np.minimum(around, length / 2 - np.abs(p[2])))


def _euler_angles(D: Array) -> list[Array]:
    """Return the angles of ``D = Rx(a) Ry(b) Rz(c)``, shape () or (K,) each."""
    return [
        np.arctan2(-D[1, 2], D[2, 2]),
        # D_02 = sin b, and D_00 and D_01 have the length cos b, which is not negative.
        np.arctan2(D[0, 2], np.hypot(D[0, 0], D[0, 1])),
        np.arctan2(-D[0, 1], D[0, 0]),
    ]


def _rotation_vector(D: Array) -> Array:
    """Return the logarithm of rotation matrices of shape (3, 3) or (3, 3, K): (3,) or (3, K)."""
    from scipy.spatial.transform import Rotation

    vectors = Rotation.from_matrix(np.moveaxis(D, (0, 1), (-2, -1))).as_rotvec()
    return np.moveaxis(vectors, -1, 0)


def _angle_over_sine(cosine: Any) -> Any:
    """Return ``u / sin u`` from ``cos u`` of an angle from 0 to pi / 2, with square roots only.

    Viete's product sin u = 8 sin v cos v cos 2v cos 4v with v = u / 8 leaves v / sin v,
    whose series in s = sin^2 v is 1 + s/6 + 3 s^2/40 + 15 s^3/336, here to 2e-7.
    """
    import casadi as ca

    product = 1.0
    for _ in range(3):
        # Half angles: cos (v / 2) = sqrt((1 + cos v) / 2).
        cosine = ca.sqrt((1 + cosine) / 2)
        product = product * cosine
    # sin^2 v of the last half angle, v = u / 8.
    square = 1 - cosine**2
    series = 1 + square * (1 / 6 + square * (3 / 40 + square * (15 / 336)))
    return series / product


def _frame(robot: Robot, link: str) -> Any:
    """Return Pinocchio's frame of a link that the planned joints move; RecipeError for others."""
    index = frame_of(robot.model, link)
    # Parent 0 is the universe: the planned joints do not move such a frame.
    if index >= robot.model.nframes or not robot.model.frames[index].parentJoint:
        raise RecipeError(
            [f"constraint.link: the planned joints move no link {link!r}"]
        )
    return robot.model.frames[index]


def _symbolic_pose(
    state: SymbolicState, link: str, offset: Array
) -> tuple[list[list[Any]], list[Any]]:
    """Return the rotation of a link and a point of it as SX."""
    from cnpgen.kernels.symbolic.linalg import add, constants, product, rows_of, times

    frame = _frame(state.robot, link)
    kinematics = state.kinematics
    R = frame.placement.rotation
    joint = frame.parentJoint - 1
    # Pinocchio counts the universe as joint 0, the kinematics do not.
    axes = kinematics.frames[joint]
    point = frame.placement.translation + R @ offset
    position = add(kinematics.origins[joint], times(axes, constants(point)))
    return product(axes, rows_of(R)), position


def _measured_pose(world: World, link: str, offset: Array) -> tuple[Array, Array]:
    """Return the rotation of a link and a point of it [m], shape (3, 3, ...) and (3, ...)."""
    frame = _frame(world.robot, link)
    axes, origin = world.joint_pose(frame.parentJoint)
    R = frame.placement.rotation
    point = frame.placement.translation + R @ offset
    rotation = np.einsum("ij...,jk->ik...", axes, R)
    return rotation, origin + np.einsum("ij...,j->i...", axes, point)
