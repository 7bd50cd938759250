"""Suites: fixed, versioned sets of boundary problems for the comparison of planners, read from recipes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cnpgen.addons.benchmark.benchmark_planner import PLANNERS, load_kind
from cnpgen.addons.benchmark.pucks import (
    ExecutedPrefix,
    Pucks,
    ReplanningScenario,
    hits_of,
    scenario_problems,
)
from cnpgen.addons.scene_files.scene_files import load_scenes
from cnpgen.documents import JsonObject, NamedErrors
from cnpgen.errors import CnpgenError, nearest
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.stages.draw import MAX_TASKS
from cnpgen.plans.plans import Plans
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem, read_problem
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.schema.catalogue import list_recipes, load_recipe, reference
from cnpgen.schema.keys import NAME, RecipeLocation, field
from cnpgen.schema.parsing import Reader, parse
from cnpgen.schema.toml import is_kind, read_table
from cnpgen.schema.units import show

DEFAULT_SAMPLES = 100

PlannerFields = dict[str, JsonObject]
"""Planner -> its field -> value, as in a recipe."""


@dataclass(frozen=True, kw_only=True)
class SampledProblems:
    """New samples of a dataset's recipe; none is in the dataset."""

    recipe: str = field("name or path of a dataset or a pipeline")
    n: int = field("number of problems", default=DEFAULT_SAMPLES, low=1, high=MAX_TASKS)
    seed: int = field("root seed of the problems", default=987_654_321, low=0)


@dataclass(frozen=True, kw_only=True)
class SceneFileProblems:
    """Planning problems of a scene file, from rest to rest."""

    file: str = field("scene file, relative to the suite")
    robot: str = field("name or path of the robot's problem")


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Boundary problems for the comparison of planners: pucks on a grid, or samples of a dataset."""

    name: str = field(
        "name of the suite: lower-case letters, digits and hyphens", pattern=NAME
    )
    version: str = field(
        "semantic version; other problems need another version",
        pattern=r"^\d+\.\d+\.\d+$",
    )
    title: str = field("title in one line", default="")
    model: str = field("shipped model for these problems", default="")
    pucks: Pucks | None = field("grid of pucks to hit from rest", default=None)
    replanning: ReplanningScenario | None = field(
        "replanning scenarios: pucks to hit from moving states", default=None
    )
    samples: SampledProblems | None = field(
        "random problems of a dataset", default=None
    )
    scenes: SceneFileProblems | None = field(
        "problems of a scene file", default=None, since_version=2
    )
    planners: PlannerFields | None = field(
        "fields of planners, in a table per planner",
        default=None,
        form="a table of tables",
        since_version=2,
    )

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        if (
            sum(
                part is not None
                for part in (self.pucks, self.replanning, self.samples, self.scenes)
            )
            != 1
        ):
            yield (
                "pucks",
                "expected exactly one of [pucks], [replanning], [samples] and [scenes]",
            )

    @checked_arguments
    def problems(self, n: int | None = None) -> tuple[Plans, ExecutedPrefix | None]:
        """Return the boundary problems, as plans without motions.

        Args:
            n: Number of problems, the first ones; random suites may have more than the
                recipe.

        Returns:
            The problems and, of replanning scenarios, the prefixes of the first
            motions.

        Raises:
            RecipeError: A recipe has errors.
            UsageError: ``n`` is not positive.
        """
        n = None if n is None else integer("n", n, least=1)
        if self.samples is not None:
            return draw_boundary_problems(
                self.samples.recipe, n or self.samples.n, seed=self.samples.seed
            ), None
        if self.scenes is not None:
            return scene_plans(
                load_problem(self.scenes.robot), load_scenes(self.scenes.file)
            )[:n], None
        if self.replanning is not None:
            problems, prefix = scenario_problems(self.replanning)
            return problems[:n], prefix
        assert self.pucks is not None
        return hits_of(self.pucks)[:n], None


@checked_arguments
def load_suite(name_or_path: str | Path) -> Suite:
    """Load a suite; a dataset or a pipeline becomes a suite of its samples.

    Args:
        name_or_path: Name of a shipped suite, dataset or pipeline, or path of such a
            file.

    Raises:
        RecipeError: With every error in the file.
    """
    return load_recipe(("suite", "dataset", "pipeline"), name_or_path, None, _read)


def _beside(folder: Path, name: str) -> str:
    """Return the path of a recipe beside the suite, from any working directory.

    The name if there is none.
    """
    return str(folder / name) if (folder / name).is_file() else name


def _read_planners(
    tables: Any, where: RecipeLocation, errors: list[str]
) -> PlannerFields | None:
    """Return the fields of planners after checking them."""
    before = len(errors)
    known = registry.names(PLANNERS)
    if not isinstance(tables, dict):
        errors.append(
            where.message(f"expected a table per planner, got {show(tables)}")
        )
        return None
    for name, fields in tables.items():
        if name not in known:
            hint = nearest(name, known) or f"; known: {', '.join(known)}"
            errors.append((where / name).message(f"unknown planner{hint}"))
            continue
        try:
            planner = load_kind(name)
        except CnpgenError as error:
            errors.append((where / name).message(str(error)))
            continue
        parse(planner, fields, where=where / name, errors=errors)
    return tables if len(errors) == before else None


def _read(path: Path, errors: list[str]) -> Suite | None:
    table = read_table(path, ("suite", "dataset", "pipeline"), errors)
    if table is None:
        return None
    if is_kind("dataset", table) or is_kind("pipeline", table):
        recipe = load_dataset_recipe(path)
        return Suite(
            name=recipe.name,
            version=recipe.version,
            title=f"samples of {recipe.name}",
            model=recipe.name if recipe.name in list_recipes("dataset") else "",
            samples=SampledProblems(recipe=str(path)),
        )
    readers: dict[Any, Reader] = {
        Problem: reference("problem", read_problem, path.parent),
        PlannerFields: _read_planners,
    }
    suite = parse(
        Suite, table, where=RecipeLocation(str(path)), errors=errors, readers=readers
    )
    if suite is not None and suite.scenes is not None:
        file = str(path.parent / suite.scenes.file)
        robot = _beside(path.parent, suite.scenes.robot)
        return replace(suite, scenes=SceneFileProblems(file=file, robot=robot))
    if suite is not None and suite.samples is not None:
        return replace(
            suite,
            samples=replace(
                suite.samples, recipe=_beside(path.parent, suite.samples.recipe)
            ),
        )
    return suite
