"""Dataset recipes, loaded from files or from the specifications of datasets."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from cnpgen.errors import PluginError, RecipeError, UsageError
from cnpgen.make.recipe import DatasetRecipe, recipe_digest
from cnpgen.pipelines.pipeline import Pipeline, listed_tasks, read_pipeline
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.problems.checks import tables
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import missing_kinds, missing_kinds_of_problem, restoring_reader, without_defaults
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import concerning
from cnpgen.schema.catalogue import load_recipe, read_kind, reference
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import Reader, parse, stored_values
from cnpgen.schema.texts import read_own, utf8_text
from cnpgen.schema.toml import is_kind, read_table
from cnpgen.store.dataset_spec import GENERATOR_REVISION, DatasetSpec


@checked_arguments
def load_dataset_recipe(name_or_path: str | Path, *, relative_to: Path | None = None) -> DatasetRecipe:
    """Load a dataset recipe, its pipeline and its problem.

    A pipeline becomes version 1.0.0 of a dataset of its name, with 90 % training and 10 % validation rows. A pipeline
    with listed tasks becomes a dataset of training rows only.

    Args:
        name_or_path: Name of a shipped dataset or pipeline, or path of such a file.
        relative_to: Base folder of a relative path; by default the working directory.

    Raises:
        RecipeError: One of the three files has mistakes; the error lists all of them.
    """
    return load_recipe(("dataset", "pipeline"), name_or_path, relative_to, _dataset)


def as_dataset_recipe(recipe: object) -> DatasetRecipe:
    """Return a dataset recipe from a recipe, a name or a path."""
    if isinstance(recipe, DatasetRecipe):
        return recipe
    if isinstance(recipe, str | Path):
        with concerning("recipe"):
            return load_dataset_recipe(recipe)
    expected = "the name of a dataset or pipeline, the path of a recipe file or a DatasetRecipe"
    if isinstance(recipe, Pipeline):
        rows = f'DatasetRecipe(name={recipe.name!r}, pipeline=..., splits={{"train": 1000}})'
        raise UsageError(f"must be {expected}, got a Pipeline: make cnpgen.recipes.{rows} of it", argument="recipe")
    raise UsageError(f"must be {expected}, got {recipe!r}", argument="recipe")


def restore_dataset_recipe(content: dict[str, Any], urdf: str, folder: Path) -> DatasetRecipe:
    """Rebuild a recipe from its resolved form in a specification; its URDF file belongs into ``folder``."""
    pipeline_table = content["pipeline"]
    missing = missing_kinds(registry.STAGES, tables(pipeline_table, "stage"))
    missing += missing_kinds_of_problem(pipeline_table["problem"])
    if missing:
        raise PluginError(missing)
    path, mistakes = folder / "recipe.toml", list[str]()
    content, problem = without_defaults(content), restoring_reader(urdf, path)

    def pipeline(value: Any, where: RecipeLocation, mistakes: list[str]) -> Pipeline | None:
        readers: dict[type, Reader] = {Stage: partial(read_kind, registry.STAGES), Problem: problem}
        parsed = parse(Pipeline, value, where=where, mistakes=mistakes, readers=readers)
        return parsed and replace(parsed, path=path)

    with stored_values():
        recipe = parse(
            DatasetRecipe, content, where=RecipeLocation(str(path)), mistakes=mistakes, readers={Pipeline: pipeline}
        )
    if recipe is None or mistakes:
        raise RecipeError(mistakes)
    return replace(recipe, path=path)


@contextmanager
def restored(spec: DatasetSpec) -> Iterator[DatasetRecipe]:
    """Rebuild the recipe of a specification; its URDF is in a temporary folder for the duration of the block."""
    urdf, _ = spec.problem.urdf, spec.stages
    with tempfile.TemporaryDirectory(prefix="cnpgen-") as folder:
        yield restore_dataset_recipe(dict(spec.recipe), urdf, Path(folder))


def makes_its_rows(recipe: DatasetRecipe, spec: DatasetSpec) -> bool:
    """Return whether this version of cnpgen and its plug-ins generates the same rows as a specification."""
    return spec.revision == GENERATOR_REVISION and recipe_digest(recipe) == spec.recipe_sha256


def _dataset(path: Path, mistakes: list[str]) -> DatasetRecipe | None:
    table = read_table(path, ("dataset", "pipeline"), mistakes)
    if table is None:
        return None
    if not is_kind("dataset", table) and is_kind("pipeline", table):
        pipeline = read_pipeline(path, mistakes)
        return _wrapped(pipeline) if pipeline else None
    readers: dict[type, Reader] = {Pipeline: reference("pipeline", read_pipeline, path.parent)}
    recipe = parse(DatasetRecipe, table, where=RecipeLocation(str(path)), mistakes=mistakes, readers=readers)
    return recipe and replace(recipe, path=path.absolute())


def _wrapped(pipeline: Pipeline) -> DatasetRecipe:
    """Return the default dataset recipe of a pipeline."""
    return DatasetRecipe(
        name=pipeline.name,
        title=pipeline.title,
        pipeline=pipeline,
        splits={"train": 90, "validation": 10} if (tasks := listed_tasks(pipeline)) is None else {"train": tasks},
        path=pipeline.path,
    )


def load_notes(recipe: DatasetRecipe) -> str:
    """Read the notes of a recipe, the file of the same name with suffix ``.md``; empty if it does not exist."""
    if not recipe.path.name:  # built in Python
        return ""
    card = recipe.path.with_suffix(".md")
    try:
        hint = "; it becomes part of the dataset's card"
        return utf8_text(read_own(card, recipe.path, "notes"), hint=hint) if card.is_file() else ""
    except OSError as error:
        raise RecipeError([f"{card}: cannot be read: {error.strerror or error}"]) from error
    except ValueError as error:
        raise RecipeError([f"{card}: {error}"]) from error
