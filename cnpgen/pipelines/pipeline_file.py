"""Pipeline files, loaded by name or path."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from cnpgen.errors import PluginError, RecipeError, UsageError
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.draw_scenes import DrawScenes
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.problems.obstacles import with_capacity
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import missing_kinds, read_problem, without_defaults
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.catalogue import load_recipe, read_kind, reference
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import Reader, parse, stored_values
from cnpgen.schema.toml import read_table


@checked_arguments
def load_pipeline(name_or_path: str | Path, *, relative_to: Path | None = None) -> Pipeline:
    """Load a pipeline and its problem.

    Args:
        name_or_path: Name of a shipped pipeline, or path of a pipeline file.
        relative_to: Base folder of a relative path; by default the working directory.

    Raises:
        RecipeError: The pipeline or problem file has mistakes; the error lists all of them.
    """
    return load_recipe(("pipeline",), name_or_path, relative_to, read_pipeline)


def read_pipeline(path: Path, mistakes: list[str]) -> Pipeline | None:
    """Read a pipeline file and append its mistakes to ``mistakes``; return None if it is unusable."""
    table = read_table(path, ("pipeline",), mistakes)
    if table is None:
        return None
    readers: dict[type, Reader] = {
        Stage: partial(read_kind, registry.STAGES),
        Problem: reference("problem", read_problem, path.parent),
    }
    where = RecipeLocation(str(path))
    pipeline = parse(Pipeline, table, where=where, mistakes=mistakes, readers=readers)
    if pipeline is None:
        return None
    return replace(pipeline, path=path.absolute(), problem=_with_places(pipeline, where, mistakes))


def _with_places(pipeline: Pipeline, where: RecipeLocation, mistakes: list[str]) -> Problem:
    """Return the problem with places for the obstacles of scenes that a stage draws."""
    drawn = [(index, stage) for index, stage in enumerate(pipeline.stage) if isinstance(stage, DrawScenes)]
    if len(drawn) > 1:
        mistakes.append((where / "stage" / drawn[1][0]).message("a second stage draws scenes, expected one"))
    try:
        return with_capacity(pipeline.problem, drawn[0][1].capacity) if drawn else pipeline.problem
    except UsageError as error:
        mistakes.append((where / "problem").message(str(error)))
        return pipeline.problem


def restore_pipeline(name: str, stages: Sequence[Mapping[str, Any]], problem: Problem) -> Pipeline:
    """Rebuild a pipeline from the resolved stages of a dataset or model specification.

    Raises:
        RecipeError: This version of cnpgen does not support the stages.
        PluginError: A required package is not installed.
    """
    tables = [dict(stage) for stage in stages]
    if missing := missing_kinds(registry.STAGES, list(enumerate(tables))):
        raise PluginError(missing)
    mistakes = list[str]()
    read = partial(read_kind, registry.STAGES)
    with stored_values():
        read_stages = [
            read(table, RecipeLocation(name) / "stage" / at, mistakes)
            for at, table in enumerate(without_defaults(tables))
        ]
    if mistakes:
        raise RecipeError(mistakes)
    return Pipeline(name=name, problem=problem, stage=tuple(read_stages), path=Path(name))
