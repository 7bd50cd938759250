"""The page of all keys of recipe files, with their values, defaults and meanings: ``cnpgen docs keys``."""

import re
from collections.abc import Iterator

from cnpgen.addons.manual.describe_keys import (
    GROUPS,
    default_text,
    expected_text,
    first_line,
    is_array,
    part_of,
    recipe_types,
)
from cnpgen.schema import registry
from cnpgen.schema.keys import keys
from cnpgen.schema.units import PLAUSIBLE_MAX

_INTRODUCTION = f"""\
# Keys of recipe files

All keys of recipe files, with their values, defaults and meanings.
`cnpgen show --keys pipeline` prints one part of this page, and `cnpgen show --keys --json` all of it for programs.

A number without a unit is in SI. A string may carry another unit of the same dimension: `"20 ms"`, `"[-170, 170] deg"`,
`"5 %"`. A range is `"[low, high] unit"`; a single number is a range of one point.

Values that are probably in another unit are refused with a suggestion. The largest absolute values are
{", ".join(f"{value:,.4g} {unit}" for unit, value in PLAUSIBLE_MAX.items())}. Keys of small
quantities, such as tolerances, have smaller ones. Limits and sizes are also compared with those of the URDF."""


def key_page() -> str:
    """Describe all keys of all kinds of files, in Markdown."""
    parts = [_INTRODUCTION]
    types = recipe_types()
    for kind in types:
        parts += [
            f"## {kind.capitalize()} files",
            first_line(types[kind]),
            *_sections(types[kind], ""),
        ]
    return "\n\n".join(parts)


def _sections(cls: type, path: str) -> Iterator[str]:
    """Describe the keys of a table, and then those of every table in it that is written in the same file."""
    yield _markdown_table(cls)
    for key in keys(cls):
        part = part_of(key)
        name = f"{path}.{key.name}" if path else key.name
        if part in GROUPS:
            yield f"### `[[{name}]]`"
            yield "The key `use` names the kind; the other keys are those of the kind."
            for use in registry.names(GROUPS[part]):
                kind = registry.load(GROUPS[part], use)
                yield f"#### `{use}`"
                yield first_line(kind)
                yield _markdown_table(kind) if keys(kind) else "It has no keys."
        elif part is not None:
            yield f"### `[[{name}]]`" if is_array(key) else f"### `[{name}]`"
            yield first_line(part)
            yield from _sections(part, name)


def _markdown_table(cls: type) -> str:
    rows = [
        (
            f"`{key.name}`",
            _escaped(expected_text(key)),
            _escaped(default_text(key)),
            _escaped(key.doc),
        )
        for key in keys(cls)
    ]
    lines = [("key", "value", "default", "description"), ("---",) * 4, *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _escaped(text: str) -> str:
    """Return a text as a cell of a Markdown table may have it."""
    return re.sub(r"<(?=\w)", r"\<", text.replace("|", r"\|"))
