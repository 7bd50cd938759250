"""Who states the limits of an arm: its URDF, a joint_limits.yaml, or no source."""

from __future__ import annotations

from collections.abc import Sequence

from cnpgen.addons.init.arm import (
    DEFAULT_RANGE_M,
    DEFAULT_RANGE_RAD,
    DEFAULT_SPEED,
    Arm,
)
from cnpgen.addons.init.joint_limits import StatedJointLimits
from cnpgen.problems.limit_sources import acceleration_rule, jerk_rule
from cnpgen.robots.robot_spec import LimitSources, LimitSpec

# Random states that determine placeholders of missing torque limits.
TORQUE_STATES = 1000
# Jerk limits per acceleration limit [1/s]; Franka Research 3: 500 ('cnpgen docs
# references').
INITIAL_JERK_RATE = 100.0
PLACEHOLDERS = {  # limit -> what is put in where the URDF has none
    "position": f"{DEFAULT_RANGE_RAD:.3g} rad, or {DEFAULT_RANGE_M:g} m, to either side",
    "velocity": f"{DEFAULT_SPEED:g} rad/s or m/s",
    "torque": f"the largest of {TORQUE_STATES:,} random states, at speeds and accelerations within the limits",
}


def stated_sources(
    arm: Arm, limits: LimitSpec, joint_limits: StatedJointLimits | None
) -> LimitSources:
    """Return the sources of an arm's limits; empty where the origin of the numbers says it.

    A limit with a placeholder of any joint is a guess.
    """
    file = "" if joint_limits is None else joint_limits.path.name
    names = [joint.name for joint in arm.planned]
    sources = {}
    for limit, instead in PLACEHOLDERS.items():
        guessed = [each.name for each in arm.planned if limit in each.missing]
        stated = [each.name for each in arm.planned if limit in each.replaced]
        # A torque that cannot hold the arm is replaced, of any source.
        stated = [name for name in stated if name not in guessed]
        others = [each for each in names if each not in {*guessed, *stated}]
        sources[limit] = _source(
            (file, stated),
            ("the URDF", others if guessed or stated else []),
            (instead, guessed),
        )
    rules = {
        "acceleration": acceleration_rule(limits),
        "jerk": jerk_rule(INITIAL_JERK_RATE),
    }
    for limit, rule in rules.items():
        of_file = {} if joint_limits is None else joint_limits.of(f"max_{limit}")
        stated = [name for name in names if name in of_file]
        urdf = _of_urdf(arm, limits) if limit == "jerk" else []
        urdf = [name for name in urdf if name not in of_file]
        others = [name for name in names if name not in {*of_file, *urdf}]
        if getattr(limits, limit) is not None:
            sources[limit] = _source((file, stated), ("the URDF", urdf), (rule, others))
    return LimitSources(**sources)


def _of_urdf(arm: Arm, limits: LimitSpec) -> list[str]:
    """Return the joints whose jerk limit is that of the URDF."""
    jerks = () if limits.jerk is None else limits.jerk.values
    pairs = zip(arm.planned, jerks, strict=False)
    return [joint.name for joint, jerk in pairs if jerk == joint.jerk]


def _source(
    stated: tuple[str, Sequence[str]],
    urdf: tuple[str, Sequence[str]],
    guessed: tuple[str, Sequence[str]],
) -> str:
    """Return a text of sources and their joints; its basis is that of the weakest source.

    Empty without joints.
    """
    found = [(text, joints) for text, joints in (stated, urdf, guessed) if joints]
    if not found:
        return ""
    basis = "guess" if guessed[1] else "stated"
    # One source is that of all joints.
    if len(found) == 1:
        return f"{basis}: {found[0][0]}"
    parts = (f"{text} for {', '.join(joints)}" for text, joints in found)
    return f"{basis}: {'; '.join(parts)}"
