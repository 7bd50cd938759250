"""Copy a recipe for editing.

A dataset is copied as DIR/dataset.toml with its DIR/pipeline.toml and DIR/problem.toml,
a pipeline with its problem. The copies have the name of the folder and refer to each
other; the URDF is copied unless it belongs to a package. The path of the first file is
printed on stdout. Existing files are replaced only with --force.
"""

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names
from cnpgen.cli.parser import Parser
from cnpgen.errors import UsageError

if TYPE_CHECKING:
    from cnpgen.make.any_recipe import Recipe

_NEXT = {
    "dataset": "cnpgen make-dataset {0}",
    "pipeline": "cnpgen make-dataset {0} --n 1000",
    "problem": "cnpgen show {0}",
}


def add_options(parser: Parser) -> None:
    parser.add_argument(
        "recipe",
        metavar="NAME",
        type=recipe_names.shipped,
        help="a shipped dataset, pipeline or problem (see 'cnpgen list')",
    )
    parser.add_argument(
        "folder", metavar="DIR", help="folder of the copies; its name becomes theirs"
    )
    parser.add_argument(
        "--kind",
        choices=("dataset", "pipeline", "problem"),
        help="kind, if several have this name",
    )
    parser.add_argument("--force", action="store_true", help="replace existing files")


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.make.any_recipe import load_any
    from cnpgen.schema.keys import NAME
    from cnpgen.store.files.atomic import check_writable, write_file

    folder = Path(arguments.folder)
    recipe = load_any(arguments.recipe, arguments.kind)
    name = folder.resolve().name
    if not re.match(NAME, name):
        raise UsageError(
            f"DIR must be lower-case letters, digits and hyphens, such as my-hits; got {name!r}"
        )
    texts = copied_texts(recipe, name)
    recipe_names.check_absent(folder, texts, force=arguments.force)
    check_writable(folder)
    for file, text in texts.items():
        write_file(folder / file, text)
    # The first text is that of the recipe itself, whose references follow.
    first = folder / next(iter(texts))
    print(first)
    print(
        f"next: edit the files in {folder}, then: {_NEXT[first.stem].format(first)}",
        file=sys.stderr,
    )


def copied_texts(recipe: "Recipe", name: str) -> dict[str, str]:
    """Return the files of a copy with another name, that of the recipe itself first: file name -> text."""
    from cnpgen.make.recipe import DatasetRecipe
    from cnpgen.pipelines.pipeline import Pipeline

    if isinstance(recipe, DatasetRecipe):
        text = _changed(recipe.path, name=name, pipeline="pipeline.toml")
        return {"dataset.toml": text, **copied_texts(recipe.pipeline, name)}
    if isinstance(recipe, Pipeline):
        text = _changed(recipe.path, name=name, problem="problem.toml")
        return {"pipeline.toml": text, **copied_texts(recipe.problem, name)}
    files = {"problem.toml": _changed(recipe.path, name=name)}
    # The URDF of an installed package is found by its address and needs no copy.
    if "://" not in recipe.robot.urdf:  # of a package
        files[recipe.robot.urdf] = recipe.urdf_path.read_text(encoding="utf-8")
    return files


def _changed(file: Path, **keys: str) -> str:
    """Return the text of a recipe file with other values of keys; comments stay."""
    text = file.read_text(encoding="utf-8")
    for key, value in keys.items():
        text = re.sub(
            rf'^{key} *= *"[^"]*"',
            f'{key} = "{value}"',
            text,
            count=1,
            flags=re.MULTILINE,
        )
    return text
