"""Suites: fixed, versioned sets of boundary problems that planners are compared on, read from recipes."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from cnpgen.benchmark.pucks import Pucks, hits_of
from cnpgen.benchmark.replanning_scenario import Lead, Turns, turns_of
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.recipe_file import load_dataset_recipe
from cnpgen.pipelines.stages.given_positions import MAX_TASKS
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import read_problem
from cnpgen.schema.catalogue import list_recipes, load_recipe, reference
from cnpgen.schema.keys import NAME, RecipeLocation, field
from cnpgen.schema.parsing import Reader, parse
from cnpgen.schema.toml import is_kind, read_table

RANDOM = 100  # problems of a dataset, where nothing else is said


@dataclass(frozen=True, kw_only=True)
class Draws:
    """Fresh draws of a dataset's recipe: none of its rows is among them."""

    recipe: str = field("name or path of a dataset or a pipeline")
    n: int = field("number of problems", default=RANDOM, low=1, high=MAX_TASKS)
    seed: int = field("root seed of the problems", default=987_654_321, low=0)


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Boundary problems to compare planners on: pucks on a grid, or draws of a dataset."""

    name: str = field("name of the suite: lower-case letters, digits and hyphens", pattern=NAME)
    version: str = field("semantic version; other problems need another version", pattern=r"^\d+\.\d+\.\d+$")
    title: str = field("title in one line", default="")
    model: str = field("shipped model for these problems", default="")
    pucks: Pucks | None = field("grid of pucks to hit from rest", default=None)
    turns: Turns | None = field("pucks to hit by online replanning", default=None)
    draws: Draws | None = field("random problems of a dataset", default=None)

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        if sum(part is not None for part in (self.pucks, self.turns, self.draws)) != 1:
            yield "pucks", "expected exactly one of [pucks], [turns] and [draws]"

    def problems(self, n: int | None = None) -> tuple[Plans, Lead | None]:
        """Return the boundary problems, as plans that are still to be made.

        Args:
            n: The first so many; of draws it may be more than the recipe says.

        Returns:
            The problems and, of turns, the first motions that lead to them.

        Raises:
            RecipeError: A recipe that it names has mistakes.
            UsageError: ``n`` is no positive number.
        """
        if self.draws is not None:
            return draw_boundary_problems(self.draws.recipe, n or self.draws.n, seed=self.draws.seed), None
        if self.turns is not None:
            found, lead = turns_of(self.turns)
            return found[:n], lead
        assert self.pucks is not None
        return hits_of(self.pucks)[:n], None


def load_suite(name_or_path: str | Path) -> Suite:
    """Load a suite; a dataset or a pipeline becomes one of random draws of it.

    Args:
        name_or_path: Name of a shipped suite, dataset or pipeline, or path of such a file.

    Raises:
        RecipeError: With every mistake in the file.
    """
    return load_recipe(("suite", "dataset", "pipeline"), name_or_path, None, _read)


def list_suites() -> dict[str, Path]:
    """List the shipped suites: name -> file."""
    return list_recipes("suite")


def _read(path: Path, mistakes: list[str]) -> Suite | None:
    table = read_table(path, ("suite", "dataset", "pipeline"), mistakes)
    if table is None:
        return None
    if not is_kind("suite", table):
        recipe = load_dataset_recipe(path)
        return Suite(
            name=recipe.name,
            version=recipe.version,
            title=f"random draws of {recipe.name}",
            model=recipe.name if recipe.name in list_recipes("dataset") else "",
            draws=Draws(recipe=str(path)),
        )
    readers: dict[type, Reader] = {Problem: reference("problem", read_problem, path.parent)}
    suite = parse(Suite, table, where=RecipeLocation(str(path)), mistakes=mistakes, readers=readers)
    if suite is None or suite.draws is None:
        return suite
    beside = path.parent / suite.draws.recipe
    return replace(suite, draws=replace(suite.draws, recipe=str(beside))) if beside.is_file() else suite
