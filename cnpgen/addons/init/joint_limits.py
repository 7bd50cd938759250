"""MoveIt's joint_limits.yaml, whose limits replace those of the URDF, as in MoveIt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cnpgen.addons.init.arm import Arm, ArmJoint
from cnpgen.documents import NamedNumbers, Names
from cnpgen.errors import UsageError, nearest
from cnpgen.problems.scenes.yaml_document import read_yaml

_LIMITS = {  # flag -> the keys that it switches on
    "has_position_limits": ("min_position", "max_position"),
    "has_velocity_limits": ("max_velocity",),
    "has_acceleration_limits": ("max_acceleration",),
    "has_jerk_limits": ("max_jerk",),
    "has_effort_limits": ("max_effort",),
}
_DEFAULTS = ("default_velocity_scaling_factor", "default_acceleration_scaling_factor")


@dataclass(frozen=True)
class StatedJointLimits:
    """Limits of a file for the joints of an arm, by joint and key; only those whose flag is true."""

    path: Path
    values: Mapping[str, NamedNumbers]
    unused: Names = ()  # sentences about elements of the file

    def of(self, key: str) -> dict[str, float]:
        """Return the values of a key: joint -> limit."""
        return {
            name: limits[key] for name, limits in self.values.items() if key in limits
        }


def read_joint_limits(path: Path, joints: Names) -> StatedJointLimits:
    """Read a joint_limits.yaml for the joints of a robot.

    Raises:
        UsageError: The file has other keys, a flag without its values, a joint that the
            robot lacks, or a value that is not a number.
        MissingExtraError: PyYAML is missing.
    """
    documents = [each for each in read_yaml(path, numbers=True) if each is not None]
    content = documents[0] if len(documents) == 1 else None
    if not isinstance(content, dict) or not isinstance(
        content.get("joint_limits"), dict
    ):
        raise UsageError(f"{path}: expected 'joint_limits' with a table for each joint")
    for key in content:
        if key not in {"joint_limits", *_DEFAULTS}:
            raise UsageError(f"{path}: unknown key {key!r}{nearest(key, _DEFAULTS)}")
    values = {}
    for name, table in content["joint_limits"].items():
        if name not in joints:
            raise UsageError(
                f"{path}: the URDF has no joint {name!r}{nearest(name, joints)}"
            )
        values[name] = _limits(f"{path}: {name}", table)
    unused = [
        f"{path.name}: {name}: {key} is not used, since {flag} is not true"
        for name, table in content["joint_limits"].items()
        for flag, keys in _LIMITS.items()
        for key in keys
        if key in table and key not in values[name]
    ]
    factors = [f"{path.name}: {key} is not used" for key in _DEFAULTS if key in content]
    return StatedJointLimits(path, values, (*unused, *factors))


def _limits(place: str, table: Any) -> dict[str, float]:
    """Return the limits of a joint whose flags are true."""
    if not isinstance(table, dict):
        raise UsageError(f"{place}: expected a table of limits, got {table!r:.60}")
    known = {*_LIMITS, *(key for part in _LIMITS.values() for key in part)}
    for key in table:
        if key not in known:
            raise UsageError(f"{place}: unknown key {key!r}{nearest(key, known)}")
    found = {}
    for flag, names in _LIMITS.items():
        if not _is_true(f"{place}: {flag}", table.get(flag, "false")):
            continue
        for key in names:
            value = table.get(key)
            if not isinstance(value, float):
                raise UsageError(f"{place}: {key} must be a number, got {value!r:.60}")
            found[key] = value
    for key in ("max_velocity", "max_acceleration", "max_jerk", "max_effort"):
        if found.get(key, 1.0) <= 0:
            raise UsageError(f"{place}: {key} must be positive, got {found[key]:g}")
    low = found.get("min_position", 0.0)
    high = found.get("max_position", 1.0)
    if "min_position" in found and low >= high:
        raise UsageError(
            f"{place}: min_position must be below max_position, got {low:g} and {high:g}"
        )
    return found


def _is_true(place: str, value: Any) -> bool:
    text = str(value).lower()
    if text not in {"true", "false"}:
        raise UsageError(f"{place} must be true or false, got {value!r:.60}")
    return text == "true"


def with_joint_limits(arm: Arm, limits: StatedJointLimits) -> Arm:
    """Return an arm whose positions, velocities and torques have the limits of a file where it has some."""

    def changed(joint: ArmJoint) -> ArmJoint:
        values = limits.values.get(joint.name, {})
        names = {
            "position": "min_position",
            "velocity": "max_velocity",
            "torque": "max_effort",
        }
        stated = {name for name, key in names.items() if key in values}
        return replace(
            joint,
            lower=values.get("min_position", joint.lower),
            upper=values.get("max_position", joint.upper),
            velocity=values.get("max_velocity", joint.velocity),
            effort=values.get("max_effort", joint.effort),
            missing=tuple(name for name in joint.missing if name not in stated),
            replaced=tuple(sorted(stated)),
        )

    planned = tuple(map(changed, arm.planned))
    others = [joint for joint in arm.locked if limits.values.get(joint)]
    unused = [
        f"{limits.path.name}: limits of {joint} are not used, since it is not planned"
        for joint in others
    ]
    return replace(arm, planned=planned, doubts=(*arm.doubts, *limits.unused, *unused))
