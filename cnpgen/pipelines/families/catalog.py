"""The families by name, and their parameters from texts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cnpgen.errors import UsageError, nearest
from cnpgen.pipelines.families.containers import Cage, Dresser, OpenBox
from cnpgen.pipelines.families.family import SceneFamily
from cnpgen.pipelines.families.free_mix import FreeMix
from cnpgen.pipelines.families.shelves import BookshelfSmall, BookshelfTall, BookshelfThin, Cubby, MergedCubby
from cnpgen.pipelines.families.tables import TablePick, Tabletop, TableUnderPick
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import parse

FAMILIES: dict[str, type[SceneFamily]] = {
    "tabletop": Tabletop,
    "cubby": Cubby,
    "merged-cubby": MergedCubby,
    "dresser": Dresser,
    "bookshelf-small": BookshelfSmall,
    "bookshelf-tall": BookshelfTall,
    "bookshelf-thin": BookshelfThin,
    "cage": Cage,
    "box": OpenBox,
    "table-pick": TablePick,
    "table-under-pick": TableUnderPick,
    "free": FreeMix,
}


@checked_arguments
def load_family(name: str, parameters: Mapping[str, Any] | None = None) -> SceneFamily:
    """Return a family by its name.

    Args:
        name: Its name in ``FAMILIES``.
        parameters: Values of its fields, as in recipes: ``{"tables": [1, 2], "height": "[0, 30] cm"}``.

    Raises:
        UsageError: The family or a parameter is unknown, or a value is invalid.
    """
    if name not in FAMILIES:
        text = f"unknown family {name!r}{nearest(name, FAMILIES)}, expected one of {', '.join(FAMILIES)}"
        raise UsageError(text, concerns="name")
    mistakes: list[str] = []
    family = parse(FAMILIES[name], dict(parameters or {}), where=RecipeLocation(name), mistakes=mistakes)
    if family is None or mistakes:
        raise UsageError("; ".join(mistakes), concerns="parameters")
    assert isinstance(family, SceneFamily)
    return family
