"""URDF files: read as UTF-8 text and validated as untrusted input before Pinocchio parses them."""

import math
import re
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers.expat import ExpatError, ParserCreate
from xml.parsers.expat.errors import XML_ERROR_UNBOUND_PREFIX, codes

from cnpgen.errors import RecipeError
from cnpgen.schema.texts import read_at_most, utf8_text

MAX_URDF_BYTES = 1 << 23
# Links or joints: Pinocchio recurses along a chain and crashes at 5,000.
MAX_URDF_ELEMENTS = 1_000
MAX_DEPTH = 64  # of nested elements
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
# Others are invalid in XML; parsers replace line ends in attributes by spaces.
_CONTROL = re.compile("[\t\n\r\x7f-\x9f]")


class _Builder(ElementTree.TreeBuilder):
    """Tree builder of bounded depth that rejects document types, which could define entities."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ElementTree.Element:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise ValueError(f"it has more than {MAX_DEPTH} nested elements")
        for name, value in attrs.items():
            if _CONTROL.search(value):
                # Names appear in output and in comments of recipes.
                raise ValueError(f"its <{tag} {name}=...> has control characters")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)

    def doctype(self, *_: object) -> None:
        raise ValueError("it has a document type (<!DOCTYPE ...>), which no URDF needs")


def read_urdf(path: Path) -> str:
    """Read the text of a URDF file.

    RecipeError if it cannot be read, is too large or is not UTF-8.
    """
    try:
        return utf8_text(
            read_at_most(path, MAX_URDF_BYTES, "a URDF"),
            "utf-8",
            hint="; save the URDF as UTF-8",
        )
    except OSError as error:
        raise RecipeError(
            [f"{path}: cannot be read: {error.strerror or error}"]
        ) from error
    except ValueError as error:
        raise RecipeError([f"{path}: {error}"]) from error


def urdf_tree(text: str) -> ElementTree.Element:
    """Parse the text of a URDF.

    ValueError if it is not XML, too deep or too large, or defines entities.
    """
    if len(text) > MAX_URDF_BYTES:
        raise ValueError(
            f"it has {len(text):,} characters, expected at most {MAX_URDF_BYTES:,}"
        )
    parser = ElementTree.XMLParser(target=_Builder(), encoding="utf-8")  # noqa: S314 - the builder allows no entities
    try:
        parser.feed(text.encode())
        tree: ElementTree.Element = parser.close()
    except ElementTree.ParseError as error:
        if error.code != codes[XML_ERROR_UNBOUND_PREFIX]:
            raise ValueError(f"it is not XML: {error}") from error
        tree = _tree_without_namespaces(text)
    for part in ("link", "joint"):
        if (count := sum(1 for _ in tree.iter(part))) > MAX_URDF_ELEMENTS:
            raise ValueError(
                f"it has {count:,} {part}s, expected at most {MAX_URDF_ELEMENTS:,}"
            )
    return tree


def _tree_without_namespaces(text: str) -> ElementTree.Element:
    """Parse the text of a URDF with undeclared prefixes, such as those of Gazebo, as other URDF parsers do."""
    parser = ParserCreate("utf-8")
    builder = _Builder()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = builder.doctype
    try:
        parser.Parse(text.encode(), True)
    except ExpatError as error:
        raise ValueError(f"it is not XML: {error}") from error
    return builder.close()


def numbers_text(values: Iterable[float]) -> str:
    """Return numbers as the text of an attribute, from which the same float64 are read."""
    return " ".join(f"{value:.17g}" for value in values)


def number_in(
    element: ElementTree.Element | None, attribute: str, default: float
) -> float:
    """Return a numeric attribute of an element; ValueError if it is not a number."""
    return numbers_in(element, attribute, (default,))[0]


def numbers_in(
    element: ElementTree.Element | None, attribute: str, default: tuple[float, ...]
) -> tuple[float, ...]:
    """Return the numbers in an attribute of an element; as many as the default ones of a missing attribute or element.

    The accepted notation is that of URDF parsers, which drop an element with other
    numbers without an error.
    """
    text = None if element is None else element.get(attribute)
    if element is None or text is None:
        return default
    words = [text] if len(default) == 1 else [word for word in text.split(" ") if word]
    if len(words) != len(default) or not all(
        _DECIMAL.fullmatch(word) for word in words
    ):
        expected = "a number" if len(default) == 1 else f"{len(default)} numbers"
        raise ValueError(
            f"<{element.tag} {attribute}={text!r}> must be {expected}, with a point and not a comma, without units"
        )
    found = tuple(map(float, words))
    if not all(map(math.isfinite, found)):
        raise ValueError(f"<{element.tag} {attribute}={text!r}> is too large")
    return found
