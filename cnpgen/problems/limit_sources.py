"""Who states the limits of a problem: the vendor, the URDF, another source, or no source."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from cnpgen.documents import JsonObject
from cnpgen.problems.constraints.joint import judged_torque
from cnpgen.problems.idle_keys import idle_keys, idle_text
from cnpgen.problems.load_robot import JERK_RATE
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.robot_spec import LimitSources, LimitSpec
from cnpgen.robots.urdf import urdf_tree
from cnpgen.robots.urdf_parameters import urdf_parameters

NOT_STATED = "not stated"
WORDS = {  # basis -> what a limit is called
    "vendor": "the vendor's",
    "urdf": "the URDF's",
    "stated": "of another source",
    "guess": "guessed",
    NOT_STATED: NOT_STATED,
}


@dataclass(frozen=True)
class LimitSource:
    """Source of a limit.

    Attributes:
        basis: "vendor", "urdf", "stated" (by another source), "guess" or "not stated".
        source: Document or rule; may be empty.
    """

    basis: str
    source: str = ""

    def to_dict(self) -> dict[str, str]:
        """Return the source for JSON."""
        return {"basis": self.basis, "source": self.source}


def limit_sources(problem: Problem, robot: Robot) -> dict[str, LimitSource]:
    """Return the source of each limit: quantity -> source.

    "motor" is present if [drive] limits motors.
    """
    limits, drive = problem.limits, problem.drive
    stated = limits.sources or LimitSources()
    urdf = LimitSource("urdf")
    numbers = LimitSource(NOT_STATED)
    # Without a stated source, the origin of the numbers decides.
    origins: dict[str, Callable[[], LimitSource]] = {
        "position": lambda: numbers if limits.position else urdf,
        "velocity": lambda: numbers if limits.velocity else urdf,
        "acceleration": lambda: (
            numbers if limits.acceleration else _accelerations(problem, robot)
        ),
        "jerk": lambda: numbers if limits.jerk else _jerks(robot),
        "torque": lambda: numbers if limits.torque else urdf,
    }
    if drive.torque or drive.line or drive.power:
        origins["motor"] = lambda: numbers
    scales = {
        "position": limits.position_scale,
        "velocity": limits.velocity_scale,
        "torque": limits.torque_scale,
        "motor": limits.torque_scale,
    }
    found = {}
    for name, origin in origins.items():
        text = getattr(stated, name)
        source = LimitSource(*text.split(": ", 1)) if text else origin()
        scale = scales.get(name, 1.0)
        found[name] = source if scale == 1 else _scaled(source, scale)
    return found


def judged_sources(problem: Problem, robot: Robot) -> dict[str, LimitSource]:
    """Return the sources of the limits that constraints of a problem apply: quantity -> source."""
    judged = {key for each in problem.constraint for key in each.reads or ()}
    return {
        name: source
        for name, source in limit_sources(problem, robot).items()
        if f"limits.sources.{name}" in judged
    }


@dataclass(frozen=True)
class JudgedLimits:
    """Limits that a verdict applies.

    Attributes:
        torque: Torque that is judged, in words; empty if the problem limits none.
        sources: Who states the limits: quantity -> source.
        idle: Result of ``idle_keys``.
    """

    torque: str
    sources: Mapping[str, LimitSource]
    idle: Mapping[str, str]

    @classmethod
    def of(cls, problem: Problem, robot: Robot) -> JudgedLimits:
        """Return the limits of a problem and its robot."""
        torque = judged_torque(problem.constraint, robot)
        return cls(torque, judged_sources(problem, robot), idle_keys(problem))

    def to_dict(self) -> JsonObject:
        """Return the limits for JSON."""
        return {
            **({"torque": self.torque} if self.torque else {}),
            "limit_sources": {
                name: source.to_dict() for name, source in self.sources.items()
            },
            "idle_keys": dict(self.idle),
        }

    @property
    def lines(self) -> list[str]:
        """Lines of text, without empty ones."""
        torque = f"torque: {self.torque}" if self.torque else ""
        return list(
            filter(None, [torque, sources_line(self.sources), idle_text(self.idle)])
        )


def sources_line(sources: Mapping[str, LimitSource]) -> str:
    """Return sources in one line, "limits: the URDF's: position; guessed: jerk"; empty without any."""
    texts = [
        f"{words}: {', '.join(_names(sources, basis))}"
        for basis, words in WORDS.items()
        if _names(sources, basis)
    ]
    return f"limits: {'; '.join(texts)}" if texts else ""


def acceleration_rule(limits: LimitSpec) -> str:
    """Describe acceleration limits of a rate and a cap."""
    rate = f"{limits.acceleration_rate:g}/s times the velocity limits"
    return f"{rate}, at most {limits.acceleration_cap:g} rad/s^2"


def jerk_rule(rate: float) -> str:
    """Describe jerk limits in proportion to acceleration limits [1/s]."""
    return f"{rate:g}/s times the acceleration limits"


def _names(sources: Mapping[str, LimitSource], basis: str) -> list[str]:
    return [name for name, source in sources.items() if source.basis == basis]


def _scaled(source: LimitSource, scale: float) -> LimitSource:
    """Return the source of a fraction of a limit."""
    parts: Iterable[str] = filter(None, (source.source, f"times {scale:g}"))
    return LimitSource(source.basis, ", ".join(parts))


def _accelerations(problem: Problem, robot: Robot) -> LimitSource:
    """Return the source of limits by the rule of rate and cap, which a URDF 1.2 may narrow."""
    rule, limits = acceleration_rule(problem.limits), robot.acceleration_limit
    return _narrowed(robot, "acceleration", limits.tolist(), rule)


def _jerks(robot: Robot) -> LimitSource:
    """Return the source of limits in proportion to accelerations, which a URDF 1.2 may narrow."""
    return _narrowed(robot, "jerk", robot.jerk_limit.tolist(), jerk_rule(JERK_RATE))


def _narrowed(
    robot: Robot, name: str, limits: Iterable[float], rule: str
) -> LimitSource:
    """Return the source of limits by a rule, of which some joints have those of the URDF."""
    rates = zip(robot.joint_names, _rates(robot, name), limits, strict=True)
    of_urdf = [joint for joint, rate, limit in rates if rate == limit]
    if len(of_urdf) == len(robot.joint_names):
        return LimitSource("urdf")
    stated = [f"the URDF for {', '.join(of_urdf)}"] if of_urdf else []
    others = f"{rule} for the others" if of_urdf else rule
    return LimitSource("guess", "; ".join([*stated, others]))


def _rates(robot: Robot, name: str) -> list[float | None]:
    """Return the limits of accelerations or jerks of a URDF 1.2, one per joint; None where it has none."""
    joints = urdf_parameters(urdf_tree(robot.urdf_text)).joints.values()
    rates = {joint.name: joint.rates.get(name) for joint in joints}
    return [rates[joint] for joint in robot.joint_names]
