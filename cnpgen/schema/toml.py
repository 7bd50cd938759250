"""Recipe files as tables: TOML read, with the line of a mistake, and of which kind a table is."""

import re
import tomllib
from pathlib import Path
from typing import Any, Literal

from cnpgen.schema.texts import read_at_most, utf8_text

Kind = Literal["problem", "pipeline", "dataset", "suite"]

MARKS: dict[Kind, set[str]] = {
    "problem": {"robot", "constraint", "limits"},
    "pipeline": {"stage", "problem"},
    "dataset": {"splits", "pipeline"},
    "suite": {"pucks", "turns", "draws"},
}
"""Top-level keys that only files of a kind have."""


# What strangers' files may be, looked at before they are parsed: tomllib takes the square of a key's parts as its time.
MOST_BYTES = 1 << 18
MOST_PARTS = 16  # of a key: a.b.c has three
_LONG_KEY = re.compile(
    rf"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{MOST_PARTS}}}""", re.ASCII
)


def kind_of_file(path: Path) -> Kind:
    """Tell the kind of a recipe file by its keys; "dataset" where they do not tell or it cannot be read."""
    try:
        table = _read(path)
    except (OSError, ValueError):
        return "dataset"
    return next((kind for kind in MARKS if is_kind(kind, table)), "dataset")


def read_table(path: Path, kinds: tuple[Kind, ...], mistakes: list[str]) -> dict[str, Any] | None:
    """Return the top-level table of a recipe file, or None after a mistake."""
    try:
        return _expect(kinds, _read(path))
    except OSError as error:
        mistakes.append(f"{path}: cannot be read: {error.strerror}")
    except ValueError as error:
        mistakes.append(f"{path}: {error}")
    return None


def _expect(kinds: tuple[Kind, ...], table: dict[str, Any]) -> dict[str, Any]:
    """Return the table unless it is clearly a recipe of another kind."""
    found = [kind for kind in MARKS if is_kind(kind, table)]
    if found and not set(found) & set(kinds):
        raise ValueError(f"is a {found[0]}, expected a {' or a '.join(kinds)}")
    return table


def _read(path: Path) -> dict[str, Any]:
    """Read a file and parse it as TOML; a ValueError says that it is none, or in which line it is wrong."""
    data = read_at_most(path, MOST_BYTES, "a recipe")
    content = utf8_text(data)
    if key := _LONG_KEY.search(content):
        line = content.count("\n", 0, key.start()) + 1
        raise ValueError(f"line {line}: a key has more than {MOST_PARTS} parts")
    try:
        return tomllib.loads(content)
    except (ValueError, RecursionError) as error:
        found = re.search(r" \(at line (\d+), column \d+\)| \(at end of document\)", str(error))
        line = int(found[1]) if found and found[1] else len(data.splitlines())
        text = str(error).replace(found[0], "") if found else str(error)
        text += " (entries are separated by commas)" if text == "Unclosed array" else ""
        raise ValueError(f"line {line}: not valid TOML: {text}") from error


def is_kind(kind: Kind, table: dict[str, Any]) -> bool:
    """Whether a top-level table has a key that only recipes of this kind have."""
    return not MARKS[kind].isdisjoint(table)
