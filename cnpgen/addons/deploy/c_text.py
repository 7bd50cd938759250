"""C text of names, numbers and tables; names of model files are untrusted and never end a comment or a string."""

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_PREFIX_LENGTH = 40  # compilers distinguish 63 characters, with suffixes
FALLBACK_NAME = "planner"
NUMBERS_PER_LINE = 10
# Without / * \ ? and quotes.
_SAFE_IN_COMMENT = re.compile(r"[^A-Za-z0-9 _.,:;()+=<>%@#|~^-]")


# Of C11: a file NAME.h of the same name would hide one of them.
STANDARD_HEADER = re.compile(
    "assert|complex|ctype|errno|fenv|float|inttypes|iso646|limits|locale|math|setjmp"
    "|signal|stdalign|stdarg|stdatomic|stdbool|stddef|stdint|stdio|stdlib|stdnoreturn"
    "|string|tgmath|threads|time|uchar|wchar|wctype"
)


def identifier(text: str) -> str:
    """Map a name to [a-z0-9_], beginning with a letter: the prefix of all names of a planner."""
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")[:MAX_PREFIX_LENGTH]
    name = name.rstrip("_")
    if not name:
        return FALLBACK_NAME
    if name[0].isalpha() and not STANDARD_HEADER.fullmatch(name):
        return name
    return f"{FALLBACK_NAME}_{name}"[:MAX_PREFIX_LENGTH]


def comment_text(text: str) -> str:
    """Return a text for a comment or a page: other characters than letters, digits and some signs become "_"."""
    return _SAFE_IN_COMMENT.sub("_", text)


def string_literal(text: str) -> str:
    """Return a C string of a text in UTF-8; all but plain characters are octal escapes of three digits."""
    plain = set(
        b" !#$%&'()*+,-./0123456789:;<=>@ABCDEFGHIJKLMNOPQRSTUVWXYZ[]^_`abcdefghijklmnopqrstuvwxyz{|}~"
    )
    content = "".join(
        chr(byte) if byte in plain else f"\\{byte:03o}"
        # Three digits end an octal escape, whatever character follows.
        for byte in text.encode("utf-8", "surrogatepass")
    )
    return f'"{content}"'


def number(value: float) -> str:
    """Return a float64 as a C constant that reads back exactly."""
    value = float(value)
    if np.isnan(value):
        return "NAN"
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    # The shortest decimal that reads back as the same float64.
    return repr(value) if value else "0"


def _single(value: float) -> str:
    """Return a float32 as a C constant; nine digits determine it."""
    text = f"{float(value):.9g}" if value else "0"
    return f"{text}f" if {".", "e"} & set(text) else f"{text}.0f"


def _whole(value: float) -> str:
    return str(int(value))


def table(kind: str, name: str, values: NDArray[Any] | Iterable[Any]) -> str:
    """Return the definition of a constant array of "double", "float" or "int"."""
    flat = np.asarray(values).ravel().tolist()
    write = {"double": number, "float": _single, "int": _whole}[kind]
    texts = [write(value) for value in flat]
    lines = [
        ", ".join(texts[first : first + NUMBERS_PER_LINE])
        for first in range(0, len(texts), NUMBERS_PER_LINE)
    ]
    body = ",\n  ".join(lines)
    return f"static const {kind} {name}[{len(flat)}] = {{\n  {body}}};\n"
