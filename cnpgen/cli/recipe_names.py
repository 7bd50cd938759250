"""Arguments that name a recipe; an existing path of another kind is refused with its kind."""

from contextlib import suppress
from pathlib import Path

from cnpgen.errors import UsageError, either, nearest

DATASET = "'cnpgen inspect {0}' describes it, 'cnpgen validate {0}' checks it"
_HINTS = {  # what a file is -> what to do with it
    "a file of plans": "'cnpgen evaluate {0}' judges them",
    "a shard of a dataset": "'cnpgen inspect' describes the dataset, by its folder",
    "a model of cnpgen": "'cnpgen plan --model {0}' plans with it",
    "an HDF5 file": "'cnpgen inspect' describes the folder of a dataset, 'cnpgen evaluate' judges a file of plans",
}


def check_recipe(recipe: str, *, of_dataset: str = DATASET) -> None:
    """Refuse the folder of a dataset, tables and HDF5 files, before they are looked for, or read, as recipes.

    Args:
        recipe: Name or path.
        of_dataset: What to do with a dataset; "{0}" is its folder.

    Raises:
        UsageError: It is one of these.
    """
    from cnpgen.store.paths import file_kind
    from cnpgen.store.workspace import is_dataset

    path = Path(recipe)
    if path.is_dir():
        if recipe not in _shipped() and is_dataset(path):
            raise UsageError(f"{recipe} is the folder of a dataset, expected a recipe: {of_dataset.format(recipe)}")
        return
    if path.suffix.lower() == ".csv" and path.is_file():
        hint = f"'cnpgen complete NAME {recipe} -o problems.h5' makes problems of tasks, which 'cnpgen solve' takes"
        raise UsageError(f"{recipe} is a table, expected a recipe: {hint}")
    if kind := file_kind(path):
        what = kind if kind in {"an HDF5 file", "a journal of cnpgen"} else f"an HDF5 file, {kind}"
        hint = _HINTS.get(kind, "'cnpgen list' names the recipes that there are").format(recipe)
        raise UsageError(f"{recipe} is {what}, expected a recipe: {hint}")


def is_recipe(what: str) -> bool:
    """Return whether an argument is a recipe file, or the name of a shipped dataset or pipeline and no path."""
    path = Path(what)
    return (
        path.suffix == ".toml" if path.exists() else path.suffix == ".toml" or what in _shipped("dataset", "pipeline")
    )


def check_there(what: str, *kinds: str) -> None:
    """Refuse an argument that is neither a path nor the name of a recipe.

    Args:
        what: Name or path of a recipe, or the folder of a dataset.
        *kinds: Kinds of recipes, datasets and pipelines by default.

    Raises:
        UsageError: There is nothing of the kind.
    """
    kinds = kinds or ("dataset", "pipeline")
    names = _shipped(*kinds)
    if Path(what).exists() or what in names:
        return
    hint = nearest(what, [*names, *_neighbours(Path(what))])
    if what.endswith(".toml"):
        raise UsageError(f"no such file: {what}{hint}")
    raise UsageError(
        f"{what} is neither a folder nor a file, {either(kinds)}{hint}: 'cnpgen list' names those that ship"
    )


def _shipped(*kinds: str) -> set[str]:
    from cnpgen.schema.catalogue import list_recipes
    from cnpgen.schema.toml import MARKS

    return {name for kind in MARKS if not kinds or kind in kinds for name in list_recipes(kind)}


def _neighbours(path: Path) -> list[str]:
    """List the datasets and recipe files beside a path."""
    from cnpgen.store.workspace import is_dataset

    with suppress(OSError):
        return [str(each) for each in path.parent.iterdir() if each.suffix == ".toml" or is_dataset(each)]
    return []
