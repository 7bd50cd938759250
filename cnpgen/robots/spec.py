"""What a problem file says of its robot: the URDF, the joints and limits, what it holds and carries."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cnpgen.schema.keys import PerJoint, Range, field

GEOMETRIES = ("urdf", "paper-capsules")


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """Which robot: a URDF file, the joints that are planned and the frame that the task is about."""

    urdf: str = field("URDF file, relative to the problem file")
    joints: tuple[str, ...] = field("planned joints, in order; all others stay at zero")
    tip: str = field("name of the frame (URDF link) that the task is about")
    base: tuple[float, ...] = field("base configuration of the planned joints", unit="rad")
    tip_offset: tuple[float, float, float] = field(
        "where the tip is in the frame 'tip': x, y, z", unit="m", default=(0.0, 0.0, 0.0), late=True
    )
    tip_rotation: tuple[float, float, float] = field(
        "how it is turned there: roll, pitch and yaw about the frame's fixed axes",
        unit="rad",
        default=(0.0, 0.0, 0.0),
        late=True,
    )
    geometry: str = field(
        'its shape: "urdf", the URDF\'s <collision> elements, or "paper-capsules", a line through the joints\' origins'
        ' that is one radius thick; by default "urdf" where there are obstacles and such elements',
        choices=GEOMETRIES,
        default="paper-capsules",
        late=True,
    )
    packages: tuple[str, ...] = field(
        "folders, relative to the problem file, in which package:// in the URDF is looked up", default=(), late=True
    )
    convex_parts: int = field(
        "into how many convex parts a collision mesh that is far from convex may be taken apart; 1 for its convex hull",
        default=1,
        low=1,
        high=64,
        late=True,
    )
    srdf: str = field(
        "SRDF file, relative to the problem file, whose disabled pairs of links are not kept apart; without it they are"
        " found by sampling",
        default="",
        late=True,
    )

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        twice = sorted({name for name in self.joints if self.joints.count(name) > 1})
        if twice:
            yield "joints", f"each joint can be planned once, got {', '.join(twice)} more than once"
        if len(self.base) != len(self.joints):
            yield "base", f"expected {len(self.joints)} numbers, one per planned joint, got {len(self.base)}"


@dataclass(frozen=True, kw_only=True)
class LimitSpec:
    """Planning limits as fractions of the URDF's, or of what is given in their place."""

    position_scale: float = field("planning limit / URDF limit of joint positions", default=1.0, low=1e-3, high=1.0)
    velocity_scale: float = field("planning limit / URDF limit of joint velocities", default=1.0, low=1e-3, high=1.0)
    acceleration_rate: float = field("acceleration limit / velocity limit", unit="1/s", default=10.0, low=1e-3)
    acceleration_cap: float = field("no acceleration limit is above this", unit="rad/s^2", default=20.0, low=1e-3)
    torque_scale: float = field("planning limit / URDF limit of joint torques", default=1.0, low=1e-3, high=1.0)
    position: tuple[Range, ...] | None = field(
        "limits of joint positions in the place of the URDF's, a range per planned joint; continuous joints need them",
        unit="rad",
        default=None,
        late=True,
    )
    velocity: PerJoint | None = field(
        "limits of joint velocities in the place of the URDF's", unit="rad/s", default=None, low=1e-6, late=True
    )
    acceleration: PerJoint | None = field(
        "planning limits of joint accelerations in the place of rate and cap",
        unit="rad/s^2",
        default=None,
        low=1e-6,
        late=True,
    )
    jerk: PerJoint | None = field(
        "planning limits of joint jerks; by default 5/s x those of the accelerations",
        unit="rad/s^3",
        default=None,
        low=1e-6,
        late=True,
    )
    torque: PerJoint | None = field(
        "limits of joint torques in the place of the URDF's", unit="N m", default=None, low=1e-6, late=True
    )


@dataclass(frozen=True, kw_only=True)
class Payload:
    """A rigid body that the robot carries at the tip frame; with neither inertia nor size it is a point."""

    mass: float = field("its mass", unit="kg", low=1e-9)
    centre: tuple[float, float, float] = field("its centre of mass in the tip frame", unit="m", default=(0.0, 0.0, 0.0))
    inertia: tuple[float, float, float, float, float, float] | None = field(
        "its inertia about the centre of mass, along the tip frame's axes: xx, yy, zz, xy, xz, yz",
        unit="kg m^2",
        default=None,
    )
    size: tuple[float, float, float] | None = field(
        "edge lengths of a box of uniform density, in the place of the inertia", unit="m", default=None, low=1e-6
    )

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        if self.inertia is not None and self.size is not None:
            yield "size", "the payload has both an 'inertia' and a 'size', expected one of them"
        principal = np.linalg.eigvalsh(self.moments)
        if principal[0] < 0 or principal[2] > (principal[0] + principal[1]) * (1 + 1e-9):
            text = ", ".join(f"{each:g}" for each in principal)
            yield "inertia", f"no body has the principal moments {text} kg m^2: none is above the sum of the others"

    @property
    def moments(self) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        """Its inertia about the centre of mass [kg m^2], shape (3, 3)."""
        if self.inertia is not None:
            xx, yy, zz, xy, xz, yz = self.inertia
            return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        squares = np.square(self.size or (0.0, 0.0, 0.0))
        return np.diag(self.mass / 12 * (squares.sum() - squares))


@dataclass(frozen=True, kw_only=True)
class HeldObject:
    """An upright cuboid rigidly held at the tip frame, its centre."""

    size: tuple[float, float, float] = field("edge lengths along the tip frame's x, y, z", unit="m", low=1e-6)
