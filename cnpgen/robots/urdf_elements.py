"""Elements and attributes of a URDF that are not read: misspelt ones, others, and those of other software."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

from cnpgen.errors import RecipeError, counted, listed, nearest
from cnpgen.store.files.accounted import MISSPELT

_TOP = ("link", "joint")
# Of which an element has several.
_REPEATED = {*_TOP, "collision", "visual", "disable_collisions"}
# tag -> its attributes, and its children in <>, that are read or change nothing (name)
_KNOWN: dict[str, tuple[str, ...]] = {
    "robot": ("name", "version", "<link>", "<joint>"),
    "link": ("name", "<inertial>", "<collision>", "<visual>"),
    "joint": (
        *("name", "type", "<parent>", "<child>", "<origin>", "<axis>", "<limit>"),
        *("<dynamics>", "<mimic>", "<safety_controller>", "<calibration>"),
    ),
    "inertial": ("<origin>", "<mass>", "<inertia>"),
    "collision": ("name", "<origin>", "<geometry>"),
    "visual": ("name", "<origin>", "<geometry>", "<material>"),
    "geometry": ("<box>", "<cylinder>", "<sphere>", "<capsule>", "<mesh>"),
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "parent": ("link",),
    "child": ("link",),
    "limit": (
        *("lower", "upper", "effort", "velocity"),
        *("acceleration", "deceleration", "jerk"),
    ),
    "dynamics": ("damping", "friction"),
    "mimic": ("joint", "multiplier", "offset"),
    "safety_controller": (
        *("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity"),
    ),
    # The zero of a sensor.
    "calibration": ("reference_position", "rising", "falling"),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
    "capsule": ("radius", "length"),
    "mesh": ("filename", "scale"),
}
DISABLED = "disable_collisions"
NO_DEFAULT = "disable_default_collisions"
PAIR = ("link1", "link2")
# The problem names the planned joints, the tip and the placement of the base; pairs are
# checked unless they are disabled, which takes precedence over <enable_collisions>.
SRDF_NAMES: dict[str, tuple[str, ...]] = {
    "robot": (
        *("name", "version", f"<{DISABLED}>", f"<{NO_DEFAULT}>", "<group>"),
        *("<group_state>", "<end_effector>", "<virtual_joint>", "<passive_joint>"),
        *("<joint_property>", "<link_sphere_approximation>", "<enable_collisions>"),
    ),
    DISABLED: (*PAIR, "reason"),
}
_ANYWHERE = {"name", "type", "version", "group"}  # change nothing elsewhere
_OPAQUE = {"material"}  # colors
_TEXT = "the text"
MAX_LISTED_TAGS = 10


def unread_elements(tree: Element) -> Iterator[str]:
    """Yield sentences about the elements and attributes of a URDF that have no effect."""
    counts = Counter(each.tag for each in tree if each.tag not in {*_TOP, *_OPAQUE})
    if counts:
        texts = [f"<{tag}> ({count})" for tag, count in sorted(counts.items())]
        yield f"elements of other software are not read: {listed(texts, MAX_LISTED_TAGS)}"
    unknown = Counter(text for part in tree for text, *_ in _unknown(part))
    for text, count in sorted(unknown.items()):
        yield f"{text} is not read, {counted(count, 'time')}"


def check_elements(
    tree: Element,
    path: Path,
    known: Mapping[str, tuple[str, ...]] = _KNOWN,
    *,
    allow_unused: Collection[str] = (),
) -> None:
    """Raise RecipeError for parts of a file that are misspelt or misplaced, or repeat one of which the first alone is read.

    A misspelt name is near one that is read, may occur beside it, and does not. The
    caller accepts the loss of misspelt and misplaced parts with some names.
    """
    if tree.tag != "robot":
        raise RecipeError([f"{path}: its root is <{tree.tag}>, expected <robot>"])
    hints = {
        text: nearest(name, names, similarity=MISSPELT)
        or _other_place(text, name, known)
        for text, name, names in _unknown(tree, known)
        if name not in allow_unused
    }
    parts = [f"{text}{hint}" for text, hint in hints.items() if hint]
    if "mimic" not in allow_unused:
        parts += _unknown_leaders(tree)
    if parts := [*parts, *_repeated(tree, known)]:
        named = listed(parts, MAX_LISTED_TAGS)
        remedy = "rename or remove it, or accept its loss by allow_unused in [robot] (--allow-unused of 'cnpgen init')"
        raise RecipeError([f"{path}: {named} would not be read: {remedy}"])


def check_names(tree: Element, path: Path) -> None:
    """Raise RecipeError if a link or a joint has no name."""
    for tag in _TOP:
        for number, part in enumerate(tree.findall(tag), start=1):
            if not part.get("name"):
                text = f"<{tag}> {number} of the file has no name, expected a text"
                raise RecipeError([f"{path}: {text}"])


def unknown_names(
    tree: Element, known: Mapping[str, tuple[str, ...]] = _KNOWN
) -> list[str]:
    """Return the names of the elements and attributes that are not read."""
    names = [name for _, name, _ in _unknown(tree, known)]
    return [*names, *("mimic" for _ in _unknown_leaders(tree))]


def _unknown(
    element: Element, table: Mapping[str, tuple[str, ...]] = _KNOWN
) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Yield the unknown parts of an element and of those in it: a text, the name, and the names that it may mean."""
    known = table.get(element.tag)
    if known is None:
        return
    present = {*element.attrib, *(f"<{child.tag}>" for child in element)}
    present -= {f"<{tag}>" for tag in _REPEATED}
    missing = tuple(name.strip("<>") for name in known if name not in present)
    for key in element.attrib:
        # attributes with a name space are those of other software
        if key not in known and not key.startswith("{"):
            names = () if f"<{key}>" in known else missing
            yield f"the attribute {key!r} of <{element.tag}>", key, names
    if words := " ".join(
        [element.text or "", *(each.tail or "" for each in element)]
    ).split():
        yield f"{_TEXT} {' '.join(words)!r:.40} in <{element.tag}>", element.tag, ()
    for child in element:
        if f"<{child.tag}>" not in known and child.tag not in _OPAQUE:
            names = () if child.tag in known else missing
            yield f"<{child.tag}> in <{element.tag}>", child.tag, names
        else:
            yield from _unknown(child, table)


def _other_place(text: str, name: str, table: Mapping[str, tuple[str, ...]]) -> str:
    """Return where an unknown part is read, for messages, or an empty text."""
    if text.startswith(_TEXT):
        # Of elements with attributes alone, such as <axis>0 0 1</axis> of SDF.
        has_children = any(each.startswith("<") for each in table[name])
        return "" if has_children else f" (expected {listed(table[name])})"
    tag = f"<{name}>"
    own, other = (tag, name) if text.startswith("<") else (name, tag)
    for kind, where in ((own, "it belongs in"), (other, f"{other} is read in")):
        places = [parent for parent, names in table.items() if kind in names]
        if places and (name not in _ANYWHERE or text.endswith(f" <{places[0]}>")):
            return f" ({where} <{places[0]}>)"
    # MoveIt reads these from an SRDF alone.
    is_foreign = table is _KNOWN and text == f"{tag} in <robot>"
    return " (it belongs in an SRDF)" * (is_foreign and tag in SRDF_NAMES["robot"])


def _unknown_leaders(tree: Element) -> Iterator[str]:
    """Yield texts of joints that mimic one which the file lacks: parsers drop the <mimic>."""
    names = [joint.get("name", "") for joint in tree.findall("joint")]
    for joint in tree.findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None and (leader := mimic.get("joint", "")) not in names:
            text = f"the <mimic> of {joint.get('name')!r}, which names no joint of the file, {leader!r}"
            yield f"{text}{nearest(leader, names)},"


def _repeated(element: Element, table: Mapping[str, tuple[str, ...]]) -> Iterator[str]:
    """Yield texts of known elements that occur twice in a link or joint, or of a second shape."""
    known = table.get(element.tag, ())
    counts = Counter(
        "shape" if element.tag == "geometry" else f"<{child.tag}>"
        for child in element
        if f"<{child.tag}>" in known and child.tag not in {*_REPEATED, *_OPAQUE}
    )
    for what, count in counts.items():
        # A robot has several links, groups and states.
        if count > 1 and element.tag != "robot":
            yield f"a second {what} in <{element.tag}>"
    for child in element:
        if f"<{child.tag}>" in known:
            yield from _repeated(child, table)
