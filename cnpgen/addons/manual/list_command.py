"""List recipes, models and the kinds that recipes and options name."""

import argparse
from pathlib import Path

from cnpgen.cli.parser import Parser, add_json
from cnpgen.cli.terminal import table
from cnpgen.documents import JsonObject
from cnpgen.errors import RecipeError, counted
from cnpgen.schema.toml import Kind

_HOW = {
    "datasets": "cnpgen make-dataset NAME",
    "models": "cnpgen plan DIR --model NAME -o PLANS",
    "pipelines": "cnpgen show NAME --kind pipeline",
    "problems": "cnpgen show NAME --kind problem",
    "stages": "cnpgen show --stage NAME",
    "constraints": "cnpgen show --constraint NAME",
    "objectives": "cnpgen train DIR -o MODEL --objective NAME=WEIGHT",
    "exporters": "cnpgen export PLANS --to NAME",
    "families": "cnpgen make-scenes NAME --robot ROBOT",
    "shapes": 'kind = NAME in [[obstacle]]; of packages kind = "convex" and shape = {use = NAME}',
    "planners": "cnpgen benchmark SUITE --planners NAME",
    "suites": "cnpgen benchmark NAME",
}
WHAT = tuple(_HOW)


def add_options(parser: Parser) -> None:
    parser.add_argument(
        "what",
        nargs="?",
        choices=WHAT,
        metavar="WHAT",
        help=f"one of {', '.join(WHAT)}; default all",
    )
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.store.files.documents import plain, render

    found = {
        what: list_all(what) for what in ([arguments.what] if arguments.what else WHAT)
    }
    print(
        render(plain(found))
        if arguments.json
        else "\n\n".join(_section(*item) for item in found.items())
    )


def list_all(what: str) -> list[JsonObject]:
    """List the recipes of one kind, the models, or a group of kinds, of ``WHAT``, with name, title and size."""
    files = files_of(what)
    if files is None:
        group = f"cnpgen.{what}"
        return [{"name": name, "title": _summary(group, name)} for name in names(what)]
    describe = {
        "datasets": _dataset,
        "models": _model,
        "pipelines": _pipeline,
        "problems": _problem,
        "suites": _suite,
    }[what]
    return [
        {"name": name, **describe(name, file), "file": file}
        for name, file in files.items()
    ]


def names(what: str) -> list[str]:
    """List the names of one of ``WHAT``; empty if the add-on that has all of them is missing."""
    from cnpgen.schema import registry

    files = files_of(what)
    return list(registry.names(f"cnpgen.{what}") if files is None else files)


def files_of(what: str) -> dict[str, Path] | None:
    """Return the files of recipes of one kind or of the models, by name; None of a group of kinds."""
    from cnpgen.planner.model_file import shipped_models
    from cnpgen.schema.catalogue import list_recipes

    kinds: dict[str, Kind] = {
        "datasets": "dataset",
        "pipelines": "pipeline",
        "problems": "problem",
        "suites": "suite",
    }
    if what == "models":
        return shipped_models()
    return list_recipes(kinds[what]) if what in kinds else None


def _dataset(name: str, _: Path) -> JsonObject:
    from cnpgen.make.recipe import load_dataset_recipe

    recipe = load_dataset_recipe(name)
    rows = sum(recipe.splits.values())
    about = {
        "title": recipe.title,
        "version": recipe.version,
        "pipeline": recipe.pipeline.name,
    }
    return about | {"size": counted(rows, "row"), "rows": rows, "splits": recipe.splits}


def _model(name: str, file: Path) -> JsonObject:
    """Describe a model by its name, which is that of its dataset.

    Reading the file would load HDF5.
    """
    count = file.stat().st_size
    return {
        "title": f"planner trained on {name}",
        "size": f"{count / 1e6:.1f} MB",
        "bytes": count,
    }


def _pipeline(name: str, _: Path) -> JsonObject:
    from cnpgen.pipelines.pipeline import load_pipeline

    recipe = load_pipeline(name)
    count = len(recipe.stage)
    return {
        "title": recipe.title,
        "problem": recipe.problem.name,
        "size": counted(count, "stage"),
        "stages": count,
    }


def _problem(name: str, _: Path) -> JsonObject:
    from cnpgen.problems.problem_file import load_problem

    recipe = load_problem(name)
    count = {"joints": len(recipe.robot.joints), "constraints": len(recipe.constraint)}
    size = ", ".join(f"{number} {what}" for what, number in count.items())
    return {"title": recipe.title, "size": size, **count}


def _suite(_: str, file: Path) -> JsonObject:
    """Describe a suite by its title; its problems are built when a benchmark needs them."""
    import tomllib

    title = tomllib.loads(file.read_text(encoding="utf-8")).get("title", "")
    return {"title": str(title)}


def _summary(group: str, name: str) -> str:
    """Return one line about a kind; a broken plug-in must not hide the others."""
    from cnpgen.addons.manual.describe_keys import kind_summary
    from cnpgen.schema import registry

    try:
        base = None if group in registry.CONTRACTS else object
        return kind_summary(registry.load(group, name, base))
    except RecipeError as error:
        return f"(broken: {error})"


def _section(what: str, entries: list[JsonObject]) -> str:
    rows = [
        (entry["name"], *([entry["size"]] if "size" in entry else []), entry["title"])
        for entry in entries
    ]
    return "\n".join(
        [
            f"{what}  ({_HOW[what]})",
            *(table(rows, indent="  ", one_line=True) if rows else ["  none"]),
        ]
    )
