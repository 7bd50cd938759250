"""Elements and attributes of a URDF that are not read: those of other software in one line, others one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from xml.etree.ElementTree import Element

from cnpgen.errors import counted, listed, nearest

# tag -> its attributes and children that are read or change nothing (name, color)
_KNOWN: dict[str, tuple[str, ...]] = {
    "link": ("name", "inertial", "collision", "visual"),
    "joint": (
        *("name", "type", "parent", "child", "origin", "axis", "limit", "dynamics"),
        *("mimic", "safety_controller", "calibration"),
    ),
    "inertial": ("origin", "mass", "inertia"),
    "collision": ("name", "group", "origin", "geometry"),
    "visual": ("name", "group", "origin", "geometry", "material"),
    "geometry": ("box", "cylinder", "sphere", "capsule", "mesh"),
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "parent": ("link",),
    "child": ("link",),
    "limit": ("lower", "upper", "effort", "velocity", "acceleration", "jerk"),
    "dynamics": ("damping", "friction"),
    "mimic": ("joint", "multiplier", "offset"),
    "safety_controller": (
        *("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity"),
    ),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
    "capsule": ("radius", "length"),
    "mesh": ("filename", "scale"),
}
_OPAQUE = {"material", "calibration"}  # colors, and the zero of a sensor
MAX_LISTED_TAGS = 10


def unread_elements(tree: Element) -> Iterator[str]:
    """Yield sentences about the elements and attributes of a URDF that have no effect."""
    counts = Counter(
        each.tag for each in tree if each.tag not in {"link", "joint", *_OPAQUE}
    )
    if counts:
        texts = [f"<{tag}> ({count})" for tag, count in sorted(counts.items())]
        yield f"elements of other software are not read: {listed(texts, MAX_LISTED_TAGS)}"
    unknown = Counter[str]()
    for element in tree:
        if element.tag in {"link", "joint"}:
            unknown.update(_unknown(element))
    for text, count in sorted(unknown.items()):
        yield f"{text} is not read, {counted(count, 'time')}"


def _unknown(element: Element) -> Iterator[str]:
    """Yield the unknown parts of an element and of those in it, with the nearest known name."""
    known = _KNOWN.get(element.tag)
    if known is None:
        return
    for key in element.attrib:
        # attributes with a name space are those of other software
        if key not in known and not key.startswith("{"):
            yield f"the attribute {key!r} of <{element.tag}>{nearest(key, known)}"
    for child in element:
        if child.tag not in known and child.tag not in _OPAQUE:
            yield f"<{child.tag}> in <{element.tag}>{nearest(child.tag, known)}"
        else:
            yield from _unknown(child)
