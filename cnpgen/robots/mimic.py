"""Mimic joints of a URDF: Pinocchio treats them as independent joints, so most of them raise an error."""

from collections.abc import Iterator, Sequence
from xml.etree.ElementTree import Element

from cnpgen.errors import RecipeError
from cnpgen.robots.urdf import number_in


def check_mimic(tree: Element, joints: Sequence[str]) -> None:
    """Raise RecipeError if a mimic joint would have a wrong position.

    Args:
        tree: Parsed URDF.
        joints: Planned joints; all others stay at zero.
    """
    mistakes = [f"robot.joints: {text}" for joint in tree.iter("joint") for text in _mistakes(joint, joints)]
    if mistakes:
        raise RecipeError(mistakes)


def _mistakes(joint: Element, planned: Sequence[str]) -> Iterator[str]:
    mimic = joint.find("mimic")
    if mimic is None:
        return
    name, other = joint.get("name", ""), mimic.get("joint", "")
    if name in planned:
        yield f"{name!r} mimics {other!r} and cannot be planned by itself; mimic joints are not supported"
    elif other in planned:
        yield f"{name!r} mimics the planned joint {other!r}, but would stay at zero; mimic joints are not supported"
    elif offset := _offset(mimic):
        yield f"{name!r} mimics {other!r} with {offset}, but would stay at zero; mimic joints are not supported"


def _offset(mimic: Element) -> str:
    """Return an error message for a non-zero offset, otherwise an empty text."""
    try:
        return "an offset" if number_in(mimic, "offset", 0.0) else ""
    except ValueError as error:
        return str(error)
