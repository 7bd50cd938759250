"""Joints of a URDF that mimic others: Pinocchio reads them as joints of their own, so most of them are refused."""

from collections.abc import Iterator, Sequence
from xml.etree import ElementTree

from cnpgen.errors import RecipeError


def check_mimic(urdf: str, joints: Sequence[str]) -> None:
    """Raise RecipeError where a joint that mimics another would not stand where its robot has it.

    Args:
        urdf: The text of the URDF; one that cannot be parsed is left to Pinocchio.
        joints: The planned joints; all others stay at zero.
    """
    try:
        tree = ElementTree.fromstring(urdf.encode())  # noqa: S314 - a user's own file, and expat expands no external entities
    except (ValueError, ElementTree.ParseError):
        return
    mistakes = [f"robot.joints: {text}" for joint in tree.iter("joint") for text in _mistakes(joint, joints)]
    if mistakes:
        raise RecipeError(mistakes)


def _mistakes(joint: ElementTree.Element, planned: Sequence[str]) -> Iterator[str]:
    mimic = joint.find("mimic")
    if mimic is None:
        return
    name, other = joint.get("name", ""), mimic.get("joint", "")
    if name in planned:
        yield f"{name!r} mimics {other!r} and cannot be planned by itself; mimic joints are not supported"
    elif other in planned:
        yield f"{name!r} mimics the planned joint {other!r}, but would stay at zero; mimic joints are not supported"
    elif float(mimic.get("offset") or 0.0) != 0.0:
        yield f"{name!r} mimics {other!r} with an offset, but would stay at zero; mimic joints are not supported"
