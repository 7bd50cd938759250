"""The keys of recipe files: those of one kind of stage or constraint, or all of them."""

import dataclasses
from collections.abc import Sequence
from typing import get_args

from cnpgen.addons.manual.describe import quantity, title_lines
from cnpgen.cli.terminal import table
from cnpgen.documents import JsonObject
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.objectives import ObjectiveTerm
from cnpgen.problems.problem import Problem
from cnpgen.schema import addons, registry
from cnpgen.schema.keys import Key, Range, keys
from cnpgen.schema.toml import Kind

_CORE_FILES: dict[str, type] = {
    "problem": Problem,
    "pipeline": Pipeline,
    "dataset": DatasetRecipe,
}

GROUPS = {
    Stage: registry.STAGES,
    Constraint: registry.CONSTRAINTS,
    ObjectiveTerm: registry.OBJECTIVES,
}
"""Tables with a key ``use`` that names their kind -> registry of the kinds."""


def recipe_types() -> dict[str, type]:
    """Return kind of a file -> type of its recipe, also of add-ons."""
    others = addons.installed(registry.RECIPES)
    return _CORE_FILES | {
        entry.name: addons.load_entry(entry, f"a {entry.name} file") for entry in others
    }


def kind_summary(kind: type) -> str:
    """Return the first line of a kind's documentation, without markup."""
    return first_line(kind).replace("`", "")


def first_line(kind: type) -> str:
    """Return the first line of a kind's documentation, in Markdown."""
    return (kind.__doc__ or "").strip().partition("\n")[0].replace("``", "`")


def describe_kind(group: str, name: str) -> str:
    """Describe a kind of stage, constraint or objective term: its purpose, and the keys of its table."""
    kind = registry.load(group, name)
    head = ("key", "default", "description (value)")
    rows = [
        (key.name, default_text(key), f"{key.doc} ({expected_text(key)})")
        for key in keys(kind)
    ]
    text = table([head, *rows], indent="  ") if rows else ["  it has no keys"]
    return "\n".join(
        [
            f"{registry.noun_of(group)} {name}",
            *title_lines(kind_summary(kind)),
            "",
            *text,
        ]
    )


def kind_to_dict(group: str, name: str) -> JsonObject:
    """Describe a kind of stage or constraint for JSON."""
    return {
        "kind": registry.noun_of(group),
        "name": name,
        **_table_to_dict(registry.load(group, name)),
    }


def keys_to_dict(kinds: Sequence[Kind]) -> JsonObject:
    """Describe all keys of files of some kinds for JSON.

    Of a table of tables each has its own keys.
    """
    types = recipe_types()
    return {kind: _table_to_dict(types[kind]) for kind in kinds}


def part_of(key: Key) -> type | None:
    """Return the table, or one of the tables, that a key holds in the same file.

    None where it holds a value.
    """
    # The entries of a list have the type of its first argument.
    found: type = get_args(key.hint)[0] if is_array(key) else key.hint
    if found in GROUPS:
        return found
    return (
        found
        if dataclasses.is_dataclass(found)
        and keys(found)
        and found not in _CORE_FILES.values()
        else None
    )


def is_array(key: Key) -> bool:
    """Return whether a key holds a list of tables."""
    args = get_args(key.hint)
    return bool(args) and dataclasses.is_dataclass(args[0]) and args[0] is not Range


def default_text(key: Key) -> str:
    """Describe the default of a key: ``"20 ms"``, or "required"."""
    if key.required:
        return "required"
    # A table that may be left out has the defaults of its own keys.
    if part_of(key) and key.default not in (None, ()):
        return "those of its keys"
    return quantity(key.default, key.unit)


def expected_text(key: Key) -> str:
    """Describe the accepted values: ``"a length [m], at least 0"``."""
    bounds = {"at least": key.low, "at most": key.high}
    given = ((which, bound) for which, bound in bounds.items() if bound is not None)
    limits = [
        f"{which} {bound}" if isinstance(bound, int) else f"{which} {bound:g}"
        for which, bound in given
    ]
    return ", ".join([key.expected, *limits])


def _table_to_dict(cls: type) -> JsonObject:
    return {
        "summary": kind_summary(cls),
        "keys": [_key_to_dict(key) for key in keys(cls)],
    }


def _key_to_dict(key: Key) -> JsonObject:
    """Describe a key, and the table or the tables that it holds."""
    left_out = ("hint", "default", "since_version")
    part = part_of(key)
    # Types are no JSON; the default follows in the form of the file.
    content = {
        spec.name: getattr(key, spec.name)
        for spec in dataclasses.fields(key)
        if spec.name not in left_out
    }
    content |= {"expected": key.expected, "required": key.required}
    if part in GROUPS:
        group = GROUPS[part]
        return content | {
            "kinds": [kind_to_dict(group, use) for use in registry.names(group)]
        }
    if part is not None:
        return content | {"table": _table_to_dict(part)}
    if key.required:
        return content
    return content | {
        "default": [key.default.low, key.default.high]
        if isinstance(key.default, Range)
        else key.default
    }
