"""The stages of a pipeline, one after the other: what they are called, whether they fit together, and their work."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cnpgen.errors import RecipeError
from cnpgen.pipelines.acceptance import bookkeeping_fields
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.stage import Stage, Work
from cnpgen.schema import registry
from cnpgen.store.field import Field

NEEDED = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "start_xyz", "goal_xyz")  # of every sample

# Stored order of the fields that the shipped stages write; others follow in the order of their stages.
ORDER = (
    "start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "goal_ddq", "start_xyz", "goal_xyz",
    "hit_angle", "hit_speed", "hit_speed_max",
)  # fmt: skip

# What the numbers of a field are; what its role and limits are may be said anew by a stage that writes it again.
_MEANING = ("unit", "width", "dtype", "names", "frame")


@dataclass(frozen=True)
class Step:
    """A stage at its place in a pipeline.

    Attributes:
        path: File of the pipeline.
        number: Its place, counted from 1.
        kind: The name that its kind is registered under.
        stage: The stage.
    """

    path: Path
    number: int
    kind: str
    stage: Stage

    @property
    def label(self) -> str:
        """What the stage is called where draws are counted."""
        return f"{self.number}. {self.kind}"

    def says(self, text: str) -> str:
        """Return a mistake with file and stage."""
        return f"{self.path}: stage {self.number} ({self.kind}): {text}"


def steps_of(pipeline: Pipeline) -> list[Step]:
    """List the stages of a pipeline, each with its place and name."""
    return [
        Step(pipeline.path, number, registry.name_of(registry.STAGES, type(stage)), stage)
        for number, stage in enumerate(pipeline.stage, start=1)
    ]


def stored_fields(steps: Sequence[Step], context: Context) -> tuple[Field, ...]:
    """Merge what the stages provide, in stored order.

    Raises:
        RecipeError: A later stage writes a field of an earlier one as something else, in another unit for example.
    """
    fields: dict[str, Field] = {}
    first: dict[str, Step] = {}
    mistakes = []
    for step in steps:
        for field in step.stage.provides(context):
            before = fields.setdefault(field.name, field)
            if _meaning(field) != _meaning(before):
                where = f"stage {first[field.name].number} ({first[field.name].kind})"
                text = f"provides {field.name} as {_declared(field, before)}, but {where} before it as"
                mistakes.append(step.says(f"{text} {_declared(before, field)}: a stage may not change what a field is"))
            fields[field.name] = field
            first.setdefault(field.name, step)
    if mistakes:
        raise RecipeError(mistakes)
    known = [fields.pop(name) for name in ORDER if name in fields]
    return (*known, *fields.values(), *bookkeeping_fields())


def _meaning(field: Field) -> dict[str, object]:
    return {key: getattr(field, key) for key in _MEANING}


def _declared(field: Field, other: Field) -> str:
    """Say what a field is declared as where another declaration of it differs."""
    ours, theirs = _meaning(field), _meaning(other)
    return ", ".join(f"{key} {value!r}" for key, value in ours.items() if value != theirs[key])


def written_columns(path: Path, steps: Sequence[Step], context: Context) -> set[str]:
    """Return the columns that the stages of a pipeline write.

    Raises:
        RecipeError: A stage needs one that no stage before it writes, or one that every sample must have is missing.
    """
    written: set[str] = set()
    mistakes = []
    for step in steps:
        if missing := [name for name in step.stage.needs if name not in written]:
            mistakes.append(step.says(f"needs {', '.join(missing)}, which no stage before it writes"))
        written.update(step.stage.writes(context))
    mistakes += [
        f"{path}: no stage writes {name}, which every sample must have" for name in NEEDED if name not in written
    ]
    if mistakes:
        raise RecipeError(mistakes)
    return written


def prepare_steps(steps: Sequence[Step], prepare: Callable[[Stage], Work]) -> list[tuple[str, Work]]:
    """Prepare and label every stage.

    Args:
        steps: The stages.
        prepare: What prepares one.

    Raises:
        RecipeError: With all their mistakes at once, each with file and stage.
    """
    works, mistakes = [], []
    for step in steps:
        try:
            works.append((step.label, prepare(step.stage)))
        except RecipeError as error:
            mistakes += [step.says(mistake) for mistake in error.mistakes]
    if mistakes:
        raise RecipeError(mistakes)
    return works
