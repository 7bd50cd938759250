"""Arguments that name a recipe or a path.

One that does not exist or is of another kind is refused.
"""

import os
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.errors import DatasetError, UsageError, either

if TYPE_CHECKING:
    from cnpgen.plans import Plans
    from cnpgen.schema.toml import Kind

_TEXTS = {".toml", ".yaml", ".yml"}  # suffixes of recipes, and of scenes
DATASET = "'cnpgen inspect {0}' describes it, 'cnpgen validate {0}' checks it"
_HINTS = {  # what a file is -> what to do with it
    "a file of plans": "'cnpgen evaluate {0}' judges them",
    "a shard of a dataset": "'cnpgen inspect' describes the dataset, by its folder",
    "a model of cnpgen": "'cnpgen plan --model {0}' plans with it",
    "an HDF5 file": "'cnpgen inspect' describes the folder of a dataset, 'cnpgen evaluate' judges a file of plans",
}


def check_recipe(recipe: str, *, of_dataset: str = DATASET) -> None:
    """Refuse the folder of a dataset, tables and HDF5 files, before they are looked for, or read, as recipes.

    ``of_dataset`` is the hint for a dataset, in whose folder "{0}" stands.
    """
    from cnpgen.store.files.atomic import check_readable
    from cnpgen.store.paths import file_kind
    from cnpgen.store.workspace import is_dataset

    path = Path(recipe)
    check_readable(path)
    if path.is_dir():
        # The name of a shipped recipe counts, also if a folder has the same name.
        if recipe not in _shipped() and is_dataset(path):
            raise UsageError(
                f"{recipe} is the folder of a dataset, expected a recipe: {of_dataset.format(recipe)}"
            )
        return
    if path.suffix.lower() == ".csv" and path.is_file():
        hint = f"'cnpgen complete NAME {recipe} -o problems.h5' makes problems of tasks, which 'cnpgen solve' takes"
        raise UsageError(f"{recipe} is a table, expected a recipe: {hint}")
    if kind := file_kind(path):
        what = (
            kind
            if kind in {"an HDF5 file", "a journal of cnpgen"}
            else f"an HDF5 file, {kind}"
        )
        hint = _HINTS.get(
            kind, "'cnpgen list' names the recipes that there are"
        ).format(recipe)
        raise UsageError(f"{recipe} is {what}, expected a recipe: {hint}")


def is_recipe(what: str) -> bool:
    """Return whether an argument is a recipe file, or the name of a shipped dataset or pipeline and no path."""
    path = Path(what)
    return path.suffix == ".toml" or (
        not path.exists() and what in _shipped("dataset", "pipeline")
    )


def _shipped(*kinds: str) -> list[str]:
    """Return the names of shipped recipes in order, so that suggestions do not depend on the process."""
    from cnpgen.schema.catalogue import list_recipes
    from cnpgen.schema.toml import MARKS

    return sorted(
        {
            name
            for kind in MARKS
            if not kinds or kind in kinds
            for name in list_recipes(kind)
        }
    )


# Types of arguments, which argparse reads before it reports missing options.


def _recipe_or_path(kinds: tuple[str, ...], text: str) -> str:
    """Read a path, or the name of a recipe of one of several kinds."""
    from cnpgen.loader.remote import local_folder
    from cnpgen.store.files.atomic import check_readable
    from cnpgen.store.files.kind import kind_of_content
    from cnpgen.store.paths import similar_path

    text = str(local_folder(text))
    names = _shipped(*kinds)
    path = Path(text)
    check_readable(path)
    if (
        path.suffix.lower() not in _TEXTS
        and path.is_file()
        and kind_of_content(path) == "a text file"
    ):
        # Has a hint for tables.
        check_recipe(text)
        raise UsageError(
            f"{text} is a text file, expected a recipe (.toml) or an HDF5 file"
        )
    if path.exists() or text in names:
        return text
    hint = similar_path(path, names)
    if path.suffix:
        raise UsageError(f"no such file: {text}{hint}")
    raise UsageError(
        f"{text} is neither a folder nor a file, {either(kinds)}{hint}: 'cnpgen list' names those that ship"
    )


problems = partial(_recipe_or_path, ("dataset", "pipeline"))
viewed = partial(_recipe_or_path, ("problem", "pipeline", "dataset"))


def shipped(text: str) -> str:
    """Read the name of a shipped dataset, pipeline or problem."""
    check_recipe(text)
    if os.path.exists(text) or text.endswith(".toml"):  # noqa: PTH110 - names may be too long
        raise UsageError(
            f"expected the name of a shipped recipe, got the path {text}: copy your own files"
        )
    return viewed(text)


def tasks_of(text: str) -> str:
    """Read the name or the file of a dataset, a pipeline or a problem."""
    check_recipe(viewed(text))
    return text


def _recipe(kinds: "tuple[Kind, ...]", text: str) -> str:
    """Read the name or the file of a recipe of one of several kinds."""
    from cnpgen.schema.catalogue import find_recipe
    from cnpgen.store.files.atomic import check_readable

    check_recipe(text)
    check_readable(find_recipe(kinds, text))
    return text


# or a recipe with the problem
problem = partial(_recipe, ("problem", "pipeline", "dataset"))
suite = partial(_recipe, ("suite", "dataset", "pipeline"))


def model(text: str) -> str:
    """Read the name of a shipped model, or its file."""
    from cnpgen.planner.model_file import find_model

    find_model(text)
    return text


def dataset(text: str) -> Path:
    """Read the folder of a dataset, or its URL: the folder of its copy."""
    from cnpgen.loader.remote import local_folder
    from cnpgen.store.paths import require_dataset

    _refuse_shipped(text)
    return require_dataset(local_folder(text))


def present(text: str) -> Path:
    """Read the path of a file or a folder, or the URL of a dataset: the folder of its copy."""
    from cnpgen.loader.remote import local_folder
    from cnpgen.store.paths import require_path

    _refuse_shipped(text)
    path = Path(local_folder(text))
    require_path(path, "a file or a folder")
    return path


def present_or_model(text: str) -> Path:
    """Read the path of a file or a folder, or the name of a shipped model."""
    from cnpgen.planner.model_file import shipped_models

    if not os.path.exists(text) and text in (known := shipped_models()):  # noqa: PTH110 - names may be too long
        return known[text]
    return present(text)


def read_plans(
    path: Path, *, problem: str | None = None, extrapolate: bool = False
) -> "Plans":
    """Read the plans of a file, as ``cnpgen.load_plans`` does.

    Refuse files without plans.
    """
    from cnpgen.plans import load_plans

    plans = load_plans(path, problem=problem, extrapolate=extrapolate)
    if not len(plans):
        raise DatasetError(f"no plans in {path}")
    return plans


def check_absent(folder: Path, names: Iterable[str], *, force: bool) -> None:
    """Refuse files that exist in a folder, unless they may be replaced."""
    there = [str(folder / name) for name in names if (folder / name).exists()]
    if there and not force:
        raise UsageError(
            f"{', '.join(there)} exist{'s' if len(there) == 1 else ''} already: --force writes over it"
        )


def _refuse_shipped(text: str) -> None:
    """Refuse the name of a shipped dataset where its folder is expected."""
    if not os.path.exists(text) and text in _shipped("dataset"):  # noqa: PTH110 - names may be too long
        raise UsageError(
            f"{text} is a recipe, expected a path: 'cnpgen make-dataset {text}' makes the dataset"
        )
