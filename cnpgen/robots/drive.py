"""Drives of joints: rotor inertia, friction and motor limits, as a problem states them and as checks use them.

All values are seen at the joint, through the gear. With the rigid torque tau of the
inverse dynamics, the motor delivers ``tau + J ddq + b dq + c F(dq)``, where F is the
sign of the velocity and, at rest, any value of [-1, 1]. 'cnpgen docs drives' has the
model.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cnpgen.arrays import Array
from cnpgen.documents import NamedErrors
from cnpgen.errors import counted
from cnpgen.robots.parameter_ranges import optional_key
from cnpgen.schema.keys import PerJoint, field, keys

MIN_REVERSAL_SPEED = 0.01  # rad/s; the verdict resolves reversals of 1 ms


@dataclass(frozen=True, kw_only=True)
class DriveLine:
    """Line of the torque that motors deliver over the velocity, seen at the joint, each number once or one per joint."""

    torque: PerJoint = field("torque at rest", unit="N m", low=1e-6)
    speed: PerJoint = field(
        "velocity at which no torque is left", unit="rad/s", low=1e-6
    )
    quadrants: str = field(
        "whether the line also limits torques that brake",
        default="all",
        choices=("all", "motoring"),
    )


@dataclass(frozen=True, kw_only=True)
class DriveSpec:
    """Drives of the joints: rotor inertia, friction and limits of the motors, each number once or one per joint."""

    urdf_dynamics: str = optional_key(
        "whether damping and friction of the URDF's <dynamics> elements are those of the drives; 'viscous' and"
        " 'coulomb' replace them",
        default="ignore",
        choices=("use", "ignore"),
    )
    armature: PerJoint | None = optional_key(
        "inertia of the rotor seen at the joint: rotor inertia times the square of the gear ratio",
        unit="kg m^2",
        low=0.0,
    )
    rotor_inertia: PerJoint | None = optional_key(
        "inertia of the rotor at the motor, with 'gear_ratio' in place of 'armature'",
        unit="kg m^2",
        low=0.0,
    )
    gear_ratio: PerJoint | None = optional_key(
        "motor velocity / joint velocity", low=1e-3
    )
    viscous: PerJoint | None = optional_key(
        "viscous friction at the joint", unit="N m s/rad", low=0.0
    )
    coulomb: PerJoint | None = optional_key(
        "dry friction at the joint", unit="N m", low=0.0
    )
    friction_help: float = optional_key(
        "fraction of the friction that is certain to act: 0 if plans may not rely on any",
        default=0.0,
        low=0.0,
        high=1.0,
    )
    reversal_speed: float = optional_key(
        "speed below which the direction of friction is uncertain",
        unit="rad/s",
        default=0.05,
        low=MIN_REVERSAL_SPEED,
        plausible=10.0,
    )
    limits: str = optional_key(
        "side of the gear whose torque is limited",
        default="both",
        choices=("both", "joint", "motor"),
    )
    torque: PerJoint | None = optional_key(
        "limits of the torques of the motors, seen at the joint; by default those of [limits]",
        unit="N m",
        low=1e-6,
    )
    power: PerJoint | None = optional_key(
        "largest powers that the motors deliver", unit="W", low=1e-6
    )
    line: tuple[DriveLine, ...] = optional_key(
        "lines of the torques of the motors over the velocity",
        default=(),
        form="[[drive.line]] tables",
    )

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        if (self.rotor_inertia is None) != (self.gear_ratio is None):
            given = "gear_ratio" if self.rotor_inertia is None else "rotor_inertia"
            yield (
                given,
                "'rotor_inertia' and 'gear_ratio' determine the armature together: give both, or 'armature'",
            )
        if self.armature is not None and self.rotor_inertia is not None:
            yield (
                "armature",
                "is also given by 'rotor_inertia' and 'gear_ratio', expected one of them",
            )
        if self.friction_help and not self.has_friction:
            yield (
                "friction_help",
                "there is no friction: give 'viscous' or 'coulomb', or urdf_dynamics = \"use\"",
            )
        for key in ("power", "line"):
            if self.limits == "joint" and getattr(self, key):
                yield key, "limits motors, but 'limits' is \"joint\""

    @property
    def has_friction(self) -> bool:
        """Whether friction is stated, or taken from the URDF."""
        return bool(self.viscous or self.coulomb or self.urdf_dynamics == "use")

    @property
    def idle_keys(self) -> dict[str, str]:
        """Stated keys, as "drive.armature", without effect on limits of torques: key -> what they need."""
        if self.limits == "joint":
            names = (key.name for key in keys(type(self)) if key.name != "limits")
            return {f"drive.{name}": "limit of motors" for name in names}
        idle = {} if self.has_friction else {"drive.reversal_speed": "friction"}
        # The limit of the motors takes the place of that of the joints.
        if self.limits == "motor" and self.torque:
            idle["limits.torque"] = "limit of joints"
        if self.viscous and self.coulomb:
            idle["drive.urdf_dynamics"] = "friction without a key of its own"
        return idle


NO_DRIVE = DriveSpec()


@dataclass(frozen=True)
class SpeedLine:
    """Limit ``|tau_m| + slope |dq| <= torque`` of motor torques, shape (n,) each.

    If only motoring is limited, the torque in the direction of the motion is; a torque
    that brakes may be up to ``torque + slope |dq|``.
    """

    torque: Array
    slope: Array
    motoring: bool

    @property
    def signs(self) -> tuple[float, ...]:
        """Factors s of the rows ``|tau_m + s slope dq| <= torque``."""
        return (1.0,) if self.motoring else (1.0, -1.0)


@dataclass(frozen=True)
class Drive:
    """Drives of a robot; values are seen at the joints, for prismatic ones with kg, N s/m, N and m/s.

    Attributes:
        armature: Inertia of the rotors J [kg m^2], shape (n,).
        viscous: Viscous friction b [N m s/rad], shape (n,).
        coulomb: Dry friction c [N m], shape (n,).
        friction_help: Certain fraction h of the friction.
        reversal_speed: Speed w [rad/s] below which its direction is uncertain.
        limits: "both", "joint" or "motor".
        torque_limit: Symmetric planning limit of motor torques [N m], shape (n,).
        power_limit: Largest power that motors deliver [W], shape (n,), or None.
        lines: Torque-speed lines.
    """

    armature: Array
    viscous: Array
    coulomb: Array
    friction_help: float
    reversal_speed: float
    limits: str
    torque_limit: Array
    power_limit: Array | None = None
    lines: tuple[SpeedLine, ...] = ()

    @property
    def limits_joint(self) -> bool:
        """Whether the torque at the joint, which the links alone cause, is limited."""
        return self.limits in {"both", "joint"}

    @cached_property
    def motor_rows(self) -> tuple[int, ...]:
        """Joints with limited motor torque; without drive terms of its own it is the torque at the joint."""
        return tuple(range(len(self.armature))) if self.limits != "joint" else ()

    @cached_property
    def uncertain_rows(self) -> tuple[int, ...]:
        """Those whose highest and lowest motor torques differ: with dry friction, or viscous friction that may fail."""
        uncertain = (self.coulomb > 0) | ((self.viscous > 0) & (self.friction_help < 1))
        return tuple(joint for joint in self.motor_rows if uncertain[joint])

    @cached_property
    def resting_friction(self) -> Array:
        """Largest friction of the envelope at dq = 0 [N m], shape (n,): ``c + (1 - h) b w``."""
        uncertain = 1 - self.friction_help
        return np.asarray(self.coulomb + uncertain * self.viscous * self.reversal_speed)

    @cached_property
    def resting_limit(self) -> Array:
        """Limit of the torques of motors at rest, where lines begin [N m], shape (n,)."""
        limits = [self.torque_limit, *(line.torque for line in self.lines)]
        return np.asarray(np.min(limits, axis=0))

    @property
    def summary(self) -> str:
        """Description of the torque that is judged, in a few words."""
        sides = {"both": "both sides", "joint": "the joint", "motor": "the motor"}
        more = [counted(len(self.lines), "torque-speed line")] if self.lines else []
        more += ["power"] if self.power_limit is not None else []
        limits = ", ".join([f"limits on {sides[self.limits]}", *more])
        return f"rigid body and drives, {limits}"


RIGID = "rigid body"  # the torque that is judged without drives
