"""Pipelines: stages that sample the boundary conditions of a problem, their files, and the fields that they store."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from cnpgen.documents import JsonMapping, NamedErrors
from cnpgen.errors import PluginError, RecipeError, UsageError
from cnpgen.pipelines.stages.draw_scenes import DrawScenes
from cnpgen.pipelines.stages.stage import Context, Stage, StageFunction
from cnpgen.problems.obstacles import with_capacity
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import missing_kinds, read_problem, without_defaults
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.catalogue import load_recipe, read_kind, reference
from cnpgen.schema.keys import NAME, RecipeLocation, field
from cnpgen.schema.parsing import Reader, parse, stored_values
from cnpgen.schema.toml import read_table
from cnpgen.store.field import Field, Fields
from cnpgen.store.scene_table import SCENE_ID

MAX_STAGES = 100
# Of every sample.
REQUIRED_COLUMNS = (
    "start_q",
    "start_dq",
    "start_ddq",
    "goal_q",
    "goal_dq",
    "start_xyz",
    "goal_xyz",
)
# Stored order of the fields of the shipped stages; other fields follow in the order of
# their stages.
FIELD_ORDER = (
    "start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "goal_ddq", "start_xyz", "goal_xyz",
    "parameters", "hit_angle", "hit_speed", "hit_speed_max",
)  # fmt: skip
# Attributes that every stage must declare equally for a field; a later stage may change
# the role and the limits.
_CONFIG = ("unit", "width", "dtype", "names", "frame")


@dataclass(frozen=True, kw_only=True)
class Pipeline:
    """Stages that sample the boundary conditions of a problem."""

    name: str = field(
        "name of the pipeline: lower-case letters, digits and hyphens", pattern=NAME
    )
    title: str = field("title in one line", default="")
    problem: Problem = field(
        "name of a shipped problem, or path of a problem file relative to this one",
        form="a name or a path",
    )
    stage: tuple[Stage, ...] = field("stages, in order", form="[[stage]] tables")
    path: Path = Path()

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        if (count := len(self.stage)) > MAX_STAGES:
            yield "stage", f"there are {count:,} stages, expected at most {MAX_STAGES}"


def listed_tasks(pipeline: Pipeline) -> int | None:
    """Return the number of listed tasks of a pipeline; None if no stage lists tasks.

    Raise RecipeError if more than one stage lists tasks.
    """
    listed = [stage.tasks for stage in pipeline.stage if stage.tasks is not None]
    if len(listed) > 1:
        raise RecipeError(
            [
                f"{pipeline.path}: {len(listed)} stages list positions, expected one at most"
            ]
        )
    return listed[0] if listed else None


@checked_arguments
def load_pipeline(
    name_or_path: str | Path, *, relative_to: Path | None = None
) -> Pipeline:
    """Load a pipeline and its problem.

    Args:
        name_or_path: Name of a shipped pipeline, or path of a pipeline file.
        relative_to: Base folder of a relative path; by default the working directory.

    Raises:
        RecipeError: The pipeline or problem file has errors; the error lists all of
            them.
    """
    return load_recipe(("pipeline",), name_or_path, relative_to, read_pipeline)


def read_pipeline(path: Path, errors: list[str]) -> Pipeline | None:
    """Read a pipeline file and append its errors to ``errors``.

    Return None if it is unusable.
    """
    table = read_table(path, ("pipeline",), errors)
    if table is None:
        return None
    readers: dict[type, Reader] = {
        Stage: partial(read_kind, registry.STAGES),
        Problem: reference("problem", read_problem, path.parent),
    }
    where = RecipeLocation(str(path))
    pipeline = parse(Pipeline, table, where=where, errors=errors, readers=readers)
    if pipeline is None:
        return None
    return replace(
        pipeline, path=path.absolute(), problem=_with_places(pipeline, where, errors)
    )


def _with_places(
    pipeline: Pipeline, where: RecipeLocation, errors: list[str]
) -> Problem:
    """Return the problem with places for the obstacles of scenes that a stage draws."""
    drawn = [
        (index, stage)
        for index, stage in enumerate(pipeline.stage)
        if isinstance(stage, DrawScenes)
    ]
    if len(drawn) > 1:
        errors.append(
            (where / "stage" / drawn[1][0]).message(
                "a second stage draws scenes, expected one"
            )
        )
    try:
        return (
            with_capacity(pipeline.problem, drawn[0][1].capacity)
            if drawn
            else pipeline.problem
        )
    except UsageError as error:
        errors.append((where / "problem").message(str(error)))
        return pipeline.problem


def restore_pipeline(
    name: str, stages: Sequence[JsonMapping], problem: Problem
) -> Pipeline:
    """Rebuild a pipeline from the resolved stages of a dataset or model specification."""
    tables = [dict(stage) for stage in stages]
    if missing := missing_kinds(registry.STAGES, list(enumerate(tables))):
        raise PluginError(missing)
    errors = list[str]()
    read = partial(read_kind, registry.STAGES)
    with stored_values():
        read_stages = [
            read(table, RecipeLocation(name) / "stage" / at, errors)
            for at, table in enumerate(without_defaults(tables))
        ]
    if errors:
        raise RecipeError(errors)
    return Pipeline(
        name=name, problem=problem, stage=tuple(read_stages), path=Path(name)
    )


@dataclass(frozen=True)
class PipelineStep:
    """Stage of a registered kind at a position, counted from 1, in the file of a pipeline."""

    path: Path
    number: int
    kind: str
    stage: Stage

    @property
    def label(self) -> str:
        """Label of the stage in sampling statistics."""
        return f"{self.number}. {self.kind}"

    def error(self, text: str) -> str:
        """Return an error message with file and stage."""
        return f"{self.path}: stage {self.number} ({self.kind}): {text}"


def steps_of(pipeline: Pipeline) -> list[PipelineStep]:
    """List the stages of a pipeline with their positions and names."""
    return [
        PipelineStep(
            pipeline.path, number, registry.name_of(registry.STAGES, type(stage)), stage
        )
        for number, stage in enumerate(pipeline.stage, start=1)
    ]


def stored_fields(steps: Sequence[PipelineStep], context: Context) -> Fields:
    """Merge the outputs of the stages, in stored order.

    Raise RecipeError if two stages declare a field differently.
    """
    fields: dict[str, Field] = {}
    first: dict[str, PipelineStep] = {}
    errors = []
    for step in steps:
        for item in step.stage.outputs(context):
            before = fields.setdefault(item.name, item)
            origin = first.setdefault(item.name, step)
            if _definition(item) != _definition(before):
                text = f"declares {item.name} as {_declared(item, before)}, but stage {origin.number} ({origin.kind})"
                text += f" before it as {_declared(before, item)}: a stage may not redefine a field"
                errors.append(step.error(text))
            # A later stage may narrow limits and role.
            fields[item.name] = item
    if errors:
        raise RecipeError(errors)
    # The stored order does not depend on the order of stages.
    known = [fields.pop(name) for name in FIELD_ORDER if name in fields]
    return (
        *known,
        *fields.values(),
        *bookkeeping_fields(scenes=any(step.stage.draws_scenes for step in steps)),
    )


def bookkeeping_fields(*, scenes: bool = False) -> Fields:
    """Return the bookkeeping fields of every dataset, and with ``scenes`` that of the scene of a row."""
    return (
        *(
            (
                Field(
                    SCENE_ID,
                    "1",
                    "sample_id of the first row in the same scene",
                    role="context",
                    dtype="int64",
                ),
            )
            if scenes
            else ()
        ),
        Field(
            "attempts",
            "1",
            "candidates per accepted row, including this row",
            role="diagnostic",
            dtype="int64",
        ),
        Field(
            "sample_id",
            "1",
            "index of the row in its split",
            role="diagnostic",
            dtype="int64",
        ),
    )


def _definition(field: Field) -> dict[str, object]:
    return {key: getattr(field, key) for key in _CONFIG}


def _declared(field: Field, other: Field) -> str:
    """Return the attributes of a field that differ from another declaration of it, as text."""
    ours = _definition(field)
    theirs = _definition(other)
    return ", ".join(
        f"{key} {value!r}" for key, value in ours.items() if value != theirs[key]
    )


def written_columns(
    path: Path, steps: Sequence[PipelineStep], context: Context
) -> set[str]:
    """Return the columns that the stages of a pipeline write.

    Raise RecipeError if no earlier stage writes an input of a stage, or no stage writes
    a required column.
    """
    written: set[str] = set()
    errors = []
    for step in steps:
        # Inputs must be written before: stages run in order.
        if missing := [name for name in step.stage.inputs if name not in written]:
            errors.append(
                step.error(
                    f"needs {', '.join(missing)}, which no stage before it writes"
                )
            )
        written.update(step.stage.writes(context))
    errors += _replaced_stages(steps, context)
    drawn = ("parameters",) if context.problem.parameters else ()
    errors += [
        f"{path}: no stage writes {name}, which every sample must have"
        for name in (*REQUIRED_COLUMNS, *drawn)
        if name not in written
    ]
    if errors:
        raise RecipeError(errors)
    return written


def _replaced_stages(steps: Sequence[PipelineStep], context: Context) -> Iterator[str]:
    """Yield errors of stages all of whose columns are written again before a stage reads one of them."""
    for place, step in enumerate(steps, start=1):
        left = {*step.stage.writes(context)}
        for later in steps[place:]:
            if not left or not left.isdisjoint(later.stage.inputs):
                break
            left.difference_update(later.stage.writes(context))
            if not left:
                yield step.error(
                    f"has no effect: stage {later.number} ({later.kind}) writes all of its columns again"
                )


def prepare_steps(
    steps: Sequence[PipelineStep], prepare: Callable[[Stage], StageFunction]
) -> list[tuple[str, StageFunction]]:
    """Prepare and label every stage.

    Raise RecipeError with all errors, each with file and stage.
    """
    functions = []
    errors = []
    for step in steps:
        try:
            functions.append((step.label, prepare(step.stage)))
        except RecipeError as error:
            errors += [step.error(error) for error in error.errors]
    if errors:
        raise RecipeError(errors)
    return functions
