"""Names of the version before: they still work, and each use gives a warning."""

from collections.abc import Iterator
from dataclasses import dataclass

import pytest

import cnpgen
from cnpgen.errors import RecipeError
from cnpgen.schema.keys import RecipeLocation, field
from cnpgen.schema.parsing import parse


@dataclass(frozen=True)
class Part:
    """A table of a plug-in that was written for the version before."""

    size: float = field("size")

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        if self.size > 1:
            yield "size", "too large"


def test_the_check_of_an_older_plug_in_is_called_with_a_warning() -> None:
    errors: list[str] = []
    with pytest.warns(DeprecationWarning, match="name the method validate"):
        parse(Part, {"size": 2.0}, where=RecipeLocation("file"), errors=errors)
    assert errors == ["file: size: too large"]


def test_attributes_have_their_former_names_with_a_warning() -> None:
    model = cnpgen.RobotModel("airhockey", backend="numpy")
    with pytest.warns(DeprecationWarning, match="base is home"):
        assert model.base is model.home  # type: ignore[attr-defined]
    with pytest.warns(DeprecationWarning, match="mistakes is errors"):
        assert RecipeError(["an error"]).mistakes == ("an error",)
