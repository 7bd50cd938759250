"""What a problem file says of its robot: the URDF, the joints and limits, what it holds, the boxes around it."""

from collections.abc import Iterator
from dataclasses import dataclass

from cnpgen.schema.keys import Range, field


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """Which robot: a URDF file, the joints that are planned and the frame that the task is about."""

    urdf: str = field("URDF file, relative to the problem file")
    joints: tuple[str, ...] = field("planned joints, in order; all others stay at zero")
    tip: str = field("name of the frame (URDF link) that the task is about")
    base: tuple[float, ...] = field("base configuration of the planned joints", unit="rad")

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        twice = sorted({name for name in self.joints if self.joints.count(name) > 1})
        if twice:
            yield "joints", f"each joint can be planned once, got {', '.join(twice)} more than once"
        if len(self.base) != len(self.joints):
            yield "base", f"expected {len(self.joints)} numbers, one per planned joint, got {len(self.base)}"


@dataclass(frozen=True, kw_only=True)
class LimitSpec:
    """Planning limits as fractions of the URDF's."""

    position_scale: float = field("planning limit / URDF limit of joint positions", default=1.0, low=1e-3, high=1.0)
    velocity_scale: float = field("planning limit / URDF limit of joint velocities", default=1.0, low=1e-3, high=1.0)
    acceleration_rate: float = field("acceleration limit / velocity limit", unit="1/s", default=10.0, low=1e-3)
    acceleration_cap: float = field("no acceleration limit is above this", unit="rad/s^2", default=20.0, low=1e-3)
    torque_scale: float = field("planning limit / URDF limit of joint torques", default=1.0, low=1e-3, high=1.0)


@dataclass(frozen=True, kw_only=True)
class HeldObject:
    """An upright cuboid rigidly held at the tip frame, its centre."""

    size: tuple[float, float, float] = field("edge lengths along the tip frame's x, y, z", unit="m", low=1e-6)


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """An axis-aligned box of the world; without ``top`` the box ends ``below`` the object at that end of the motion."""

    name: str = field("name of the obstacle")
    x: Range = field("extent along world x", unit="m")
    y: Range = field("extent along world y", unit="m")
    height: float | None = field(
        "height of the box, measured down from its top; none: it extends down without end",
        unit="m",
        default=None,
        low=1e-6,
    )
    top: float | None = field("height of its upper face", unit="m", default=None)
    below: str = field("the end whose object stands on this box", choices=("", "start", "goal"), default="")

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        if self.top is None and not self.below:
            yield "top", f"obstacle {self.name!r} has no height: expected a 'top', or 'below' = \"start\" or \"goal\""
        if self.top is not None and self.below:
            yield "top", f"obstacle {self.name!r} has both a 'top' and a 'below', expected one of them"
        for key, extent in (("x", self.x), ("y", self.y)):
            if extent.low == extent.high:
                yield key, f"obstacle {self.name!r} has no extent here, expected a low end below the high end"
