"""Names of columns: which column has the positions, velocities or accelerations of a joint."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from cnpgen.addons.trajectories.table_units import plain

TIME_NAMES = ("t", "time", "timestamp", "time_from_start", "seconds")
KIND_NAMES = {
    "q": ("q", "position", "positions", "pos"),
    "dq": ("dq", "qd", "velocity", "velocities", "vel"),
    "ddq": ("ddq", "qdd", "acceleration", "accelerations", "acc"),
}
KIND_WORDS = {"q": "position", "dq": "velocity", "ddq": "acceleration"}
_INDEX = re.compile(r"\[(\d+)\]$")  # "position[0]" is "position_0"
_SEPARATORS = (" ", "_", ".", "/", ":", "")


def key_of(name: str) -> str:
    """Return the name of a column without its unit in lower case, by which it is found."""
    return _INDEX.sub(r"_\1", plain(name)).lower()


def joint_columns(
    keys: Mapping[str, str], joints: Sequence[str], kind: str
) -> list[str] | None:
    """Return the column of every joint by the names of the joints, or by numbers from 0 or from 1.

    Args:
        keys: ``key_of`` a column -> its name.
        joints: Names of the joints in the file.
        kind: A key of ``KIND_NAMES``.

    Returns:
        Names of the columns; None without any of the kind.

    Raises:
        ValueError: Columns of some joints are missing, or numbers are ambiguous.
    """
    named = [column_of(keys, joint, kind) for joint in joints]
    if all(named):
        return [name for name in named if name]
    if any(named):
        missing = joints[named.index(None)]
        raise ValueError(f"no column with the {KIND_WORDS[kind]} of {missing!r}")
    if any(joint.isdecimal() for joint in joints):
        return None
    numbered = [
        [column_of(keys, str(k + first), kind) for k in range(len(joints))]
        for first in (0, 1)
    ]
    complete = [found for found in numbered if all(found)]
    if len(complete) == 2:
        # Such as q0 to q6 for six joints.
        first = complete[0][0]
        last = complete[1][-1]
        raise ValueError(
            f"{len(joints) + 1} columns from {first!r} to {last!r} for {len(joints)} joints:"
            " --joints names those of the problem's joints, in order"
        )
    if complete:
        return [name for name in complete[0] if name]
    count = max(len(joints) - found.count(None) for found in numbered)
    if kind == "q" and count > 1:
        raise ValueError(
            f"{count} columns with joint positions, the problem plans {len(joints)} joints"
        )
    return None


def column_of(keys: Mapping[str, str], joint: str, kind: str) -> str | None:
    """Return the column of a joint and a kind, such as ``"q joint_1 [rad]"`` or ``"joint_1_position"``.

    Positions may have the joint's name alone.
    """
    joint = _INDEX.sub(r"_\1", joint.lower())
    if kind == "q" and joint in keys and not joint.isdecimal():
        return keys[joint]
    for word in KIND_NAMES[kind]:
        for separator in _SEPARATORS:
            for name in (f"{word}{separator}{joint}", f"{joint}{separator}{word}"):
                if name in keys:
                    return keys[name]
    return None


def is_number(value: Any) -> bool:
    """Return whether a value can be read as a number."""
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True
