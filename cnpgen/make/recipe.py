"""DatasetRecipe: pipeline, seed and rows per split of a dataset, from files or from the specifications of datasets."""

import hashlib
import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import PluginError, RecipeError, UsageError
from cnpgen.pipelines.pipeline import Pipeline, listed_tasks, read_pipeline
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.problems.checks import tables
from cnpgen.problems.problem import Problem, resolved, without_labels
from cnpgen.problems.problem_file import (
    missing_kinds,
    missing_kinds_of_problem,
    names_of_stored_files,
    restoring_reader,
    without_defaults,
)
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import concerning
from cnpgen.schema.catalogue import load_recipe, read_kind, reference
from cnpgen.schema.keys import NAME, RecipeLocation, field
from cnpgen.schema.parsing import Reader, parse, stored_values
from cnpgen.schema.texts import read_own, utf8_text
from cnpgen.schema.toml import is_kind, read_table
from cnpgen.store.dataset_spec import GENERATOR_REVISION, DatasetSpec

SPLIT_NAME = "^[a-z][a-z0-9_]{0,99}$"
MAX_SEED = 2**63 - 1
VERSION = r"^(0|[1-9][0-9]{0,8})\.(0|[1-9][0-9]{0,8})\.(0|[1-9][0-9]{0,8})$"


@dataclass(frozen=True, kw_only=True)
class DatasetRecipe:
    """Pipeline, seed and rows per split of a dataset.

    Attributes:
        splits: Split name -> rows; see ``split_rows`` for scaling to ``n`` rows.
    """

    name: str = field(
        "name of the dataset: lower-case letters, digits and hyphens", pattern=NAME
    )
    version: str = field(
        "version of the dataset, MAJOR.MINOR.PATCH", default="1.0.0", pattern=VERSION
    )
    title: str = field("title in one line", default="")
    pipeline: Pipeline = field(
        "name of a shipped pipeline, or path of a pipeline file relative to this one",
        form="a name or a path",
    )
    seed: int = field("root seed", default=0, low=0, high=MAX_SEED)
    splits: dict[str, int] = field("samples per split", low=1, pattern=SPLIT_NAME)
    license: str = field(
        "license of the samples, an SPDX identifier such as CC-BY-4.0; publishing needs one",
        default="",
    )
    creator: str = field("authors of the dataset, for its card", default="")
    citation: str = field(
        "how to cite the dataset, such as BibTeX, for its card", default=""
    )
    path: Path = Path()


def split_rows(recipe: DatasetRecipe, n: int) -> dict[str, int]:
    """Scale the splits of a recipe to ``n`` rows in total.

    Every split gets its proportional share rounded down. Each remaining row goes to the
    split with the most recipe rows per row after the addition, the first one on a tie.
    This is D'Hondt's rule: no split shrinks when ``n`` grows, so a longer run of a
    recipe extends a shorter one. (Adding the remainder to the first split violates
    this: of 80 + 10 + 10, it would get 9 rows for n = 9 but 8 for n = 10.)

    Args:
        recipe: Recipe to scale.
        n: Number of rows over all splits, at least 1.

    Returns:
        Split name -> rows, in the recipe's order, without empty splits; the recipe's
        own rows if ``n`` is their sum.

    Raises:
        UsageError: ``n`` is less than 1.
    """
    if n < 1:
        raise UsageError(f"must be at least 1, got {n}", argument="n")
    total = sum(recipe.splits.values())
    rows = {name: n * share // total for name, share in recipe.splits.items()}
    for _ in range(n - sum(rows.values())):
        rows[
            max(rows, key=lambda name: Fraction(recipe.splits[name], rows[name] + 1))
        ] += 1
    return {name: count for name, count in rows.items() if count > 0}


def recipe_digest(recipe: Pipeline | DatasetRecipe) -> str:
    """Hash everything that determines the rows of a seed, as 64 hexadecimal digits (sha256).

    The hash covers the resolved pipeline and problem, the code of plug-ins and the
    content of the URDF. It does not cover titles, comments, paths, the seed or the
    splits. Writing "5 mm" for 0.005, or a default explicitly, does not change it.
    Another name, trajectory or objective changes it, although the rows stay the same.
    """
    pipeline = recipe.pipeline if isinstance(recipe, DatasetRecipe) else recipe
    return resolved_digest(resolved(pipeline), pipeline.problem.urdf_text.encode())


def resolved_digest(pipeline: JsonMapping, urdf: bytes) -> str:
    """Hash the result of ``resolved`` for a pipeline, for example from the specification of a dataset, and its URDF.

    See ``recipe_digest``.
    """
    # Titles and file names do not change rows; the text of the URDF does.
    content = {key: value for key, value in pipeline.items() if key != "title"}
    content |= {
        "problem": without_labels(pipeline["problem"]),
        "urdf_sha256": hashlib.sha256(urdf).hexdigest(),
    }
    text = json.dumps(
        content, sort_keys=True, separators=(",", ":"), ensure_ascii=False
    )
    return hashlib.sha256(text.encode()).hexdigest()


@checked_arguments
def load_dataset_recipe(
    name_or_path: str | Path, *, relative_to: Path | None = None
) -> DatasetRecipe:
    """Load a dataset recipe, its pipeline and its problem.

    A pipeline becomes version 1.0.0 of a dataset of its name, with 90 % training and 10
    % validation rows. A pipeline with listed tasks becomes a dataset of training rows
    only.

    Args:
        name_or_path: Name of a shipped dataset or pipeline, or path of such a file.
        relative_to: Base folder of a relative path; by default the working directory.

    Raises:
        RecipeError: One of the three files has errors; the error lists all of them.
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
        raise UsageError(
            f"must be {expected}, got a Pipeline: make cnpgen.recipes.{rows} of it",
            argument="recipe",
        )
    raise UsageError(f"must be {expected}, got {recipe!r}", argument="recipe")


def restore_dataset_recipe(
    content: JsonObject, urdf: str, folder: Path
) -> DatasetRecipe:
    """Rebuild a recipe from its resolved form in a specification.

    Its URDF file must be in ``folder``.
    """
    pipeline_table = content["pipeline"]
    missing = missing_kinds(registry.STAGES, tables(pipeline_table, "stage"))
    missing += missing_kinds_of_problem(pipeline_table["problem"])
    if missing:
        raise PluginError(missing)
    path = folder / "recipe.toml"
    errors = list[str]()
    content = without_defaults(content)
    problem = restoring_reader(urdf, path)

    def pipeline(
        value: Any, where: RecipeLocation, errors: list[str]
    ) -> Pipeline | None:
        readers: dict[type, Reader] = {
            Stage: partial(read_kind, registry.STAGES),
            Problem: problem,
        }
        parsed = parse(Pipeline, value, where=where, errors=errors, readers=readers)
        return parsed and replace(parsed, path=path)

    # Values of a stored recipe may be implausible, since it cannot be edited.
    with stored_values():
        recipe = parse(
            DatasetRecipe,
            content,
            where=RecipeLocation(str(path)),
            errors=errors,
            readers={Pipeline: pipeline},
        )
    if recipe is None or errors:
        raise RecipeError(errors)
    return replace(recipe, path=path)


@contextmanager
def restored(spec: DatasetSpec) -> Iterator[DatasetRecipe]:
    """Rebuild the recipe of a specification.

    Its URDF is in a temporary folder for the duration of the block.
    """
    # Both raise DatasetError for a specification without problem or stages.
    urdf = spec.problem.urdf
    _ = spec.stages
    with (
        tempfile.TemporaryDirectory(prefix="cnpgen-") as folder,
        names_of_stored_files(Path(folder)),
    ):
        yield restore_dataset_recipe(dict(spec.recipe), urdf, Path(folder))


def makes_its_rows(recipe: DatasetRecipe, spec: DatasetSpec) -> bool:
    """Return whether this version of cnpgen and its plug-ins generates the same rows as a specification."""
    return (
        spec.revision == GENERATOR_REVISION
        and recipe_digest(recipe) == spec.recipe_sha256
    )


def _dataset(path: Path, errors: list[str]) -> DatasetRecipe | None:
    table = read_table(path, ("dataset", "pipeline"), errors)
    if table is None:
        return None
    if not is_kind("dataset", table) and is_kind("pipeline", table):
        pipeline = read_pipeline(path, errors)
        return _wrapped(pipeline) if pipeline else None
    readers: dict[type, Reader] = {
        Pipeline: reference("pipeline", read_pipeline, path.parent)
    }
    recipe = parse(
        DatasetRecipe,
        table,
        where=RecipeLocation(str(path)),
        errors=errors,
        readers=readers,
    )
    return recipe and replace(recipe, path=path.absolute())


def _wrapped(pipeline: Pipeline) -> DatasetRecipe:
    """Return the default dataset recipe of a pipeline."""
    return DatasetRecipe(
        name=pipeline.name,
        title=pipeline.title,
        pipeline=pipeline,
        splits={"train": 90, "validation": 10}
        if (tasks := listed_tasks(pipeline)) is None
        else {"train": tasks},
        path=pipeline.path,
    )


def load_notes(recipe: DatasetRecipe) -> str:
    """Read the notes of a recipe, the file of the same name with suffix ``.md``.

    Empty if it does not exist.
    """
    if not recipe.path.name:  # built in Python
        return ""
    card = recipe.path.with_suffix(".md")
    try:
        return (
            utf8_text(
                read_own(card, recipe.path, "notes"),
                hint="; it becomes part of the dataset's card",
            )
            if card.is_file()
            else ""
        )
    except OSError as error:
        raise RecipeError(
            [f"{card}: cannot be read: {error.strerror or error}"]
        ) from error
    except ValueError as error:
        raise RecipeError([f"{card}: {error}"]) from error
