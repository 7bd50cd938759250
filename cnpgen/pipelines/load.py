"""Pipelines from files, by name or path."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from cnpgen.errors import PluginError, RecipeError
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.problems.load import missing_kinds, read_problem, without_defaults
from cnpgen.problems.problem import Problem
from cnpgen.schema import registry
from cnpgen.schema.catalogue import load_recipe, read_kind, reference
from cnpgen.schema.keys import Place
from cnpgen.schema.parsing import Reader, parse
from cnpgen.schema.toml import read_table


def load_pipeline(name_or_path: str | Path, *, relative_to: Path | None = None) -> Pipeline:
    """Load a pipeline and its problem.

    Args:
        name_or_path: Name of a shipped pipeline, or path of a pipeline file.
        relative_to: Folder that a path is relative to; by default the working directory.

    Raises:
        RecipeError: With every mistake in both files.
    """
    return load_recipe(("pipeline",), name_or_path, relative_to, read_pipeline)


def read_pipeline(path: Path, mistakes: list[str]) -> Pipeline | None:
    """Read a pipeline file and append what is wrong with it to ``mistakes``; None if it cannot be used."""
    table = read_table(path, ("pipeline",), mistakes)
    if table is None:
        return None
    readers: dict[type, Reader] = {
        Stage: partial(read_kind, registry.STAGES),
        Problem: reference("problem", read_problem, path.parent),
    }
    made = parse(Pipeline, table, where=Place(str(path)), mistakes=mistakes, readers=readers)
    return made and replace(made, path=path.absolute())


def restore_pipeline(name: str, stages: Sequence[Mapping[str, Any]], problem: Problem) -> Pipeline:
    """Rebuild a pipeline from its resolved stages, as blueprints of datasets and models keep them.

    Args:
        name: Its name.
        stages: The tables of its stages.
        problem: Its problem.

    Raises:
        RecipeError: They do not fit this version of cnpgen.
        PluginError: A package that they need is not installed.
    """
    tables = [dict(stage) for stage in stages]
    if missing := missing_kinds(registry.STAGES, list(enumerate(tables))):
        raise PluginError(missing)
    mistakes = list[str]()
    read = partial(read_kind, registry.STAGES)
    made = [read(table, Place(name) / "stage" / at, mistakes) for at, table in enumerate(without_defaults(tables))]
    if mistakes:
        raise RecipeError(mistakes)
    return Pipeline(name=name, problem=problem, stage=tuple(made), path=Path(name))
