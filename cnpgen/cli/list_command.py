"""``cnpgen list``: shipped recipes and models, and the kinds of stages, constraints, objectives and exporters."""

import argparse
from typing import Any

from cnpgen.cli.parser import Commands, Parser, add_command, add_json
from cnpgen.errors import RecipeError

WHAT = ("datasets", "models", "pipelines", "problems", "stages", "constraints", "objectives", "exporters")

_HOW = {
    "datasets": "cnpgen make-dataset NAME",
    "models": "cnpgen plan DIR --model NAME -o PLANS",
    "pipelines": "cnpgen show NAME --kind pipeline",
    "problems": "cnpgen show NAME --kind problem",
    "stages": "cnpgen show --stage NAME",
    "constraints": "cnpgen show --constraint NAME",
    "objectives": "cnpgen train DIR -o MODEL --objective NAME=WEIGHT",
    "exporters": "cnpgen export PLANS --to NAME",
}


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "list", run, title=f"list {', '.join(WHAT[:-1])} and {WHAT[-1]}")
    parser.add_argument("what", nargs="?", choices=WHAT, metavar="WHAT", help=f"one of {', '.join(WHAT)}; default all")
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from cnpgen.store.files.documents import plain, render

    found = {what: list_all(what) for what in ([arguments.what] if arguments.what else WHAT)}
    print(render(plain(found)) if arguments.json else "\n\n".join(_section(*item) for item in found.items()))
    return 0


def list_all(what: str) -> list[dict[str, Any]]:
    """List the recipes of one kind, the models, or a group of kinds, with name, title and size.

    Args:
        what: One of ``WHAT``.
    """
    from cnpgen.schema import registry

    groups = {
        "stages": registry.STAGES,
        "constraints": registry.CONSTRAINTS,
        "objectives": registry.OBJECTIVES,
        "exporters": registry.EXPORTERS,
    }
    if what in groups:
        return [{"name": name, "title": _summary(groups[what], name)} for name in registry.names(groups[what])]
    return {"datasets": _datasets, "models": _models, "pipelines": _pipelines, "problems": _problems}[what]()


def _datasets() -> list[dict[str, Any]]:
    from cnpgen.make.recipe_file import load_dataset_recipe
    from cnpgen.schema.catalogue import list_recipes

    entries = []
    for name, file in list_recipes("dataset").items():
        recipe = load_dataset_recipe(name)
        rows = sum(recipe.splits.values())
        size = {"size": f"{rows:,} rows", "rows": rows, "splits": recipe.splits}
        about = {"version": recipe.version, "pipeline": recipe.pipeline.name}
        entries.append({"name": name, "title": recipe.title, **about, **size, "file": file})
    return entries


def _models() -> list[dict[str, Any]]:
    from cnpgen.planner.model_file import shipped_models

    entries = []
    for name, file in shipped_models().items():  # their names are those of datasets; reading them would load HDF5
        count = file.stat().st_size
        size = {"size": f"{count / 1e6:.1f} MB", "bytes": count}
        entries.append({"name": name, "title": f"planner trained on {name}", **size, "file": file})
    return entries


def _pipelines() -> list[dict[str, Any]]:
    from cnpgen.pipelines.pipeline_file import load_pipeline
    from cnpgen.schema.catalogue import list_recipes

    entries = []
    for name, file in list_recipes("pipeline").items():
        recipe = load_pipeline(name)
        size = {"size": f"{len(recipe.stage)} stages", "stages": len(recipe.stage)}
        entries.append({"name": name, "title": recipe.title, "problem": recipe.problem.name, **size, "file": file})
    return entries


def _problems() -> list[dict[str, Any]]:
    from cnpgen.problems.problem_file import load_problem
    from cnpgen.schema.catalogue import list_recipes

    entries = []
    for name, file in list_recipes("problem").items():
        recipe = load_problem(name)
        count = {"joints": len(recipe.robot.joints), "constraints": len(recipe.constraint)}
        size = ", ".join(f"{number} {what}" for what, number in count.items())
        entries.append({"name": name, "title": recipe.title, "size": size, **count, "file": file})
    return entries


def _summary(group: str, name: str) -> str:
    """Return one line about a kind; a broken plug-in must not hide the others."""
    from cnpgen.cli.describe_keys import kind_summary
    from cnpgen.schema import registry

    try:
        return kind_summary(registry.load(group, name))
    except RecipeError as error:
        return f"(broken: {error})"


def _section(what: str, entries: list[dict[str, Any]]) -> str:
    from cnpgen.cli.describe import table

    rows = [(entry["name"], *([entry["size"]] if "size" in entry else []), entry["title"]) for entry in entries]
    return "\n".join([f"{what}  ({_HOW[what]})", *(table(rows, indent="  ", one_line=True) if rows else ["  none"])])
