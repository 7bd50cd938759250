"""Robot specification in a problem file: URDF, joints, limits, held object and payload."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cnpgen.arrays import Vector3
from cnpgen.documents import NamedErrors
from cnpgen.robots.parameter_ranges import PAYLOAD_CENTRE, optional_key
from cnpgen.schema.keys import PerJoint, Range, field

GEOMETRIES = ("urdf", "paper-capsules")
SOURCE = r"^(vendor|urdf|stated|guess): \S.*"  # of a limit: its basis, then a text


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """Robot of a problem: URDF file, planned joints and tip frame."""

    urdf: str = field("URDF file, relative to the problem file")
    joints: tuple[str, ...] = field(
        "planned joints, in order; all other joints stay at zero, or at their 'locked_positions'"
    )
    tip: str = field("name of the tip frame (URDF link)")
    base: tuple[float, ...] = field(
        "base configuration of the planned joints", unit="rad", plausible=100.0
    )
    tip_offset: Vector3 = optional_key(
        "offset of the tip in the frame 'tip': x, y, z",
        unit="m",
        default=(0.0, 0.0, 0.0),
        plausible=5.0,
    )
    tip_rotation: Vector3 = optional_key(
        "rotation of the tip in the frame 'tip': roll, pitch and yaw about fixed axes",
        unit="rad",
        default=(0.0, 0.0, 0.0),
        plausible=2 * np.pi,
    )
    geometry: str = optional_key(
        'its shape: "urdf", the URDF\'s <collision> elements, or "paper-capsules", a line through the joints\' origins'
        ' that is one radius thick; by default "urdf" where there are obstacles and such elements',
        choices=GEOMETRIES,
        default="paper-capsules",
    )
    locked_joints: tuple[str, ...] = optional_key(
        "joints that are not planned and stay at other positions than zero, such as those of an open gripper",
        default=(),
    )
    locked_positions: tuple[float, ...] = optional_key(
        "their positions, one per joint", unit="rad", default=(), plausible=100.0
    )
    packages: tuple[str, ...] = optional_key(
        "folders, relative to the problem file, that are searched for package:// of the URDF",
        default=(),
    )
    convex_parts: int = optional_key(
        "maximum number of convex parts of a collision mesh; 1 for its convex hull",
        default=1,
        low=1,
        high=64,
    )
    decomposed: tuple[str, ...] = optional_key(
        "links whose collision meshes are decomposed into convex parts; by default all",
        default=(),
    )
    hull_gap: float | None = optional_key(
        "fraction of the random states without overlap of the links' triangle meshes in which their convex parts"
        " overlap, as 'cnpgen init' measured it",
        low=0.0,
        high=1.0,
    )
    srdf: str = optional_key(
        "SRDF file, relative to the problem file, whose disabled pairs of links are not checked; without it they are"
        " found by sampling",
        default="",
    )
    visual_links: tuple[str, ...] = optional_key(
        "links without a <collision> element whose <visual> elements take its place",
        default=(),
    )
    skipped_meshes: tuple[str, ...] = optional_key(
        "links whose collision meshes are left out, so that nothing checks them",
        default=(),
    )
    allow_unused: tuple[str, ...] = optional_key(
        "names of elements and attributes of URDF and SRDF that resemble known names, and are not read",
        default=(),
    )
    ignored_pairs: tuple[tuple[str, str], ...] = optional_key(
        "pairs of links whose collisions are not checked, besides those of the SRDF",
        default=(),
    )

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        twice = sorted({name for name in self.joints if self.joints.count(name) > 1})
        if twice:
            yield (
                "joints",
                f"each joint can be planned once, got {', '.join(twice)} more than once",
            )
        if len(self.base) != len(self.joints):
            yield (
                "base",
                f"expected {len(self.joints)} numbers, one per planned joint, got {len(self.base)}",
            )
        if len(self.locked_positions) != len(self.locked_joints):
            count = len(self.locked_joints)
            yield (
                "locked_positions",
                f"expected {count} numbers, one per locked joint, got {len(self.locked_positions)}",
            )
        if both := sorted(set(self.joints) & set(self.locked_joints)):
            yield (
                "locked_joints",
                f"a joint is planned or locked, got {', '.join(both)} in both lists",
            )
        if len(set(self.locked_joints)) != len(self.locked_joints):
            yield (
                "locked_joints",
                f"each joint can be locked once, got {list(self.locked_joints)}",
            )
        if self.decomposed and self.convex_parts == 1:
            yield (
                "decomposed",
                "links are decomposed into more than one part only: set 'convex_parts', such as 4",
            )


def _source(doc: str) -> Any:
    """Declare a key that says who states a limit."""
    form = '"BASIS: TEXT" with a BASIS of vendor, urdf, stated or guess'
    return optional_key(doc, default="", pattern=SOURCE, form=form)


@dataclass(frozen=True, kw_only=True)
class LimitSources:
    """Who states each limit; 'cnpgen show' and verdicts repeat it.

    Without an entry, limits of the URDF are the URDF's, limits by the rules of
    'acceleration_rate' and of jerks are guessed, and other numbers are "not stated".
    """

    position: str = _source("source of the limits of joint positions")
    velocity: str = _source("source of the limits of joint velocities")
    acceleration: str = _source("source of the limits of joint accelerations")
    jerk: str = _source("source of the limits of joint jerks")
    torque: str = _source("source of the limits of joint torques")
    motor: str = _source("source of the limits of motors in [drive]")


@dataclass(frozen=True, kw_only=True)
class LimitSpec:
    """Planning limits as fractions of the URDF's limits or of given limits."""

    position_scale: float = field(
        "planning limit / URDF limit of joint positions",
        default=1.0,
        low=1e-3,
        high=1.0,
    )
    velocity_scale: float = field(
        "planning limit / URDF limit of joint velocities",
        default=1.0,
        low=1e-3,
        high=1.0,
    )
    acceleration_rate: float = field(
        "acceleration limit / velocity limit", unit="1/s", default=10.0, low=1e-3
    )
    acceleration_cap: float = field(
        "maximum of the acceleration limits",
        unit="rad/s^2",
        default=20.0,
        low=1e-3,
        plausible=1000.0,
    )
    torque_scale: float = field(
        "planning limit / URDF limit of joint torques", default=1.0, low=1e-3, high=1.0
    )
    position: tuple[Range, ...] | None = optional_key(
        "limits of joint positions in place of the URDF's, one range per planned joint; required for continuous joints",
        unit="rad",
        plausible=100.0,
    )
    velocity: PerJoint | None = optional_key(
        "limits of joint velocities in place of the URDF's", unit="rad/s", low=1e-6
    )
    acceleration: PerJoint | None = optional_key(
        "planning limits of joint accelerations in place of rate and cap",
        unit="rad/s^2",
        low=1e-6,
    )
    jerk: PerJoint | None = optional_key(
        "planning limits of joint jerks; default 5/s times those of the accelerations",
        unit="rad/s^3",
        low=1e-6,
        plausible=1e5,
    )
    torque: PerJoint | None = optional_key(
        "limits of joint torques in place of the URDF's", unit="N m", low=1e-6
    )
    soft: str = optional_key(
        "whether soft limits of the URDF's <safety_controller> elements narrow its position limits",
        default="use",
        choices=("use", "ignore"),
    )
    sources: LimitSources | None = optional_key("who states each limit")


@dataclass(frozen=True, kw_only=True)
class Payload:
    """Rigid body carried at the tip frame; a point mass without inertia and size.

    With ``touch_links``, its box is a body that touches neither other links nor
    obstacles.
    """

    mass: float = field("mass", unit="kg", low=1e-9)
    centre: Vector3 = field(
        "centre of mass in the tip frame",
        unit="m",
        default=(0.0, 0.0, 0.0),
        plausible=5.0,
    )
    inertia: tuple[float, float, float, float, float, float] | None = field(
        "inertia about the centre of mass along the tip frame's axes: xx, yy, zz, xy, xz, yz",
        unit="kg m^2",
        default=None,
    )
    size: Vector3 | None = field(
        "edge lengths of a box of uniform density, in place of the inertia or, with touch_links, beside it",
        unit="m",
        default=None,
        low=1e-6,
        plausible=10.0,
    )

    touch_links: tuple[str, ...] = optional_key(
        "links that carry the payload and may touch it; its box of 'size' is then a body that touches nothing else",
        default=(),
    )

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        if self.inertia is not None and self.size is not None and not self.touch_links:
            yield (
                "size",
                "the payload has both an 'inertia' and a 'size', expected one of them",
            )
        if self.touch_links and self.size is None:
            yield "touch_links", "a payload that is a body needs a 'size'"
        principal = np.linalg.eigvalsh(self.inertia_matrix)
        if principal[0] < 0 or principal[2] > (principal[0] + principal[1]) * (
            1 + 1e-9
        ):
            text = ", ".join(f"{each:g}" for each in principal)
            yield (
                "inertia",
                f"no body has the principal values {text} kg m^2: each is positive and at most the sum of the others",
            )

    def at(self, parameters: Mapping[str, float]) -> Payload:
        """Return the payload of a sample, from its parameters by name."""
        mass = parameters.get("payload_mass", self.mass)
        factor = parameters.get("payload_inertia", 1.0)
        x, y, z = (
            parameters.get(name, value)
            for name, value in zip(PAYLOAD_CENTRE, self.centre, strict=True)
        )
        xx, yy, zz, xy, xz, yz = (
            self.inertia_matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            * (factor * mass / self.mass)
        ).tolist()
        return replace(
            self,
            mass=mass,
            centre=(x, y, z),
            inertia=(xx, yy, zz, xy, xz, yz),
            size=self.size if self.touch_links else None,
        )

    @property
    def inertia_matrix(self) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        """Inertia about the center of mass [kg m^2], shape (3, 3)."""
        if self.inertia is not None:
            xx, yy, zz, xy, xz, yz = self.inertia
            return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        squares = np.square(self.size or (0.0, 0.0, 0.0))
        return np.diag(self.mass / 12 * (squares.sum() - squares))


@dataclass(frozen=True, kw_only=True)
class HeldObject:
    """Upright cuboid held rigidly with its center at the tip frame."""

    size: Vector3 = field(
        "edge lengths along the tip frame's x, y, z", unit="m", low=1e-6, plausible=10.0
    )
    touch_links: tuple[str, ...] = optional_key(
        "links that carry the object and may touch it (constraint 'object-clearance')",
        default=(),
    )
