"""Random changes of valid files: bytes, texts, JSON and URDF."""

import copy
import json
from random import Random
from typing import Any
from xml.etree import ElementTree

NUMBERS = (
    0,
    -1,
    1,
    2,
    2**31,
    2**63,
    10**18,
    10**30,
    -(10**30),
    0.5,
    -0.0,
    1e-320,
    1e308,
    -1e308,
)
TEXTS = (
    "",
    "x",
    "../../x",
    "/etc/passwd",
    "nan",
    "-inf",
    "0,5",
    "1e999",
    "\x1b[31m",
    "\x00",
    "é" * 3,
    "a" * 5000,
    "\ud800",
)
URDF_NUMBERS = (
    *(
        "1,5",
        "nan",
        "inf",
        "-inf",
        "0x10",
        "",
        " ",
        "1.5 kg",
        "1_5",
        "1d3",
        "1e999",
        "1e-320",
        "1e308",
        "-1e308",
    ),
    *(
        "-1",
        "0",
        "+2.5",
        ".5",
        "5.",
        "1e3",
        "1.5E-3",
        "0 0 1",
        "0,1 0 0",
        "nan 0 0",
        "1 0",
        "0  0 1",
        " 0 1 0 ",
        "1;2;3",
    ),
)
WORDS = (
    b"\0",
    b"\xff",
    b"\xff" * 8,
    b"\0" * 8,
    b"GCOL\x01\0\0\0",
    b"TREE",
    b"OHDR",
    b"[" * 5000,
    b"9" * 5000,
)


def change_bytes(
    content: bytes, draw: Random, *, among: list[int] | None = None
) -> bytes:
    """Flip, replace, insert, delete or cut off bytes.

    Args:
        content: The bytes.
        draw: Random number generator.
        among: Preferred positions of changes; all positions by default.
    """
    data = bytearray(content)
    for _ in range(draw.choice((1, 1, 1, 2, 5, 30))):
        if not data:
            break
        place = (
            draw.choice(among)
            if among and draw.random() < 0.8
            else draw.randrange(len(data))
        )
        place = min(place, len(data) - 1)
        how = draw.randrange(12)
        if how < 6:
            data[place] ^= 1 << draw.randrange(8)
        elif how < 8:
            data[place] = draw.choice((0, 1, 0x7F, 0x80, 0xFF, draw.randrange(256)))
        elif how == 8:
            word = draw.choice(WORDS)
            data[place : place + len(word)] = word
        elif how == 9:
            data[place:place] = draw.choice(WORDS)
        elif how == 10:
            del data[place : place + draw.choice((1, 8, 100))]
        else:
            del data[place:]
    return bytes(data)


def change_text(text: str, draw: Random) -> str:
    """Change the lines of a text and the numbers and texts in them."""
    lines = text.splitlines()
    for _ in range(draw.choice((1, 1, 2, 4))):
        index = draw.randrange(len(lines)) if lines else 0
        how = draw.randrange(6)
        if not lines or how == 0:
            lines.insert(
                index,
                draw.choice(lines)
                if lines and draw.random() < 0.7
                else str(draw.choice(TEXTS)),
            )
        elif how == 1:
            del lines[index]
        elif how == 2 and "=" in lines[index]:
            key, _, _ = lines[index].partition("=")
            lines[index] = (
                f"{key}= {draw.choice([*map(repr, NUMBERS), *map(json.dumps, TEXTS), '[]', '{}', 'true', 'nan'])}"
            )
        elif how == 3 and "=" in lines[index]:
            key, _, value = lines[index].partition("=")
            lines[index] = (
                f"{draw.choice(('name', 'use', 'x' * 300, key + '.' + key))} ={value}"
            )
        elif how == 4:
            at = draw.randrange(len(lines[index]) + 1)
            lines[index] = (
                lines[index][:at]
                + draw.choice(('"', "]", "[", "{", "=", ".", "\x00", "9" * 400))
                + lines[index][at:]
            )
        else:
            other = draw.randrange(len(lines))
            lines[index], lines[other] = lines[other], lines[index]
    return "\n".join(lines) + "\n"


def change_json(document: Any, draw: Random) -> Any:
    """Replace, delete, add or repeat values somewhere in a document."""
    changed = json.loads(json.dumps(document))
    for _ in range(draw.choice((1, 1, 2))):
        places = [place for place in _places(changed) if place[1] != "format"]
        if not places:
            break
        parent, key = draw.choice(places)
        how = draw.randrange(8)
        if how == 0:
            del parent[key]
        elif how == 1 and isinstance(parent, list):
            parent.extend([copy.deepcopy(parent[key])] * draw.choice((1, 200)))
        elif how == 2 and isinstance(parent, dict):
            parent[draw.choice(TEXTS[:-1])] = copy.deepcopy(parent[key])
        elif how == 3:
            source, other = draw.choice(places)
            parent[key] = copy.deepcopy(source[other])
        else:
            parent[key] = draw.choice(
                (
                    *NUMBERS,
                    *TEXTS[:-1],
                    None,
                    True,
                    [],
                    {},
                    [[]],
                    [1, "a"],
                    {"a": 1},
                    _deep(draw),
                )
            )
    return changed


def change_urdf(text: str, draw: Random) -> str:
    """Change attributes and elements of a URDF, or its text."""
    if draw.random() < 0.2:
        return change_text(text, draw)
    tree = ElementTree.fromstring(text)
    for _ in range(draw.choice((1, 1, 2, 5))):
        parents = [element for element in tree.iter() if len(element)]
        if not parents:  # an earlier change removed the last element
            break
        parent = draw.choice(parents)
        element = draw.choice(list(parent))
        how = draw.randrange(6)
        if how == 0:
            parent.remove(element)
        elif how == 1:
            parent.append(copy.deepcopy(element))
        elif how == 2:
            draw.choice(parents).append(copy.deepcopy(element))
        elif how == 3 and element.attrib:
            element.attrib.pop(draw.choice(list(element.attrib)))
        elif how == 4:
            element.tag = draw.choice(
                ("link", "joint", "mimic", "limit", "x", "inertial")
            )
        elif element.attrib:
            name = draw.choice(list(element.attrib))
            others = [item.attrib[name] for item in tree.iter() if name in item.attrib]
            values = [
                *others,
                *map(str, NUMBERS),
                *(text for text in TEXTS if text.isprintable()),
                "0 0",
                "floating",
            ]
            element.attrib[name] = draw.choice(values)
    return ElementTree.tostring(tree, encoding="unicode")


def changed_number(text: str, draw: Random) -> str:
    """Change a numeric attribute of a link, a joint or an inertia."""
    tree = ElementTree.fromstring(text)
    parts = [*tree.iterfind("link/inertial/*"), *tree.iterfind("joint/*")]
    numeric = [
        (item, name)
        for item in parts
        for name in item.attrib
        if item.tag not in ("parent", "child", "mimic")
    ]
    for _ in range(draw.choice((1, 1, 2))):
        element, name = draw.choice(numeric)
        if draw.random() < 0.1:
            element.attrib.pop(name, None)
        else:
            element.set(name, draw.choice(URDF_NUMBERS))
    return ElementTree.tostring(tree, encoding="unicode")


def _deep(draw: Random) -> Any:
    value: Any = 1
    for _ in range(draw.choice((3, 40, 200))):
        value = [value] if draw.random() < 0.5 else {"a": value}
    return value


def _places(value: Any) -> list[tuple[Any, Any]]:
    """List (parent, key) of every value in a document."""
    found, waiting = [], [value] if isinstance(value, dict | list) else []
    while waiting:
        parent = waiting.pop()
        entries = (
            list(parent.items())
            if isinstance(parent, dict)
            else list(enumerate(parent))
        )
        found += [(parent, key) for key, _ in entries]
        waiting += [item for _, item in entries if isinstance(item, dict | list)]
    return found
