"""The families by name, and their parameters from texts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cnpgen.errors import RecipeError, UsageError, nearest
from cnpgen.pipelines.families.family import SceneFamily
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import parse

FAMILIES: dict[str, type[SceneFamily]] = {
    name: registry.load(registry.FAMILIES, name) for name in registry.BUILT_IN[registry.FAMILIES]
}


@checked_arguments
def load_family(name: str, parameters: Mapping[str, Any] | None = None) -> SceneFamily:
    """Return a family by its name.

    Args:
        name: Its name in ``FAMILIES``, or that of an installed package.
        parameters: Values of its fields, as in recipes: ``{"tables": [1, 2], "height": "[0, 30] cm"}``.

    Raises:
        UsageError: The family or a parameter is unknown, or a value is invalid.
    """
    known = registry.names(registry.FAMILIES)
    if name not in known:
        text = f"unknown family {name!r}{nearest(name, known)}, expected one of {', '.join(known)}"
        raise UsageError(text, concerns="name")
    mistakes: list[str] = []
    try:
        kind = registry.load(registry.FAMILIES, name)
    except RecipeError as error:
        raise UsageError(str(error), concerns="family") from error
    family = parse(kind, dict(parameters or {}), where=RecipeLocation(name), mistakes=mistakes)
    if family is None or mistakes:
        raise UsageError("; ".join(mistakes), concerns="parameters")
    assert isinstance(family, SceneFamily)
    return family
