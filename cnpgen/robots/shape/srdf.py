"""Disabled link pairs of an SRDF and of a problem, stored in the text of the URDF."""

from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

from cnpgen.errors import RecipeError
from cnpgen.robots.urdf import read_urdf, urdf_tree

_TAG = "disable_collisions"


def with_disabled_pairs(urdf: str, srdf: Path) -> str:
    """Return a URDF with the disabled link pairs of an SRDF file; URDF parsers ignore unknown elements.

    Raises:
        RecipeError: The SRDF cannot be read, is a URDF, or names links that the URDF does not have.
    """
    try:
        tree = urdf_tree(read_urdf(srdf))
    except ValueError as error:
        raise RecipeError([f"{srdf}: not an SRDF that can be read: {error}"]) from error
    if tree.find("link") is not None:
        raise RecipeError([f"{srdf}: is a URDF, expected an SRDF with <{_TAG}> elements"])
    return _with_entries(urdf, [dict(entry.attrib) for entry in tree.iter(_TAG)], str(srdf))


def with_ignored_pairs(urdf: str, pairs: Iterable[tuple[str, str]]) -> str:
    """Return a URDF with disabled link pairs of a problem.

    Raises:
        RecipeError: A pair names a link that the URDF does not have.
    """
    entries = [{"link1": first, "link2": second, "reason": "User"} for first, second in pairs]
    return _with_entries(urdf, entries, "robot.ignored_pairs")


def _with_entries(urdf: str, entries: list[dict[str, str]], source: str) -> str:
    robot = urdf_tree(urdf)
    links = {link.get("name", "") for link in robot.iter("link")}
    for entry in entries:
        if missing := [key for key in ("link1", "link2") if key not in entry]:
            raise RecipeError([f"{source}: {entry} lacks {', '.join(missing)}"])
    named = {entry[key] for entry in entries for key in ("link1", "link2")}
    if unknown := sorted(named - links):
        raise RecipeError([f"{source}: the URDF has no link {', '.join(unknown)}"])
    known = [frozenset((one.get("link1"), one.get("link2"))) for one in robot.iter(_TAG)]
    for entry in entries:
        if frozenset((entry["link1"], entry["link2"])) not in known:
            robot.append(ElementTree.Element(_TAG, entry))
    return ElementTree.tostring(robot, encoding="unicode")


def disabled_pairs(urdf: str) -> frozenset[frozenset[str]] | None:
    """Return the disabled link pairs; None without any."""
    entries = list(urdf_tree(urdf).iter(_TAG))
    pairs = frozenset(frozenset((entry.get("link1", ""), entry.get("link2", ""))) for entry in entries)
    return pairs or None
