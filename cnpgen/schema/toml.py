"""Reader of recipe files: TOML tables, line numbers of errors, kinds of recipes."""

import re
import tomllib
from pathlib import Path
from typing import Literal

from cnpgen.documents import JsonObject
from cnpgen.schema.texts import read_at_most, utf8_text

Kind = Literal["problem", "pipeline", "dataset", "suite"]

MARKS: dict[Kind, set[str]] = {
    "problem": {
        *("robot", "constraint", "limits", "drive", "object", "objective", "obstacle"),
        *("parameters", "payload", "trajectory"),
    },
    "pipeline": {"stage", "problem"},
    "dataset": {"splits", "pipeline"},
    "suite": {"pucks", "replanning", "samples"},
}
"""Top-level keys that are specific to a kind."""


# Limits of untrusted files, checked before parsing: the time of tomllib is quadratic in
# the parts of a key.
MAX_RECIPE_BYTES = 1 << 18
MAX_KEY_PARTS = 16  # a.b.c has three
_LONG_KEY = re.compile(
    rf"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{MAX_KEY_PARTS}}}""",
    re.ASCII,
)


def kind_of_file(path: Path) -> Kind:
    """Return the kind of a recipe file from its keys.

    "dataset" if it is unknown or the file cannot be read.
    """
    try:
        table = _read(path)
    except (OSError, ValueError):
        return "dataset"
    return next((kind for kind in MARKS if is_kind(kind, table)), "dataset")


def read_table(
    path: Path, kinds: tuple[Kind, ...], errors: list[str]
) -> JsonObject | None:
    """Return the top-level table of a recipe file, or None after an error, such as a recipe of another kind."""
    try:
        table = _read(path)
    except OSError as error:
        errors.append(f"{path}: cannot be read: {error.strerror}")
        return None
    except ValueError as error:
        errors.append(f"{path}: {error}")
        return None
    found = [kind for kind in MARKS if is_kind(kind, table)]
    if not found or set(found) & set(kinds):
        return table
    beside = [path.parent / f"{kind}.toml" for kind in kinds]
    hint = next(
        (
            f" (did you mean {file}?)"
            for file in beside
            if file.is_file() and file != path
        ),
        "",
    )
    errors.append(f"{path}: is a {found[0]}, expected a {' or a '.join(kinds)}{hint}")
    return None


def _read(path: Path) -> JsonObject:
    """Read a file and parse it as TOML; raise ValueError with the line of an error."""
    data = read_at_most(path, MAX_RECIPE_BYTES, "a recipe")
    content = utf8_text(data)
    if key := _LONG_KEY.search(content):
        line = content.count("\n", 0, key.start()) + 1
        raise ValueError(f"line {line}: a key has more than {MAX_KEY_PARTS} parts")
    try:
        return tomllib.loads(content)
    except (ValueError, RecursionError) as error:
        found = re.search(
            r" \(at line (\d+), column \d+\)| \(at end of document\)", str(error)
        )
        # An error at the end of the document is one of its last line.
        line = int(found[1]) if found and found[1] else len(data.splitlines())
        text = str(error).replace(found[0], "") if found else str(error)
        text += " (entries are separated by commas)" if text == "Unclosed array" else ""
        raise ValueError(f"line {line}: not valid TOML: {text}") from error


def is_kind(kind: Kind, table: JsonObject) -> bool:
    """Return whether a top-level table has a key that is specific to a kind."""
    return not MARKS[kind].isdisjoint(table)
