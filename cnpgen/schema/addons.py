"""Add-ons: packages below ``cnpgen/addons`` that register what they contain by entry points, and may be missing."""

import functools
import importlib
import importlib.util
from typing import Any

from cnpgen.errors import MissingAddonError
from cnpgen.schema.entry_points import EntryPoint, entry_points

ADDONS = "cnpgen.addons"


def installed(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, without those of missing add-ons."""
    return tuple(
        entry for entry in entry_points().get(group, ()) if not is_missing(entry)
    )


def find(group: str, name: str) -> EntryPoint | None:
    """Return the entry point of a name, also of a missing add-on.

    None if no package registers the name.
    """
    return next(
        (entry for entry in entry_points().get(group, ()) if entry.name == name), None
    )


def addon_of(module: str) -> str:
    """Return the name of the add-on that a module belongs to.

    Empty for other modules.
    """
    prefix, _, rest = module.partition(f"{ADDONS}.")
    return rest.partition(".")[0] if not prefix else ""


def is_missing(entry: EntryPoint) -> bool:
    """Return whether an entry point belongs to an add-on that this installation lacks, or that needs such a one."""
    return bool(lacking(addon_of(entry.module)))


@functools.cache
def lacking(addon: str) -> str:
    """Return the first add-on that is missing among one and those that it needs; empty if there is none.

    An add-on names those that it needs in ``NEEDS`` of its package.
    """
    if not addon:
        return ""
    # The folder is looked for without importing it.
    if importlib.util.find_spec(f"{ADDONS}.{addon}") is None:
        return addon
    needed = getattr(importlib.import_module(f"{ADDONS}.{addon}"), "NEEDS", ())
    return next(filter(None, map(lacking, needed)), "")


def load_entry(entry: EntryPoint, use: str) -> Any:
    """Import the object of an entry point.

    Args:
        entry: The entry point.
        use: Purpose of the object for the message, such as "the command 'view'".

    Raises:
        MissingAddonError: The add-on of the entry, or one that it needs, is missing.
    """
    if addon := lacking(addon_of(entry.module)):
        raise missing(addon, use)
    return entry.load()


def missing(addon: str, use: str) -> MissingAddonError:
    """Return the error for a missing add-on."""
    return MissingAddonError(
        f"{use} needs the add-on {addon!r}, which this installation lacks: reinstall cnpgen"
    )
