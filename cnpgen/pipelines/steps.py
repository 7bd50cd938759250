"""Sequence of the stages of a pipeline: labels, consistency checks and stage functions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cnpgen.errors import RecipeError
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.stage import Context, Stage, StageFunction
from cnpgen.schema import registry
from cnpgen.store.field import Field
from cnpgen.store.scene_table import SCENE_ID

REQUIRED_COLUMNS = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "start_xyz", "goal_xyz")  # of every sample

# Stored order of the fields of the shipped stages; other fields follow in the order of their stages.
FIELD_ORDER = (
    "start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "goal_ddq", "start_xyz", "goal_xyz",
    "parameters", "hit_angle", "hit_speed", "hit_speed_max",
)  # fmt: skip

# Attributes that every stage must declare equally for a field; a later stage may change the role and the limits.
_CONFIG = ("unit", "width", "dtype", "names", "frame")


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

    def mistake(self, text: str) -> str:
        """Return an error message with file and stage."""
        return f"{self.path}: stage {self.number} ({self.kind}): {text}"


def steps_of(pipeline: Pipeline) -> list[PipelineStep]:
    """List the stages of a pipeline with their positions and names."""
    return [
        PipelineStep(pipeline.path, number, registry.name_of(registry.STAGES, type(stage)), stage)
        for number, stage in enumerate(pipeline.stage, start=1)
    ]


def stored_fields(steps: Sequence[PipelineStep], context: Context) -> tuple[Field, ...]:
    """Merge the outputs of the stages, in stored order; raise RecipeError if two stages declare a field differently."""
    fields: dict[str, Field] = {}
    first: dict[str, PipelineStep] = {}
    mistakes = []
    for step in steps:
        for field in step.stage.outputs(context):
            before = fields.setdefault(field.name, field)
            if _definition(field) != _definition(before):
                where = f"stage {first[field.name].number} ({first[field.name].kind})"
                text = f"declares {field.name} as {_declared(field, before)}, but {where} before it as"
                mistakes.append(step.mistake(f"{text} {_declared(before, field)}: a stage may not redefine a field"))
            fields[field.name] = field
            first.setdefault(field.name, step)
    if mistakes:
        raise RecipeError(mistakes)
    known = [fields.pop(name) for name in FIELD_ORDER if name in fields]
    return (*known, *fields.values(), *bookkeeping_fields(scenes=any(step.stage.draws_scenes for step in steps)))


def bookkeeping_fields(*, scenes: bool = False) -> tuple[Field, ...]:
    """Return the bookkeeping fields of every dataset, and with ``scenes`` that of the scene of a row."""
    text = "sample_id of the first row in the same scene"
    return (
        *((Field(SCENE_ID, "1", text, role="context", dtype="int64"),) if scenes else ()),
        Field("attempts", "1", "candidates per accepted row, including this row", role="diagnostic", dtype="int64"),
        Field("sample_id", "1", "index of the row in its split", role="diagnostic", dtype="int64"),
    )


def _definition(field: Field) -> dict[str, object]:
    return {key: getattr(field, key) for key in _CONFIG}


def _declared(field: Field, other: Field) -> str:
    """Return the attributes of a field that differ from another declaration of it, as text."""
    ours, theirs = _definition(field), _definition(other)
    return ", ".join(f"{key} {value!r}" for key, value in ours.items() if value != theirs[key])


def written_columns(path: Path, steps: Sequence[PipelineStep], context: Context) -> set[str]:
    """Return the columns that the stages of a pipeline write.

    Raise RecipeError if no earlier stage writes an input of a stage, or no stage writes a required column.
    """
    written: set[str] = set()
    mistakes = []
    for step in steps:
        if missing := [name for name in step.stage.inputs if name not in written]:
            mistakes.append(step.mistake(f"needs {', '.join(missing)}, which no stage before it writes"))
        written.update(step.stage.writes(context))
    mistakes += [
        f"{path}: no stage writes {name}, which every sample must have"
        for name in REQUIRED_COLUMNS
        if name not in written
    ]
    if mistakes:
        raise RecipeError(mistakes)
    return written


def prepare_steps(
    steps: Sequence[PipelineStep], prepare: Callable[[Stage], StageFunction]
) -> list[tuple[str, StageFunction]]:
    """Prepare and label every stage; raise RecipeError with all mistakes, each with file and stage."""
    functions, mistakes = [], []
    for step in steps:
        try:
            functions.append((step.label, prepare(step.stage)))
        except RecipeError as error:
            mistakes += [step.mistake(mistake) for mistake in error.mistakes]
    if mistakes:
        raise RecipeError(mistakes)
    return functions
