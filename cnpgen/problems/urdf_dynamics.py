"""Friction, soft limits and further elements of joints in a URDF: what is used of them, in words.

Published values of <dynamics> are often placeholders for simulators: of 69 URDFs in
example-robot-data, 17 have friction that takes half of the effort or more. So neither
use nor disregard is a silent default.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from cnpgen.errors import RecipeError
from cnpgen.robots.urdf_parameters import (
    NO_SOFT_LIMITS,
    UrdfJoint,
    urdf_parameters,
)

MAX_PLAUSIBLE_SHARE = 0.5  # of the effort that friction takes at the velocity limit
_FORCES = {True: ("N s/m", "N"), False: ("N m s/rad", "N m")}  # of prismatic joints


@dataclass(frozen=True)
class JointFriction:
    """Friction of a joint in a URDF: viscous [N m s/rad], dry [N m], and its share of the effort at full speed."""

    joint: UrdfJoint

    @property
    def share(self) -> float:
        """Fraction of the effort that friction takes at the velocity limit; infinite without an effort."""
        effort = self.joint.limits.get("effort", 0.0)
        speed = self.joint.limits.get("velocity", 0.0)
        # b v_max + c: the friction at the velocity limit, in the unit of the effort.
        friction = self.joint.damping * speed + self.joint.friction
        return friction / effort if effort else math.inf

    def __str__(self) -> str:
        viscous, dry = _FORCES[self.joint.kind == "prismatic"]
        share = f"{self.share:.0%} of" if math.isfinite(self.share) else "no"
        values = f"damping {self.joint.damping:g} {viscous}, friction {self.joint.friction:g} {dry}"
        return f"{self.joint.name} ({values}: {share} effort at full speed)"


def friction_in(joints: Sequence[UrdfJoint]) -> list[JointFriction]:
    """Return the friction of the joints that have any."""
    return [JointFriction(each) for each in joints if each.damping or each.friction]


def suggested_use(frictions: Sequence[JointFriction], joints: int) -> str:
    """Return "use", or "ignore" for values that look like placeholders: large shares, or one pair for all joints."""
    pairs = {(each.joint.damping, each.joint.friction) for each in frictions}
    # Real joints differ: one pair of values for all of several joints was not measured.
    placeholders = len(frictions) == joints > 1 and len(pairs) == 1
    large = any(each.share >= MAX_PLAUSIBLE_SHARE for each in frictions)
    return "ignore" if placeholders or large else "use"


def undecided_friction(tree: Element, planned: Sequence[str]) -> str | None:
    """Describe the friction of planned joints and how a problem file chooses what to do with it; None without any."""
    try:
        every = urdf_parameters(tree).joints.values()
    except RecipeError:
        # Loading the robot raises it.
        return None
    if not (frictions := friction_in([each for each in every if each.name in planned])):
        return None
    listing = ", ".join(map(str, frictions))
    choice = 'write urdf_dynamics = "use" or "ignore" in [drive] to choose'
    return f"the URDF has {listing}; {choice}"


def joint_notes(
    tree: Element, joints: Sequence[UrdfJoint], *, soft: bool = True
) -> Iterator[str]:
    """Yield a sentence for each further element of planned joints: soft limits, rates, controllers, transmissions.

    ``soft`` is whether soft limits are used.
    """
    yield from _controller_notes(tree, joints, soft=soft)
    for rate in ("acceleration", "jerk"):
        if given := [each.name for each in joints if rate in each.rates]:
            yield f"the URDF limits the {rate} of {', '.join(given)}; a value in [limits] replaces it"
    # A reflected inertia J = ratio^2 * J_rotor needs both factors.
    parts = {"mechanicalReduction": "gear_ratio", "motorInertia": "rotor_inertia"}
    reduced: dict[str, list[str]] = {}
    for transmission in tree.findall("transmission"):
        found = [
            f"<{tag}>" for tag in parts if transmission.find(f".//{tag}") is not None
        ]
        for joint in transmission.findall("joint"):
            if found and joint.get("name") in {each.name for each in joints}:
                reduced.setdefault(" and ".join(found), []).append(
                    joint.get("name", "")
                )
    keys = " and ".join(parts.values())
    for text, names in reduced.items():
        yield f"not used of the <transmission> of {', '.join(names)}: {text}; {keys} of [drive] state both"


def _controller_notes(
    tree: Element, joints: Sequence[UrdfJoint], *, soft: bool
) -> Iterator[str]:
    """Yield sentences about the <safety_controller> elements of joints."""
    names = {each.name for each in joints}
    elements = {
        name: controller
        for joint in tree.findall("joint")
        if (name := joint.get("name", "")) in names
        and (controller := joint.find("safety_controller")) is not None
    }
    limited = {each.name: each.soft for each in joints if each.soft != NO_SOFT_LIMITS}
    narrower = [each for each in joints if _is_narrowed(each)]
    if narrower:
        ranges = ", ".join(
            f"{each.name} [{each.soft[0]:g}, {each.soft[1]:g}]" for each in narrower
        )
        effect = "narrow the position limits" if soft else "are ignored"
        yield f"soft limits of the URDF {effect}: {ranges}"
    if none := [name for name in elements if name not in limited]:
        yield f"no soft limits, or zero for both, which stands for none: {', '.join(none)}"
    gains = [
        key
        for key in ("k_position", "k_velocity")
        if any(each.get(key) is not None for each in elements.values())
    ]
    if gains:
        yield f"not used of <safety_controller>: {', '.join(gains)}"


def _is_narrowed(joint: UrdfJoint) -> bool:
    """Return whether a soft limit of a joint is within its hard limits."""
    low, high = joint.soft
    return low > joint.limits.get("lower", -math.inf) or high < joint.limits.get(
        "upper", math.inf
    )
