"""Describe a recipe, a kind of stage or constraint, or the keys of recipe files.

A dataset is shown with its pipeline, its problem and the model of its name, a pipeline
with its problem; a file of a model with what the model leaves free.
Errors in a file are reported on stderr with file and key, one per line, and the exit
code is 2.
"""

import argparse
from pathlib import Path

from cnpgen.cli.parser import Parser, add_json
from cnpgen.cli.recipe_names import check_recipe
from cnpgen.errors import UsageError
from cnpgen.schema.toml import MARKS


def add_options(parser: Parser) -> None:
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "recipe",
        metavar="NAME|FILE",
        nargs="?",
        help="a shipped dataset, pipeline or problem (see 'cnpgen list'), or the file of a recipe or model",
    )
    what.add_argument(
        "--stage", metavar="KIND", help="describe a kind of stage and its keys"
    )
    what.add_argument(
        "--constraint",
        metavar="KIND",
        help="describe a kind of constraint and its keys",
    )
    what.add_argument(
        "--keys",
        metavar="WHAT",
        nargs="?",
        choices=("all", *MARKS),
        const="all",
        help="all keys of problem, pipeline, dataset and suite files, in Markdown ('cnpgen docs keys'); "
        "WHAT is one kind",
    )
    parser.add_argument(
        "--kind",
        choices=("dataset", "pipeline", "problem"),
        help="kind of the recipe, if several have the same name",
    )
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.addons.manual import describe
    from cnpgen.make.any_recipe import load_any
    from cnpgen.planner.model_file import load_model, shipped_models
    from cnpgen.store.files.documents import plain, render
    from cnpgen.store.paths import file_kind

    if arguments.recipe is None:
        if arguments.kind:
            raise UsageError("--kind needs NAME or FILE")
        print(_about_kinds(arguments))
        return
    if file_kind(Path(arguments.recipe)) == "a model of cnpgen":
        found = describe.model_to_dict(load_model(arguments.recipe))
        print(render(found) if arguments.json else describe.describe_model(found))
        return
    check_recipe(arguments.recipe)
    recipe = load_any(arguments.recipe, arguments.kind)
    if arguments.json:
        print(render(plain(describe.recipe_to_dict(recipe))))
        return
    print(describe.describe(recipe))
    if arguments.kind is None and arguments.recipe in shipped_models():
        found = describe.model_to_dict(load_model(arguments.recipe))
        print(f"\n{describe.describe_model(found)}")


def _about_kinds(arguments: argparse.Namespace) -> str:
    """Describe a kind of stage or constraint, or the keys of recipe files."""
    from cnpgen.addons.manual import describe_keys
    from cnpgen.schema import registry
    from cnpgen.store.files.documents import plain, render

    if arguments.keys:
        if not arguments.json:
            return _page_of_keys(arguments.keys)
        kinds = tuple(MARKS) if arguments.keys == "all" else (arguments.keys,)
        return render(plain(describe_keys.keys_to_dict(kinds)))
    group = registry.STAGES if arguments.stage else registry.CONSTRAINTS
    named = group, arguments.stage or arguments.constraint
    if arguments.json:
        return render(plain(describe_keys.kind_to_dict(*named)))
    return describe_keys.describe_kind(*named)


def _page_of_keys(kind: str) -> str:
    """Return the page of all keys, or its part on one kind of files."""
    from cnpgen.cli.docs_command import rendered_page

    page = rendered_page("keys").rstrip()
    if kind == "all":
        return page
    # The part of one kind: from its heading to the next one of this level.
    head = f"\n## {kind.capitalize()} files\n"
    return (head + page.partition(head)[2].partition("\n## ")[0]).strip()
