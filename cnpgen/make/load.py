"""Dataset recipes from files, by name or path, and from the blueprints of datasets."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from cnpgen.errors import PluginError, RecipeError, UsageError
from cnpgen.make.recipe import DatasetRecipe, recipe_digest
from cnpgen.pipelines.load import read_pipeline
from cnpgen.pipelines.pipeline import Pipeline, listed_tasks
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.problems.checks import tables
from cnpgen.problems.load import missing_kinds, restoring_reader, without_defaults
from cnpgen.problems.problem import Problem
from cnpgen.schema import registry
from cnpgen.schema.catalogue import load_recipe, read_kind, reference
from cnpgen.schema.keys import Place
from cnpgen.schema.parsing import Reader, parse
from cnpgen.schema.texts import read_own, utf8_text
from cnpgen.schema.toml import is_kind, read_table
from cnpgen.store.blueprint import REVISION, Blueprint


def load_dataset_recipe(name_or_path: str | Path, *, relative_to: Path | None = None) -> DatasetRecipe:
    """Load a dataset recipe, its pipeline and its problem.

    A pipeline can be given as well: it becomes version 1.0.0 of a dataset of its name, 90 % training, 10 % validation;
    one that lists its tasks becomes one of training rows.

    Args:
        name_or_path: Name of a shipped dataset or pipeline, or path of such a file.
        relative_to: Folder that a path is relative to; by default the working directory.

    Raises:
        RecipeError: With every mistake in all three files.
    """
    return load_recipe(("dataset", "pipeline"), name_or_path, relative_to, _dataset)


def as_dataset_recipe(recipe: object) -> DatasetRecipe:
    """Return the dataset recipe that is meant: itself, or what its name or file says.

    Raises:
        UsageError: It is nothing of the kind.
        RecipeError: With every mistake in the files.
    """
    if isinstance(recipe, DatasetRecipe):
        return recipe
    if isinstance(recipe, str | Path):
        return load_dataset_recipe(recipe)
    expected = "the name of a dataset or pipeline, the path of a recipe file or a DatasetRecipe"
    if isinstance(recipe, Pipeline):
        rows = f'DatasetRecipe(name={recipe.name!r}, pipeline=..., splits={{"train": 1000}})'
        raise UsageError(f"recipe must be {expected}, got a Pipeline: make cnpgen.{rows} of it")
    raise UsageError(f"recipe must be {expected}, got {recipe!r}")


def restore_dataset_recipe(content: dict[str, Any], urdf: str, folder: Path) -> DatasetRecipe:
    """Rebuild a recipe from what ``resolved`` made of it, as blueprints of datasets keep it.

    Args:
        content: The resolved recipe.
        urdf: Text of the robot's URDF file.
        folder: Where the URDF file is written to.

    Raises:
        RecipeError: The content does not fit this version of cnpgen.
        PluginError: A package that it needs is not installed.
    """
    pipeline_table = content["pipeline"]
    missing = missing_kinds(registry.STAGES, tables(pipeline_table, "stage"))
    missing += missing_kinds(registry.CONSTRAINTS, tables(pipeline_table["problem"], "constraint"))
    if missing:
        raise PluginError(missing)
    path, mistakes = folder / "recipe.toml", list[str]()
    content, problem = without_defaults(content), restoring_reader(urdf, path)

    def pipeline(value: Any, where: Place, mistakes: list[str]) -> Pipeline | None:
        readers: dict[type, Reader] = {Stage: partial(read_kind, registry.STAGES), Problem: problem}
        made = parse(Pipeline, value, where=where, mistakes=mistakes, readers=readers)
        return made and replace(made, path=path)

    made = parse(DatasetRecipe, content, where=Place(str(path)), mistakes=mistakes, readers={Pipeline: pipeline})
    if made is None or mistakes:
        raise RecipeError(mistakes)
    return replace(made, path=path)


@contextmanager
def restored(blueprint: Blueprint) -> Iterator[DatasetRecipe]:
    """Rebuild the recipe from a blueprint, its URDF in a temporary folder that is gone when the block ends.

    Raises:
        RecipeError: It does not fit this version of cnpgen.
        PluginError: It needs packages that are not installed.
        DatasetError: There is no recipe in it.
    """
    urdf, _ = blueprint.problem.urdf, blueprint.stages
    with tempfile.TemporaryDirectory(prefix="cnpgen-") as folder:
        yield restore_dataset_recipe(dict(blueprint.recipe), urdf, Path(folder))


def makes_its_rows(recipe: DatasetRecipe, blueprint: Blueprint) -> bool:
    """Whether this version of cnpgen and its plug-ins makes the rows of a blueprint, of which the recipe is."""
    return blueprint.revision == REVISION and recipe_digest(recipe) == blueprint.recipe_sha256


def _dataset(path: Path, mistakes: list[str]) -> DatasetRecipe | None:
    table = read_table(path, ("dataset", "pipeline"), mistakes)
    if table is None:
        return None
    if not is_kind("dataset", table) and is_kind("pipeline", table):
        pipeline = read_pipeline(path, mistakes)
        return _wrapped(pipeline) if pipeline else None
    readers: dict[type, Reader] = {Pipeline: reference("pipeline", read_pipeline, path.parent)}
    made = parse(DatasetRecipe, table, where=Place(str(path)), mistakes=mistakes, readers=readers)
    return made and replace(made, path=path.absolute())


def _wrapped(pipeline: Pipeline) -> DatasetRecipe:
    """Make a dataset of a pipeline alone."""
    return DatasetRecipe(
        name=pipeline.name,
        title=pipeline.title,
        pipeline=pipeline,
        splits={"train": 90, "validation": 10} if (tasks := listed_tasks(pipeline)) is None else {"train": tasks},
        path=pipeline.path,
    )


def load_notes(recipe: DatasetRecipe) -> str:
    """Read the text beside a recipe's file, of the same name with the ending ``.md``; empty where there is none.

    Raises:
        RecipeError: It cannot be read, is a link to another folder, too large or not UTF-8.
    """
    if not recipe.path.name:  # built in Python, from no file
        return ""
    card = recipe.path.with_suffix(".md")
    try:
        advice = "; it becomes part of the dataset's card"
        return utf8_text(read_own(card, recipe.path, "notes"), advice=advice) if card.is_file() else ""
    except OSError as error:
        raise RecipeError([f"{card}: cannot be read: {error.strerror or error}"]) from error
    except ValueError as error:
        raise RecipeError([f"{card}: {error}"]) from error
