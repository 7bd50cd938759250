"""Recipes by name or path: shipped recipes, user files, and their readers."""

import os
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, get_args

from cnpgen.errors import RecipeError, UsageError, either, nearest
from cnpgen.schema import registry
from cnpgen.schema.keys import RecipeLocation, keys
from cnpgen.schema.parsing import Reader, parse
from cnpgen.schema.toml import Kind
from cnpgen.schema.units import show

Recipe = TypeVar("Recipe")

MAX_NAME_LENGTH = 200  # of a name in messages

_LAYOUT: dict[Kind, str] = {  # paths of the shipped files of a kind
    "problem": "problems/*/problem.toml",
    "pipeline": "pipelines/*.toml",
    "dataset": "datasets/*.toml",
    "suite": "datasets/suites/*.toml",
}


def list_recipes(kind: Kind) -> dict[str, Path]:
    """List the shipped recipes of a kind: name -> file, by name."""
    if not isinstance(kind, str) or kind not in _LAYOUT:
        raise UsageError(
            f"must be one of {', '.join(_LAYOUT)}, got {kind!r:.100}", argument="kind"
        )
    folder, _, pattern = _LAYOUT[kind].partition("/")
    files = sorted((recipes_root() / folder).glob(pattern))
    return {
        file.parent.name if kind == "problem" else file.stem: file for file in files
    }


def recipes_root() -> Path:
    """Return the folder of the shipped recipes: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "_recipes"
    return installed if installed.is_dir() else package.parent


def find_file(
    kinds: tuple[Kind, ...], name_or_path: str | Path, folder: Path | None
) -> Path:
    """Find a recipe of one of several kinds, in this priority.

    Raise ValueError if there is none.
    """
    text = os.fspath(name_or_path)
    path = (folder or Path()) / text
    shown = text if len(text) <= MAX_NAME_LENGTH else f"{text[:MAX_NAME_LENGTH]}..."
    known = {
        name: file
        # Kinds that come first replace later ones of the same name.
        for kind in reversed(kinds)
        for name, file in list_recipes(kind).items()
    }
    is_path = (
        isinstance(name_or_path, Path)
        or text.endswith(".toml")
        or "/" in text
        or os.sep in text
    )
    if os.path.isfile(path):  # noqa: PTH113 - Path.is_file raises for names that are too long
        return path
    if is_path:
        hint = nearest(Path(shown).stem, known)
        if os.path.isdir(path):  # noqa: PTH112 - as above
            raise ValueError(
                f"{path} is a folder, expected a .toml file{_hint_of_folder(path, kinds)}"
            )
        raise ValueError(f"no such file: {(folder or Path()) / shown}{hint}")
    if text not in known:
        hint = _hint_of_folder(path, kinds) or _hint(shown, kinds, known)
        raise ValueError(
            f"unknown {either(kinds)} {shown!r}{hint}; known: {', '.join(known) or 'none'}"
        )
    return known[text]


def _hint_of_folder(folder: Path, kinds: tuple[Kind, ...]) -> str:
    """Return a hint for a folder of recipes as 'cnpgen copy' writes it: its file of one of the kinds."""
    files = [os.path.join(folder, f"{kind}.toml") for kind in kinds]  # noqa: PTH118 - names may be too long
    return next(
        (f" (did you mean {file!r}?)" for file in files if os.path.isfile(file)),  # noqa: PTH113
        "",
    )


def _hint(text: str, kinds: tuple[Kind, ...], known: Iterable[str]) -> str:
    """Return a hint: other kinds with a recipe of this name, or a similar known name."""
    others = " and ".join(
        f"a {kind}"
        for kind in _LAYOUT
        if kind not in kinds and text in list_recipes(kind)
    )
    return f": it is the name of {others}" if others else nearest(text, known)


def find_recipe(
    kinds: tuple[Kind, ...], name_or_path: str | Path, folder: Path | None = None
) -> Path:
    """Find the file of a recipe; raise RecipeError if there is none."""
    try:
        return find_file(kinds, name_or_path, folder)
    except ValueError as error:
        unknown = RecipeError([str(error)])
        unknown.argument = "name_or_path"
        raise unknown from error


def load_recipe(
    kinds: tuple[Kind, ...],
    name_or_path: str | Path,
    folder: Path | None,
    build: Callable[[Path, list[str]], Recipe | None],
) -> Recipe:
    """Find, read and build a recipe, or raise all errors at once."""
    errors: list[str] = []
    recipe = build(find_recipe(kinds, name_or_path, folder), errors)
    if recipe is None or errors:
        raise RecipeError(errors)
    return recipe


def reference(
    kind: Kind, build: Callable[[Path, list[str]], Any], folder: Path
) -> Reader:
    """Return a reader of keys that refer to another recipe."""

    def read(value: Any, where: RecipeLocation, errors: list[str]) -> Any:
        if isinstance(value, str):
            return build(find_file((kind,), value, folder), errors)
        errors.append(where.message(f"expected a name or a path, got {show(value)}"))
        return None

    return read


def read_kind(group: str, value: Any, where: RecipeLocation, errors: list[str]) -> Any:
    """Read a ``[[stage]]`` or ``[[constraint]]`` table, whose key ``use`` names the kind."""
    use = value.get("use") if isinstance(value, dict) else None
    if not isinstance(use, str):
        known = ", ".join(registry.names(group))
        given = isinstance(value, dict) and "use" in value
        text = f"expected one of {known}"
        text = f"{text}, got {show(value['use'])}" if given else f"missing key, {text}"
        errors.append((where / "use").message(text))
        return None
    try:
        kind = registry.load(group, use)
    except RecipeError as error:
        errors.extend((where / "use").message(text) for text in error.errors)
        return None
    rest = {key: entry for key, entry in value.items() if key != "use"}
    hints = {
        hint
        for key in keys(kind)
        for hint in get_args(key.hint)
        if isinstance(hint, type)
    }
    # Tables within the kind may be of registered kinds, too.
    readers: dict[type, Reader] = {
        hint: partial(read_kind, nested)
        for hint in hints
        if (nested := registry.group_of(hint))
    }
    return parse(kind, rest, where=where, errors=errors, readers=readers)
