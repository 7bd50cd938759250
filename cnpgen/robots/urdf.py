"""URDF files: read as UTF-8 text, and looked at before Pinocchio, which trusts them, reads them."""

import math
import re
from pathlib import Path
from xml.etree import ElementTree

from cnpgen.errors import RecipeError
from cnpgen.schema.texts import read_at_most, utf8_text

MOST_BYTES = 1 << 23
MOST_PARTS = 1_000  # links, and joints: Pinocchio descends a chain by recursion, and of 5,000 does not come back
MOST_DEPTH = 64  # elements in one another
_CONTROL = re.compile("[\t\n\r\x7f-\x9f]")  # other ones are no XML; parsers make spaces of a file's own line ends


class _Builder(ElementTree.TreeBuilder):
    """Builds a tree of bounded depth, without a document type, which could define entities."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ElementTree.Element:
        self._depth += 1
        if self._depth > MOST_DEPTH:
            raise ValueError(f"it has more than {MOST_DEPTH} elements in one another")
        for name, value in attrs.items():
            if _CONTROL.search(value):  # names are printed, and written into recipes' comments
                raise ValueError(f"its <{tag} {name}=...> has control characters")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)

    def doctype(self, *_: object) -> None:
        raise ValueError("it has a document type (<!DOCTYPE ...>), which no URDF needs")


def read_urdf(path: Path) -> str:
    """Read the text of a URDF file.

    Raises:
        RecipeError: It cannot be read, is too large or is not UTF-8.
    """
    try:
        return utf8_text(read_at_most(path, MOST_BYTES, "a URDF"), "utf-8", advice="; save the URDF as UTF-8")
    except OSError as error:
        raise RecipeError([f"{path}: cannot be read: {error.strerror or error}"]) from error
    except ValueError as error:
        raise RecipeError([f"{path}: {error}"]) from error


def urdf_tree(text: str) -> ElementTree.Element:
    """Parse the text of a URDF.

    Raises:
        ValueError: It is not XML, or not what any robot needs: too deep, too large, with entities of its own.
    """
    if len(text) > MOST_BYTES:
        raise ValueError(f"it has {len(text):,} characters, expected at most {MOST_BYTES:,}")
    parser = ElementTree.XMLParser(target=_Builder(), encoding="utf-8")  # noqa: S314 - the builder allows no entities
    try:
        parser.feed(text.encode())
        tree: ElementTree.Element = parser.close()
    except ElementTree.ParseError as error:
        raise ValueError(f"it is not XML: {error}") from error
    for part in ("link", "joint"):
        if (count := sum(1 for _ in tree.iter(part))) > MOST_PARTS:
            raise ValueError(f"it has {count:,} {part}s, expected at most {MOST_PARTS:,}")
    return tree


def number_in(element: ElementTree.Element | None, attribute: str, default: float) -> float:
    """Return a number that an element may have.

    Raises:
        ValueError: It has something else.
    """
    text = default if element is None else element.get(attribute, default)
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise ValueError(f"{attribute}={text!r} must be a number (with a point, not a comma)")
    return found
