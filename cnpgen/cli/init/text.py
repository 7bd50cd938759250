"""Recipes as TOML in which every key is explained: those that are left out, too, as comments."""

import json
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from cnpgen.cli.describe_keys import GROUPS, is_array, kind_summary, part_of
from cnpgen.schema import registry
from cnpgen.schema.keys import Key, PerJoint, Range, keys

RECIPE_LINE_WIDTH = 118
NOTHING = "..."  # for people to fill in


def recipe_text(recipe: Any, values: Mapping[str, Any], notes: Mapping[str, str]) -> str:
    """Write a problem, pipeline or dataset.

    Args:
        recipe: The recipe.
        values: Key -> what to write in the place of what the recipe has: "robot.urdf" -> a path.
        notes: Key -> what to say of it besides.
    """
    return "\n".join(_Writer(values, notes).table(type(recipe), recipe, "")) + "\n"


@dataclass(frozen=True)
class _Writer:
    """Writes tables, with values and notes as ``recipe_text`` has them; what is left out has ``# `` before it."""

    values: Mapping[str, Any]
    notes: Mapping[str, str]

    def table(self, cls: type, table: Any, path: str) -> Iterator[str]:
        """Write the keys of a table, those that hold tables last; without a table, all as left out."""
        below = list[str]()
        for key in keys(cls):
            name = f"{path}.{key.name}" if path else key.name
            part, value = part_of(key), getattr(table, key.name, None)
            if part is None:
                yield from self.key(key, table, name)
            elif is_array(key):
                for at, item in enumerate(value or (None,)):
                    below += ["", *self.entry(part, item, f"{name}.{at}")]
            else:
                below += ["", *_comment(kind_summary(part)), _unless(value, f"[{name}]")]
                below += self.table(part, value, name)
        yield from below

    def entry(self, cls: type, item: Any, path: str) -> Iterator[str]:
        """Write one of several tables of the same name; without one, how it would be written."""
        kind = cls if item is None else type(item)
        yield from _comment(kind_summary(kind))
        yield _unless(item, f"[[{path.rpartition('.')[0]}]]")
        if cls in GROUPS:
            names = registry.names(GROUPS[cls])
            yield f'# use = "{names[0]}"' if item is None else f'use = "{registry.name_of(GROUPS[cls], kind)}"'
        yield from self.table(kind, item, path)

    def key(self, key: Key, table: Any, name: str) -> Iterator[str]:
        """Write a key below what it means; as left out where it is at its default, or of a table that is left out."""
        value = self.values.get(name, getattr(table, key.name, None if key.required else key.default))
        given = table is not None and (key.required or value != key.default)
        note = f". {self.notes[name]}" if name in self.notes else ""
        yield from _comment(f"{key.doc}{note}" if given else f"{key.doc} ({key.expected}){note}")
        yield _unless(given, f"{key.name} = {toml(value) or NOTHING}")


def _unless(given: Any, line: str) -> str:
    """Return a line, as left out unless something is given."""
    return line if given else f"# {line}"


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, RECIPE_LINE_WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False)


def toml(value: Any) -> str:
    """Write a value as TOML; nothing where there is none."""
    if isinstance(value, Range):
        return toml((value.low, value.high))
    if isinstance(value, PerJoint):
        return toml(value.values if len(value.values) > 1 else value.values[0])
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml, value))}]" if value else ""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{name} = {entry}' for name, entry in value.items())} }}"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False) if value else ""
    return repr(value) if isinstance(value, int | float) else ""
